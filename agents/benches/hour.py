"""Trains small agents for an hour on one core with `endless learn`, the trainer in Rust, from feature observations.

    python hour.py mystery-path-grid gru --seeds 1 2 3
    python hour.py --report
    cargo xtask pictures

A run is a curriculum: each stage starts from the weights of the one before and has reset parameters of its own. The checkpoints
of all stages are evaluated with the environment's default reset parameters, by the protocol of the paper. `hour/TASK-AGENT.json`
has curves and commands; `--report` writes `hour/README.md`, whose picture `cargo xtask pictures` makes. The same command goes on
with runs that were interrupted.
"""

import argparse
import dataclasses
import json
import shlex
import subprocess
import sys
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from endless_gym.program import program
from endless_gym_agents.common import atomic
from endless_gym_agents.common.command import on_stop_signals
from endless_gym_agents.evaluation.curves import published
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.evaluation.results import metric
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress

FOLDER = Path(__file__).parent / "hour"
#: Flags of all runs: one thread, and 64 environments with rollouts of 128 steps, which are also the length of BPTT.
FLAGS = (
    "--threads 1 --recurrence.hidden-size 64 --ppo.steps 128 --recurrence.sequence-length 128 --ppo.minibatches 8 "
    "--ppo.clip-range 0.2 --ppo.gamma 0.995 --ppo.final-entropy-coefficient 0.0001 --stop-when-learnt=false "
    "--keep-checkpoints --checkpoint-interval 1000 --checkpoint-minutes 0"
)
#: Flags of each agent. The gates of a minGRU depend on the input only; a second layer lets them depend on what came before.
AGENTS = {"gru": "", "mingru": "--recurrence.layers 2"}
_MAYHEM = "--ppo.entropy-coefficient 0.003 --environment.option command_count="
#: Environment id, and the updates and flags of the stages.
TASKS = {
    "mortar-mayhem-grid": (
        "MortarMayhem-Grid-v0",
        [(2200, f"{_MAYHEM}[2,3]"), (3400, f"{_MAYHEM}[4,5]"), (3800, f"{_MAYHEM}[6,7,8]"), (7600, f"{_MAYHEM}[10]")],
    ),
    "mystery-path-grid": ("MysteryPath-Grid-v0", [(6400, "--environment.option reward_path_progress=0.1")]),
    "searing-spotlights": ("SearingSpotlights-v0", [(4800, "")]),
    "endless-mystery-path": ("Endless-MysteryPath-v0", [(20000, "")]),
}
#: Agents of the paper to compare with; those with observation reconstruction take the place of the others where both exist.
PUBLISHED = ("gru", "gru_rec", "trxl", "trxl_rec")


def stage(folder: Path, env: str, flags: str, former: Path | None) -> str:
    """Train a stage in a folder from the weights of the former stage, or resume it; returns the command that begins it."""
    command = ["learn", env, *shlex.split(flags), "--run", folder.name]
    command += ["--init-from", former.name] if former else []
    begun = ["learn", "--resume", folder.name]
    subprocess.run([*program(), *(begun if folder.exists() else command)], cwd=folder.parent, check=True)
    return f"endless {shlex.join(command)}"


def curve(folder: Path) -> list[tuple[float, int, float]]:
    """Minutes of learning and stepping, environment steps, and the metric with default reset parameters of all checkpoints."""
    seconds, points, times = 0.0, [], {0: 0.0}
    for row in read_progress(folder):
        seconds += sum(value for name, value in row.items() if name.startswith("seconds/"))
        times[row["update"]] = seconds / 60
    for file in checkpoint.files(folder):
        loaded = checkpoint.load(file)
        environment = dataclasses.replace(loaded.settings.environment, option=())
        settings = dataclasses.replace(loaded.settings, environment=environment)
        results = evaluate(loaded.agent, num_threads=1, settings=settings)
        points.append((times[loaded.update], loaded.steps, mean(results, metric(settings.env)[0])))
    return points


def run(task: str, agent: str, seed: int, scale: float, out: Path) -> dict[str, Any]:
    """Train and evaluate an agent, in folders in `out`."""
    env, stages = TASKS[task]
    minutes, steps, points, commands, former = 0.0, 0, [], [], None
    for number, (updates, flags) in enumerate(stages, start=1):
        folder = out / f"{task}-{agent}-{seed}-{number}"
        updates = round(updates * scale)
        flags = f"--agent {agent} --seed {seed} {FLAGS} {AGENTS[agent]} {flags}"
        flags += f" --ppo.updates {updates} --ppo.decay-updates {updates}"
        commands.append(stage(folder, env, flags, former))
        # The first checkpoint of a later stage has the weights of the last one.
        for time, count, value in curve(folder)[number > 1 :]:
            points.append([round(minutes + time, 2), steps + count, round(value, 4)])
        minutes, steps, former = points[-1][0], points[-1][1], folder
        print(f"{task} {agent} seed {seed} stage {number}: {points[-1][2]} after {minutes} minutes", flush=True)
    return {"seed": seed, "commands": commands, "curve": points}


