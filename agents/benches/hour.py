"""Trains small agents for an hour on one core with `endless learn`, the trainer in Rust, from feature observations.

    python hour.py mystery-path-grid gru
    python hour.py --report
    cargo xtask pictures

A run is a curriculum: each stage starts from the weights of the one before and has reset parameters of its own. The checkpoints
of all stages are evaluated with the environment's default reset parameters, by the protocol of the paper. `hour/TASK-AGENT.json`
has the curve and the commands; `--report` writes `hour/README.md`, whose picture `cargo xtask pictures` makes.
"""

import argparse
import dataclasses
import json
import shlex
import subprocess
from pathlib import Path
from typing import Any

import torch

from endless_gym.program import program
from endless_gym_agents.common import atomic
from endless_gym_agents.evaluation.curves import published
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.evaluation.results import metric
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress

FOLDER = Path(__file__).parent / "hour"
#: Flags of all runs: one thread, and 64 environments with rollouts of 128 steps, which are also the length of BPTT.
FLAGS = (
    "--threads 1 --recurrence.hidden-size 64 --ppo.steps 128 --recurrence.sequence-length 128 --ppo.minibatches 8 "
    "--ppo.clip-range 0.2 --ppo.gamma 0.995 --ppo.final-entropy-coefficient 0.0001 --ppo.updates 1000000 "
    "--stop-when-learnt=false --keep-checkpoints"
)
#: Flags of each agent, and its updates in a minute on the machine of the results, by which learning rate and entropy coefficient
#: decay. The gates of a minGRU depend on the input only; a second layer lets them depend on what came before.
AGENTS = {"gru": ("", 580), "mingru": ("--recurrence.layers 2", 730)}
_MAYHEM = "--ppo.entropy-coefficient 0.003 --environment.option command_count="
#: Environment id, and the minutes and flags of the stages.
TASKS = {
    "mortar-mayhem-grid": (
        "MortarMayhem-Grid-v0",
        [(6, f"{_MAYHEM}[2,3]"), (9, f"{_MAYHEM}[4,5]"), (10, f"{_MAYHEM}[6,7,8]"), (20, f"{_MAYHEM}[10]")],
    ),
    "mystery-path-grid": (
        "MysteryPath-Grid-v0",
        [(20, "--environment.option reward_path_progress=0.1"), (40, "--ppo.entropy-coefficient 0.003")],
    ),
    "searing-spotlights": ("SearingSpotlights-v0", [(15, "")]),
    "endless-mystery-path": ("Endless-MysteryPath-v0", [(60, "")]),
}
#: Agents of the paper to compare with; those with observation reconstruction take the place of the others where both exist.
PUBLISHED = ("gru", "gru_rec", "trxl", "trxl_rec")


def stage(folder: Path, env: str, agent: str, minutes: float, flags: str, former: Path | None) -> str:
    """Train a stage in a folder from the weights of the former stage; returns its command."""
    own, updates = AGENTS[agent]
    command = ["learn", env, "--agent", agent, *shlex.split(f"{FLAGS} {own} {flags}")]
    command += ["--ppo.decay-updates", f"{minutes * updates:.0f}", "--time-limit", f"{minutes:g}"]
    command += ["--checkpoint-interval", f"{2 * updates}"]
    command += ["--init-from", former.name] if former else []
    subprocess.run([*program(), *command, "--run", folder.name], cwd=folder.parent, check=True)
    return f"endless {shlex.join(command)} --run {folder.name}"


def curve(folder: Path) -> list[tuple[float, int, float]]:
    """Minutes of learning and stepping, environment steps, and the metric with default reset parameters of all checkpoints."""
    seconds, points, times = 0.0, [], {0: 0.0}
    for row in read_progress(folder):
        seconds += sum(value for name, value in row.items() if name.startswith("seconds/"))
        times[row["update"]] = seconds / 60
    for file in checkpoint.files(folder):
        loaded = checkpoint.load(file)
        settings = loaded.settings
        loaded.agent.settings = dataclasses.replace(
            settings, environment=dataclasses.replace(settings.environment, option=())
        )
        results = evaluate(loaded.agent, num_threads=1)
        points.append((times[loaded.update], loaded.steps, mean(results, metric(settings.env)[0])))
    return points


