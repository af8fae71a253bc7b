"""Trains the Transformer-XL with minibatches of runs of 1, 8, 16 and 64 consecutive steps, and compares how it learns.

    python minibatch_runs.py --tasks one-command coin endless-path --seeds 1 2 3
    python minibatch_runs.py --plot

`transformer.sequence_length` is the number of consecutive steps that a minibatch takes together. With 1, single steps are
shuffled, as in the authors' code. Longer runs project keys and values less often, but their steps are alike, so the gradient of a
minibatch has more noise.

All runs of a task have the same number of environment steps, and none stops early. The evaluation plays 50 seeds from 200,000 on,
three episodes each. The results of a task are stored in `minibatch_runs/TASK.json` after each run, and runs that are stored are
skipped. The order is seed by seed, so that an interrupted study still compares all lengths. `--plot` plots all results and writes
`minibatch_runs/README.md`.
"""

import argparse
import dataclasses
import json
import os
import platform
import shlex
import statistics
import tempfile
import time
from pathlib import Path

import torch

import endless_gym
from endless_gym_agents import checkpoint
from endless_gym_agents.evaluate import evaluate, mean
from endless_gym_agents.train import parse, train

FOLDER = Path(__file__).parent / "minibatch_runs"
LENGTHS = (1, 8, 16, 64)
#: Flags of every run. Rollouts have 64 steps, so a run of 64 steps is the whole rollout of an environment, and a minibatch
#: consists of 16 of them.
COMMON = (
    "--agent trxl --preset quick --no-stop-when-learnt --transformer.window 32 --threads 1 --environment.num-threads 1"
)


@dataclasses.dataclass(frozen=True)
class Task:
    """A task of the study."""

    flags: str
    """flags of the environment"""
    updates: int
    """updates of each run; 4096 environment steps each"""
    target: float
    """reward of the last 100 episodes whose first occurrence is reported"""
    about: str
    """what must be remembered"""


TASKS = {
    "one-command": Task(
        "--env MortarMayhem-Grid-v0 --environment.option 'command_count=[1]'",
        60,
        0.06,
        "Mortar Mayhem grid with one command, episodes of 10 steps; best reward 0.1, about 0.025 without memory",
    ),
    "coin": Task(
        "--env SearingSpotlights-v0 --environment.option initial_spawns=0 num_spawns=0 max_steps=32 use_exit=false "
        "reward_coin=1.0 coin_scale=1.0 agent_speed=6.0",
        40,
        0.6,
        "Searing Spotlights without spotlights and exit: the coin and the agent are seen for six steps, then it is dark; "
        "episodes of at most 32 steps; best reward 1",
    ),
    "endless-path": Task(
        "--env Endless-MysteryPath-v0",
        60,
        0.25,
        "Endless Mystery Path: the path is found by trial and remembered; episodes of about 28 steps; no largest reward",
    ),
}


def machine() -> dict[str, str | int | None]:
    """The machine and the versions of the software."""
    models = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "cpu": models[0].partition(":")[2].strip() if models else platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "endless_gym": endless_gym.__version__,
    }


def run(name: str, length: int, seed: int) -> dict:
    """Train and evaluate one agent; returns the row for the results file."""
    task = TASKS[name]
    flags = f"{task.flags} {COMMON} --seed {seed} --ppo.updates {task.updates} --transformer.sequence-length {length}"
    settings, load = parse(shlex.split(flags)), os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "run"
        wall, cpu = time.perf_counter(), time.process_time()
        done = checkpoint.load(train(dataclasses.replace(settings, run=str(folder))))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        rows = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    results = evaluate(done.agent, num_threads=1)
    curve = [[row["steps"], round(row["episode/reward"], 5)] for row in rows if "episode/reward" in row]
    return {
        "command": f"endless-train {flags}",
        "length": length,
        "seed": seed,
        "steps": rows[-1]["steps"],
        "wall_seconds": round(wall, 1),
        "cpu_seconds": round(cpu, 1),
        "learning_seconds": round(sum(row["seconds/learning"] for row in rows), 1),
        "load_average": [round(load, 1), round(os.getloadavg()[0], 1)],
        "machine": machine(),
        "evaluation_reward": round(mean(results), 5),
        "curve_mean": round(statistics.mean(reward for _, reward in curve), 5),
        "steps_to_target": next((steps for steps, reward in curve if reward >= task.target), None),
        "mean_gradient_norm": round(statistics.mean(row["gradient_norm"] for row in rows), 4),
        "curve": curve,
    }


def stored(name: str) -> list[dict]:
    """The runs of a task that are stored."""
    file = FOLDER / f"{name}.json"
    return json.loads(file.read_text())["runs"] if file.exists() else []


def store(name: str, runs: list[dict]) -> None:
    """Store the runs of a task, one per line."""
    lines = ",\n".join(json.dumps(row) for row in sorted(runs, key=lambda row: (row["length"], row["seed"])))
    file = FOLDER / f"{name}.json"
    part = file.with_suffix(".part")
    part.write_text(f'{{"task": {json.dumps(name)}, "runs": [\n{lines}\n]}}\n')
    part.replace(file)