def add(task: str, agent: str, run: dict[str, Any]) -> None:
    """Add a run to the file of its task and agent, in place of an earlier one of the same seed."""
    env, file = TASKS[task][0], FOLDER / f"{task}-{agent}.json"
    earlier = json.loads(file.read_text())["runs"] if file.exists() else []
    runs = [run, *(one for one in earlier if one["seed"] != run["seed"])]
    paper = {one.label.removesuffix("_rec"): float(one.scores[:, -1].mean()) for one in published(env, PUBLISHED)}
    described = {"task": task, "env": env, "agent": agent, "metric": metric(env)[0], "paper": paper}
    described["runs"] = sorted(runs, key=lambda one: one["seed"])
    atomic.write(file, json.dumps(described) + "\n")


def report() -> None:
    """Write `hour/README.md`."""
    lines = [
        "# An hour on one core",
        "",
        "Each row is `endless learn` for at most an hour on one thread, from feature observations. The result is the mean over",
        "the seeds of training, of the last checkpoint on 50 seeds that training never uses, three episodes each, with default",
        "reset parameters. Some runs learn with other reset parameters first: fewer commands in Mortar Mayhem, a reward for new",
        "tiles of the path in Mystery Path. The paper's agents, means of five runs after their whole training, learnt from",
        "frames, which is harder: the table shows what an hour buys, not which agent is better. Two runs at a time shared two",
        "cores of an AMD EPYC, at times with tests; minutes are means over the seeds. Rows of one seed are of earlier",
        "versions, which cut the GRU's sequences where episodes start; the `mingru` run among them in Mystery Path had kernels",
        "1.7 times as fast as the other. The JSON files in this folder have the commands of all runs; to repeat those of three",
        "seeds, run `python agents/benches/hour.py TASK AGENT --seeds 1 2 3`.",
        "",
        "| environment | metric | agent | minutes | million steps | result | of each seed | paper: GRU | paper: TrXL |",
        "| --- | --- | --- | ---: | ---: | ---: | --- | ---: | ---: |",
    ]
    for data in (json.loads(file.read_text()) for file in sorted(FOLDER.glob("*.json"))):
        minutes, steps, values = zip(*(run["curve"][-1] for run in data["runs"]), strict=True)
        cells = [f"{data['paper'][name]:.2f}" if name in data["paper"] else "" for name in ("gru", "trxl")]
        cells = [" ".join(f"{value:.2f}" for value in values), *cells]
        shown = [f"`{data['agent']}`", f"{fmean(minutes):.0f}", f"{fmean(steps) / 1e6:.0f}", f"{fmean(values):.2f}"]
        lines.append("| " + " | ".join([data["env"], data["metric"], *shown, *cells]) + " |")
    picture = '<source media="(prefers-color-scheme: dark)" srcset="hour-dark.svg">'
    picture = f'<picture>{picture}<img src="hour-light.svg" alt="the metric of each run over minutes"></picture>'
    atomic.write(FOLDER / "README.md", "\n".join([*lines, "", picture]) + "\n")


def main() -> None:
    """Train, evaluate and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", choices=TASKS, help="task to train")
    parser.add_argument("agent", nargs="?", choices=AGENTS, default="gru", help="agent to train")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="seeds of the runs (default: %(default)s)")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="factor of the updates, for a try (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("hour-runs"), help="folder of the runs (default: %(default)s)")
    parser.add_argument("--report", action="store_true", help="write hour/README.md")
    args = parser.parse_args()
    torch.set_num_threads(1)
    FOLDER.mkdir(exist_ok=True)
    if args.task:
        args.out.mkdir(parents=True, exist_ok=True)
        # An exception ends the program that learns; the default action of SIGTERM would leave it running.
        with on_stop_signals(lambda number, _: sys.exit(128 + number)):
            for seed in args.seeds:
                add(args.task, args.agent, run(args.task, args.agent, seed, args.scale, args.out))
    if args.report:
        report()


if __name__ == "__main__":
    main()
