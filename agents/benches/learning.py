"""Trains agents with and without memory on small tasks, and evaluates them on seeds that training never uses.

    python learning.py --task one-command --agents gru trxl none --seeds 1 2 3
    python learning.py --report
    cargo xtask pictures

Each run is one `endless-train` with the preset `quick` and the flags below. It stops at the target reward or the time limit
of the task; an agent without memory gets as many updates as the slowest run with memory. The evaluation plays 50 seeds from
200,000 on, three episodes each. The results of a task are stored in `learning/TASK.json`, with the commands and the learning
curves; `--report` writes `learning/README.md`, whose plots `cargo xtask pictures` makes.
"""

import argparse
import dataclasses
import json
import os
import shlex
import tempfile
import time
from pathlib import Path

from endless_gym_agents.common import atomic
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.settings import Settings
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import parse, train

FOLDER = Path(__file__).parent / "learning"
#: Flags, time limit in minutes, target reward, and the largest possible reward if it is known.
_ONE = "--env MortarMayhem-Grid-v0 --environment.option 'command_count=[1]'"
_CUES = "--env MysteryPath-Grid-v0 --environment.option show_origin=true show_goal=true reward_path_progress=0.1"
TASKS = {
    "one-command": (_ONE, 15, 0.097, 0.1),
    "one-command-bf16": (f"{_ONE} --bf16", 15, 0.097, 0.1),
    "one-command-pixels": (f"{_ONE} --environment.observation rgb", 30, 0.097, 0.1),
    "two-commands": ("--env MortarMayhem-Grid-v0 --environment.option 'command_count=[2]'", 30, 0.19, 0.2),
    "three-commands": ("--env MortarMayhem-Grid-v0 --environment.option 'command_count=[3]'", 30, 0.28, 0.3),
    "mystery-path-grid-with-cues": (_CUES, 30, 1.6, None),
    "endless-mystery-path": ("--env Endless-MysteryPath-v0", 30, 2.0, None),
}


def run(flags: list[str], folder: Path) -> dict:
    """Train and evaluate an agent; returns the row for the results file."""
    start = time.perf_counter()
    settings: Settings = parse(flags)
    done = checkpoint.load(train(dataclasses.replace(settings, run=str(folder))))
    minutes = (time.perf_counter() - start) / 60
    rows = [json.loads(line) for line in (folder / "progress.jsonl").read_text().splitlines()]
    results = evaluate(done.agent, num_threads=1)
    return {
        "command": f"endless-train {shlex.join(flags)}",
        "agent": settings.agent,
        "seed": settings.seed,
        "updates": done.update,
        "steps": rows[-1]["steps"],
        "minutes": round(minutes, 2),
        "load_average": round(os.getloadavg()[0], 1),
        "evaluation_reward": mean(results),
        "evaluation": {name: mean(results, name) for name in results[0] if name != "seed"},
        "curve": [[row["steps"], round(row["episode/reward"], 5)] for row in rows if "episode/reward" in row],
    }


def as_json(data: dict) -> str:
    """JSON with one run per line."""
    task, best = json.dumps(data["task"]), json.dumps(data["best_reward"])
    runs = ",\n".join(json.dumps(run) for run in data["runs"])
    return f'{{"task": {task}, "best_reward": {best}, "runs": [\n{runs}\n]}}\n'


def report() -> None:
    """Write `learning/README.md` with a table of all runs and the plots."""
    lines = [
        "# Learning with and without memory",
        "",
        "Agents with and without memory on small tasks, from feature observations unless the name contains `pixels`, on one or",
        "two cores of a shared machine. The reward is the mean over 50 seeds that training never uses, three episodes each.",
        "An agent without memory trained for as many updates as the slowest earlier run with memory. The minutes are those of a",
        "previous version, without native kernels for the GRU. The JSON files in this folder have the exact numbers, the",
        "learning curves and the commands; `learning.py --report` writes this page from them.",
        "",
        "| task | agent | seeds | steps | minutes | evaluation reward | at most |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    commands = []
    for task in (task for task in TASKS if (FOLDER / f"{task}.json").exists()):
        data = json.loads((FOLDER / f"{task}.json").read_text())
        commands.append(f"    {data['runs'][0]['command']}")
        for agent in sorted({row["agent"] for row in data["runs"]}, key=lambda agent: (agent == "none", agent)):
            rows = sorted((row for row in data["runs"] if row["agent"] == agent), key=lambda row: row["seed"])
            seeds = ", ".join(str(row["seed"]) for row in rows)
            steps = ", ".join(f"{row['steps'] / 1000:.0f}k" for row in rows)
            minutes = ", ".join(f"{row['minutes']:.1f}" for row in rows)
            rewards = ", ".join(f"{row['evaluation_reward']:.3f}" for row in rows)
            lines.append(
                f"| {task} | {agent} | {seeds} | {steps} | {minutes} | {rewards} | {data['best_reward'] or ''} |"
            )
    picture = '<source media="(prefers-color-scheme: dark)" srcset="curves-dark.svg">'
    text = "mean reward of the last 100 episodes during training, for each task and agent"
    picture = f'<picture>{picture}<img src="curves-light.svg" alt="{text}"></picture>'
    lines += ["", picture, "", "The first run of each task:", "", *commands]
    atomic.write(FOLDER / "README.md", "\n".join(lines) + "\n")


def main() -> None:
    """Train, evaluate and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=TASKS, help="task to train and evaluate")
    parser.add_argument("--agents", nargs="+", default=["gru", "none"], help="agents to train (default: %(default)s)")
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=[1, 2, 3], help="seeds of the runs (default: %(default)s)"
    )
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of PyTorch (default: %(default)s)")
    parser.add_argument("--report", action="store_true", help="write learning/README.md")
    args = parser.parse_args()
    FOLDER.mkdir(exist_ok=True)
    if args.task:
        flags, minutes, target, best = TASKS[args.task]
        file = FOLDER / f"{args.task}.json"
        data = {"task": args.task, "best_reward": best, "runs": []}
        data = json.loads(file.read_text()) if file.exists() else data
        for agent in sorted(args.agents, key=lambda agent: agent == "none"):
            for seed in args.seeds:
                given = f"{flags} --agent {agent} --seed {seed} --preset quick"
                given += f" --threads {args.threads} --environment.num-threads 1"
                given += f" --time-limit {minutes} --target-reward {target}"
                others = [row["updates"] for row in data["runs"] if row["agent"] != "none"]
                if agent == "none" and others:
                    given += f" --ppo.updates {max(others)}"
                with tempfile.TemporaryDirectory() as folder:
                    row = run(shlex.split(given), Path(folder) / "run")
                kept = [old for old in data["runs"] if (old["agent"], old["seed"]) != (agent, seed)]
                data["runs"] = [*kept, row]
                atomic.write(file, as_json(data))
                print(
                    f"{args.task} {agent} {seed}: {row['evaluation_reward']:.4f} after {row['minutes']} minutes",
                    flush=True,
                )
    if args.report:
        report()


if __name__ == "__main__":
    main()