def run(task: str, agent: str, scale: float, out: Path) -> dict[str, Any]:
    """Train and evaluate an agent, in new folders in `out`."""
    env, stages = TASKS[task]
    minutes, steps, points, commands, former = 0.0, 0, [], [], None
    for number, (length, flags) in enumerate(stages, start=1):
        folder = out / f"{task}-{agent}-{number}"
        commands.append(stage(folder, env, agent, scale * length, flags, former))
        # The first checkpoint of a later stage has the weights of the last one.
        for time, count, value in curve(folder)[number > 1 :]:
            points.append([round(minutes + time, 2), steps + count, round(value, 4)])
        minutes, steps, former = points[-1][0], points[-1][1], folder
        print(f"{task} {agent} stage {number}: {metric(env)[0]} {points[-1][2]} after {minutes} minutes", flush=True)
    paper = {one.label.removesuffix("_rec"): float(one.scores[:, -1].mean()) for one in published(env, PUBLISHED)}
    described = {"task": task, "env": env, "agent": agent, "metric": metric(env)[0], "paper": paper}
    return described | {"commands": commands, "curve": points}


def report() -> None:
    """Write `hour/README.md`."""
    lines = [
        "# An hour on one core",
        "",
        "Each row is one run (seed 1) of `endless learn` for at most an hour on one thread, from feature observations. The",
        "result is that of the last checkpoint on 50 seeds that training never uses, three episodes each, with default reset",
        "parameters. The paper's agents, means of five runs after their whole training, learnt from frames, which is harder:",
        "the table shows what an hour buys, not which agent is better. Two runs at a time shared two cores of a cloud machine,",
        "at times with tests. The `mingru` runs in Mystery Path had kernels 1.7 times as fast as those of the other runs, and",
        "the sequences of the `gru` runs were cut where episodes start, as in earlier versions. The JSON files in this folder",
        "have the commands; `python agents/benches/hour.py TASK AGENT` runs them.",
        "",
        "| environment | metric | agent | minutes | million steps | result | paper: GRU | paper: TrXL |",
        "| --- | --- | --- | ---: | ---: | ---: | ---: | ---: |",
    ]
    for data in (json.loads(file.read_text()) for file in sorted(FOLDER.glob("*.json"))):
        minutes, steps, value = data["curve"][-1]
        cells = [f"{data['paper'][name]:.2f}" if name in data["paper"] else "" for name in ("gru", "trxl")]
        shown = [f"`{data['agent']}`", f"{minutes:.0f}", f"{steps / 1e6:.0f}", f"{value:.2f}", *cells]
        lines.append("| " + " | ".join([data["env"], data["metric"], *shown]) + " |")
    picture = '<source media="(prefers-color-scheme: dark)" srcset="hour-dark.svg">'
    picture = f'<picture>{picture}<img src="hour-light.svg" alt="the metric of each run over minutes"></picture>'
    atomic.write(FOLDER / "README.md", "\n".join([*lines, "", picture]) + "\n")


def main() -> None:
    """Train, evaluate and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", nargs="?", choices=TASKS, help="task to train")
    parser.add_argument("agent", nargs="?", choices=AGENTS, default="gru", help="agent to train")
    parser.add_argument(
        "--scale", type=float, default=1.0, help="factor of the minutes, for a try (default: %(default)s)"
    )
    parser.add_argument("--out", type=Path, default=Path("hour-runs"), help="folder of the runs (default: %(default)s)")
    parser.add_argument("--report", action="store_true", help="write hour/README.md")
    args = parser.parse_args()
    torch.set_num_threads(1)
    FOLDER.mkdir(exist_ok=True)
    if args.task:
        args.out.mkdir(parents=True, exist_ok=True)
        found = run(args.task, args.agent, args.scale, args.out)
        atomic.write(FOLDER / f"{args.task}-{args.agent}.json", json.dumps(found) + "\n")
    if args.report:
        report()


if __name__ == "__main__":
    main()
