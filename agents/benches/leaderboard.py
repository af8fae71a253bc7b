"""Compares memories on the tasks of the ruler: trains and evaluates them, and writes the scores and a table.

    python leaderboard.py laptop                        # everything, as many runs at a time as there are cores
    python leaderboard.py laptop --agents gru mingru --tasks one-command --seeds 1
    python leaderboard.py laptop --agents own.py:Mine   # a memory of your own; repeat with other --sizes
    python leaderboard.py laptop --table                # only the table, from the scores so far

A track is a file `leaderboard/TRACK.json`: tasks, agents, sizes, seeds, and the flags that all runs share. Each run is one
`endless-train` and one `endless-eval`, with `endless-reproduce`, so that the same command resumes what was interrupted and
skips what is done, and `--ray` runs on a cluster. The scores are rows of `leaderboard/TRACK.results.json`, which keeps the rows
of other agents; the table is `leaderboard/TRACK.md`. A new row needs the runs of `none` on the same task, whose score is the
zero.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import platform
import statistics
from pathlib import Path
from typing import Any

import numpy as np
import torch

from endless_gym_agents import checkpoint, reproduce
from endless_gym_agents.agent import Agent
from endless_gym_agents.conformance import state_bytes
from endless_gym_agents.evaluate import evaluate, mean
from endless_gym_agents.experiments import definitions, planning
from endless_gym_agents.experiments.planning import Job
from endless_gym_agents.logs import read_progress
from endless_gym_agents.ruler import TASKS, Task
from endless_gym_agents.settings import Environment
from endless_gym_agents.statistics import summarise

FOLDER = Path(__file__).parent / "leaderboard"
#: Agents without memory have one size.
MEMORYLESS = ("none", "position")
#: The columns that identify a row.
KEYS = ("agent", "size", "task", "seed")


def read(name: str) -> dict[str, Any]:
    """A track by name."""
    return dict(json.loads((FOLDER / f"{name}.json").read_text())) | {"name": name}


def experiment(track: dict[str, Any], tasks: list[str], agents: list[str], sizes: list[str]) -> dict[str, Any]:
    """The experiment of `endless-reproduce` with all runs, in which the name of a run is TASK AGENT SIZE."""
    runs = []
    for task in (TASKS[name] for name in tasks):
        for agent in agents:
            for size in ["-"] if agent in MEMORYLESS else sizes:
                flags = (
                    track["flags"] | task.flags() | track.get("task_flags", {}).get(task.name, {}) | {"agent": agent}
                )
                # The flags of a size are those of the agent, or of all others.
                flags |= {} if size == "-" else track["sizes"][size].get(agent, track["sizes"][size]["other"])
                # A name is a folder.
                name = f"{task.name} {Path(agent).name} {size}"
                runs.append({"name": name, "env": task.env, "flags": flags})
    written = {"title": f"Memories, {track['name']} track", "section": "-", "about": track["about"], "kind": "curves"}
    return written | {"seeds": len(track["seeds"]), "evaluation": track["evaluation"], "runs": runs}


def row(job: Job, task: Task, agent: str, size: str) -> dict[str, Any]:
    """The results of a run that is done."""
    file = job.folder / "row.json"
    if file.exists():
        return dict(json.loads(file.read_text()))
    loaded = checkpoint.load(job.folder)
    made, protocol = loaded.agent, job.experiment.evaluation
    (results,) = json.loads((job.folder / planning.EVALUATION).read_text())["experiments"]
    progress = read_progress(job.folder)
    per_update = loaded.settings.environment.num_envs * loaded.settings.ppo.steps

    def speed(phase: str) -> int:
        return round(per_update / statistics.median(line[f"seconds/{phase}"] for line in progress))

    found = {
        "agent": agent,
        "size": size,
        "task": task.name,
        "seed": job.seed,
        "score": round(float(results["runs"][0]["metrics"]["reward"][-1]), 5),
        "longer": None if task.longer is None else round(longer(made, task, protocol.seeds), 5),
        "parameters": made.num_parameters,
        "state_bytes": state_bytes(made.initial_memory(1).state),
        "acting": speed("inference"),
        "learning": speed("learning"),
        "steps": loaded.steps,
        "minutes": round(sum(planning.update_seconds(job)) / 60, 2),
    }
    file.write_text(json.dumps(found) + "\n")
    return found


def longer(agent: Agent, task: Task, seeds: int) -> float:
    """Mean return in the longer version of a task."""
    assert task.longer is not None
    env, options = task.longer
    trained = agent.settings
    environment: Environment = dataclasses.replace(trained.environment, option=options)
    agent.settings = dataclasses.replace(trained, env=env, environment=environment)
    try:
        return mean(evaluate(agent, range(200_000, 200_000 + seeds), 1, num_threads=1))
    finally:
        agent.settings = trained


def table(track: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    """The page of a track, Markdown."""
    tasks = track["tasks"]
    scores = {tuple(one[key] for key in KEYS): one["score"] for one in rows}
    zeros = {
        task: statistics.mean(found)
        for task in tasks
        if (found := [one["score"] for one in rows if one["task"] == task and one["agent"] == "none"])
    }
    lines = [
        f"# Memories: {track['name']} track",
        "",
        track["about"],
        "",
        "Scores are normalised for each task: 0 is the agent `none`, without memory, and 1 the scripted expert. IQM is the",
        "interquartile mean over all tasks and seeds, with its 95 % interval by stratified bootstrap. The expert sees the whole",
        "state, so 1 minus a score is the gap to the fully observable task. Acting and learning are environment steps per second",
        "in that phase of training, in the run that other work disturbed least; they depend on the machine.",
        "",
        "| agent | size | IQM | 95 % | " + " | ".join(tasks) + " | parameters | acting | learning | bytes of state |",
        "| --- | --- | ---: | --- |" + " ---: |" * (len(tasks) + 4),
    ]
    body = []
    for agent, size in sorted({(one["agent"], one["size"]) for one in rows}):
        own = [one for one in rows if (one["agent"], one["size"]) == (agent, size)]
        seeds = sorted({one["seed"] for one in own})
        means = {
            task: statistics.mean(
                TASKS[task].normalised(one["score"], zeros[task]) for one in own if one["task"] == task
            )
            for task in {one["task"] for one in own} & zeros.keys()
        }
        iqm, interval = float("nan"), "incomplete"
        if all((agent, size, task, seed) in scores and task in zeros for task in tasks for seed in seeds):
            normalised = [
                [TASKS[task].normalised(scores[agent, size, task, seed], zeros[task]) for task in tasks]
                for seed in seeds
            ]
            summary = summarise(np.array(normalised))
            iqm, interval = summary.iqm, f"{summary.low:.2f} to {summary.high:.2f}"
        cells = [f"{means[task]:.2f}" if task in means else "" for task in tasks]
        largest = [max(one[key] for one in own) for key in ("acting", "learning", "state_bytes")]
        numbers = [f"{number:,.0f}" for number in (statistics.median(one["parameters"] for one in own), *largest)]
        shown = f"{iqm:.2f}" if iqm == iqm else ""
        body.append(
            (-iqm if iqm == iqm else 1e9, " | ".join([f"| `{agent}`", size, shown, interval, *cells, *numbers]) + " |")
        )
    lines += [line for _, line in sorted(body)]
    lines += ["", "| task | measures | expert | `none` | gate |", "| --- | --- | ---: | ---: | --- |"]
    for task in (TASKS[name] for name in tasks):
        zero = zeros.get(task.name)
        gate = "" if zero is None else "passed" if task.passes_gate(zero) else "FAILED"
        lines.append(
            f"| {task.name} | {task.label} | {task.expert:g} | {'' if zero is None else f'{zero:.3f}'} | {gate} |"
        )
    return "\n".join(lines) + "\n"


def main() -> None:
    """Train, evaluate and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("track", help="name of the track, a file in `leaderboard`")
    parser.add_argument(
        "--agents", nargs="+", help="agents, as --agent of endless-train takes them (default: those of the track)"
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, help="tasks (default: those of the track)")
    parser.add_argument("--sizes", nargs="+", default=["gru"], help="sizes of the track (default: %(default)s)")
    parser.add_argument("--seeds", nargs="+", type=int, help="seeds of the runs (default: those of the track)")
    parser.add_argument("--jobs", type=int, default=0, help="runs at the same time (default: one per core or GPU)")
    parser.add_argument("--device", default="auto", help="device of the agents (default: %(default)s)")
    parser.add_argument("--ray", default="", help="address of a Ray cluster, or local")
    parser.add_argument(
        "--out", type=Path, default=Path("leaderboard-runs"), help="folder of the runs (default: %(default)s)"
    )
    parser.add_argument("--results", type=Path, help="file of the rows (default: that of the track)")
    parser.add_argument("--scale", default="1", help="a smaller version, for a try, as for endless-reproduce")
    parser.add_argument("--table", action="store_true", help="train nothing, write the table")
    args = parser.parse_args()
    track = read(args.track)
    tasks, agents = args.tasks or track["tasks"], args.agents or track["agents"]
    written = experiment(track, tasks, agents, args.sizes)
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / f"{args.track}.json"
    file.write_text(json.dumps(written, indent=1) + "\n")
    seeds, failure = tuple(args.seeds or track["seeds"]), None
    if not args.table:
        given = reproduce.ReproduceArguments(
            names=(str(file),),
            out=args.out,
            scale=args.scale,
            seeds=seeds,
            jobs=args.jobs,
            device=args.device,
            ray=args.ray,
        )
        try:
            reproduce.execute(given)
        except ValueError as error:  # Some runs failed; the others have rows.
            failure = error
    results = args.results or FOLDER / f"{args.track}.results.json"
    data = json.loads(results.read_text()) if results.exists() else {"rows": []}
    rows = {tuple(one[key] for key in KEYS): one for one in data["rows"]}
    named = {
        run["name"]: (run["name"].split(" ")[0], run["flags"]["agent"], run["name"].split(" ")[2])
        for run in written["runs"]
    }
    torch.set_num_threads(1)
    for job in planning.jobs(definitions.load(str(file)), args.out, planning.read_scale(args.scale), seeds):
        if job.state() == "done":
            task, agent, size = named[job.run.name]
            found = row(job, TASKS[task], Path(agent).name, size)
            rows[tuple(found[key] for key in KEYS)] = found
    machine = {
        "machine": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "torch": torch.__version__,
    }
    lines = ",\n".join(json.dumps(rows[key]) for key in sorted(rows, key=str))
    results.write_text(
        f'{{"track": {json.dumps(args.track)}, "machine": {json.dumps(machine)}, "rows": [\n{lines}\n]}}\n'
    )
    results.with_name(f"{results.name.partition('.')[0]}.md").write_text(table(track, list(rows.values())))
    print(f"{len(rows)} rows in {results}")
    if failure is not None:
        raise SystemExit(str(failure))


if __name__ == "__main__":
    main()