def plot() -> None:
    """Plot for each task the mean learning curve of each length with the range of the seeds, beside the evaluations."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    colours = dict(zip(LENGTHS, ("tab:blue", "tab:green", "tab:orange", "tab:red"), strict=True))
    for name in TASKS:
        runs = stored(name)
        if not runs:
            continue
        figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 3.6), width_ratios=[3, 1], sharey=True)
        for place, length in enumerate(LENGTHS):
            rows = [row for row in runs if row["length"] == length]
            if not rows:
                continue
            steps = [step / 1000 for step, _ in rows[0]["curve"]]
            rewards = list(zip(*([reward for _, reward in row["curve"]] for row in rows), strict=True))
            left.fill_between(
                steps, [*map(min, rewards)], [*map(max, rewards)], color=colours[length], alpha=0.12, lw=0
            )
            left.plot(steps, [*map(statistics.mean, rewards)], color=colours[length], lw=1.3, label=f"runs of {length}")
            right.scatter(
                [place] * len(rows), [row["evaluation_reward"] for row in rows], color=colours[length], zorder=3
            )
        left.set(xlabel="thousand steps", ylabel="mean reward of 100 episodes", title=f"{name}: training")
        right.set(title="50 unseen seeds", xticks=range(len(LENGTHS)), xticklabels=LENGTHS, xlim=(-0.5, 3.5))
        left.legend()
        for axes in (left, right):
            axes.grid(alpha=0.3)
        figure.tight_layout()
        figure.savefig(FOLDER / f"{name}.png", dpi=110)
        pyplot.close(figure)


def spread(numbers: list[float], digits: int) -> str:
    """The mean of the seeds, and their least and largest value."""
    low, high = (f"{number:,.{digits}f}" for number in (min(numbers), max(numbers)))
    return f"{statistics.mean(numbers):,.{digits}f} ({low} to {high})"


def report() -> None:
    """Write `minibatch_runs/README.md` with a table for each task and the plots."""
    lines = [
        "# Minibatches of runs of consecutive steps",
        "",
        "Does the Transformer-XL learn worse if a minibatch consists of runs of consecutive steps, and not of single steps? Each",
        "row is a mean over seeds, with the least and the largest value in brackets. All runs of a task have the same number of",
        f"environment steps. Flags of all runs: `{COMMON}`.",
        "A minibatch has 1,024 steps, so 16 runs of 64 steps, each the whole rollout of an environment.",
        "The evaluation is on 50 seeds that training never uses, three episodes each. The curve is the mean reward of the last",
        "100 episodes after each update; its mean measures how fast the agent learns. Steps to a target are those at which the",
        "curve first reaches it. CPU and wall seconds are those of the training, on a machine that other programs used as well.",
        "They were measured before single steps were made faster: the learning of an update of `quick` with a window of 64 in",
        "`MysteryPath-Grid-v0` took 2.1 CPU seconds with runs of 1 then, and takes 0.8 now; with runs of 64 it is 0.25.",
        "Written by `minibatch_runs.py --plot` from the JSON files in this folder, which contain curves, commands and machine.",
    ]
    for name, task in TASKS.items():
        runs = stored(name)
        if not runs:
            continue
        loads = [load for row in runs for load in row["load_average"]]
        about = runs[0]["machine"]
        lines += ["", f"## {name}", "", f"{task.about}.", "", f"    {runs[0]['command']}", ""]
        lines += [
            f"| length of runs | seeds | evaluation reward | mean of the curve | steps to {task.target} | CPU seconds "
            "| wall seconds |",
            "| --- | --- | --- | --- | --- | --- | --- |",
        ]
        for length in LENGTHS:
            rows = [row for row in runs if row["length"] == length]
            if not rows:
                continue
            reached = [row["steps_to_target"] for row in rows if row["steps_to_target"] is not None]
            to_target = spread(reached, 0) if reached else "never"
            if 0 < len(reached) < len(rows):
                to_target += f", {len(reached)} of {len(rows)} runs"
            evaluation, curve = (spread([row[key] for row in rows], 3) for key in ("evaluation_reward", "curve_mean"))
            cpu, wall = (spread([row[key] for row in rows], 0) for key in ("cpu_seconds", "wall_seconds"))
            lines.append(f"| {length} | {len(rows)} | {evaluation} | {curve} | {to_target} | {cpu} | {wall} |")
        lines += [
            "",
            f"{about['cpu']}, {about['cores']} cores, load average {min(loads)} to {max(loads)}; Python {about['python']}, "
            f"PyTorch {about['torch']}, endless-gym {about['endless_gym']}.",
            "",
            f"![curves]({name}.png)",
        ]
    (FOLDER / "README.md").write_text("\n".join(lines) + "\n")


def main() -> None:
    """Train, evaluate and plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=[], help="tasks to train and evaluate")
    parser.add_argument(
        "--lengths",
        nargs="+",
        type=int,
        choices=LENGTHS,
        default=LENGTHS,
        help="lengths of runs (default: %(default)s)",
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[1, 2, 3], help="seeds of the runs (default: %(default)s)"
    )
    parser.add_argument("--plot", action="store_true", help="plot all results and write minibatch_runs/README.md")
    args = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    for seed in args.seeds:
        for name in args.tasks:
            for length in args.lengths:
                if any((row["length"], row["seed"]) == (length, seed) for row in stored(name)):
                    continue
                row = run(name, length, seed)
                store(name, [*stored(name), row])
                print(
                    f"{name} {length} {seed}: {row['evaluation_reward']:.4f}, mean of the curve {row['curve_mean']:.4f}, "
                    f"{row['cpu_seconds']} CPU seconds, {row['wall_seconds']} seconds",
                    flush=True,
                )
    if args.plot:
        plot()
        report()


if __name__ == "__main__":
    main()
