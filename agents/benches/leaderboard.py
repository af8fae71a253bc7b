"""Compares memories on the tasks of the ruler: trains and evaluates them, and writes the scores and a table.

    python leaderboard.py laptop                        # everything, as many runs at a time as there are cores
    python leaderboard.py laptop --agents gru mingru --tasks one-command --seeds 1
    python leaderboard.py laptop --agents own.py:Mine   # a memory of your own; repeat with other --sizes
    python leaderboard.py laptop --table                # only the table, from the scores so far
    python leaderboard.py laptop --table --best best    # and the best agent of each task, to open on the page

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
import platform
import statistics
from pathlib import Path
from typing import Any

import numpy as np
import torch

from endless_gym import _native
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import atomic
from endless_gym_agents.evaluation import export
from endless_gym_agents.evaluation.conformance import state_bytes
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.evaluation.ruler import TASKS, Task
from endless_gym_agents.evaluation.statistics import summarise
from endless_gym_agents.paper import reproduce
from endless_gym_agents.paper.experiments import definitions, planning
from endless_gym_agents.paper.experiments.planning import Job
from endless_gym_agents.settings import Environment
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress

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
    atomic.write(file, json.dumps(found) + "\n")
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


def export_best(done: dict[str, list[tuple[float, Job]]], folder: Path) -> None:
    """Write the best agent of each task, among those that the page can compute, as TASK.safetensors.

    Args:
        done: Scores and runs of each task.
        folder: Folder to write to; made if it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for task, runs in done.items():
        known = [run for run in runs if run[1].run.flags["agent"] in export.PAGE_AGENTS]
        if not known or TASKS[task].env.startswith("popgym"):
            print(f"{task}: no agent that the page can compute")
            continue
        score, job = max(known, key=lambda run: run[0])
        print(f"{task}: {job.run.flags['agent']} with seed {job.seed}, mean return {score:.3f}")
        export.execute(export.ExportArguments(job.folder, out=folder / f"{task}.safetensors"))


def zeros(track: dict[str, Any], rows: list[dict[str, Any]]) -> dict[str, float]:
    """The mean score of `none` on each task that it was trained on."""
    found = {
        task: [one["score"] for one in rows if (one["agent"], one["task"]) == ("none", task)] for task in track["tasks"]
    }
    return {task: statistics.mean(scores) for task, scores in found.items() if scores}


def summaries(track: dict[str, Any], rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The normalised scores of each agent and size, the best first, and after them those with missing runs."""
    tasks, zero = track["tasks"], zeros(track, rows)
    scores = {tuple(one[key] for key in KEYS): one["score"] for one in rows}
    found = []
    for agent, size in sorted({(one["agent"], one["size"]) for one in rows}):
        own = [one for one in rows if (one["agent"], one["size"]) == (agent, size)]
        seeds = sorted({one["seed"] for one in own})
        means = {
            task: statistics.mean(
                TASKS[task].normalised(one["score"], zero[task]) for one in own if one["task"] == task
            )
            for task in tasks
            if task in zero and any(one["task"] == task for one in own)
        }
        one = {"agent": agent, "size": size, "tasks": {task: round(mean, 4) for task, mean in means.items()}}
        if all((agent, size, task, seed) in scores and task in zero for task in tasks for seed in seeds):
            normalised = [
                [TASKS[task].normalised(scores[agent, size, task, seed], zero[task]) for task in tasks]
                for seed in seeds
            ]
            summary = summarise(np.array(normalised))
            one |= {"seeds": len(seeds), "iqm": summary.iqm, "low": summary.low, "high": summary.high}
        one["parameters"] = statistics.median(row["parameters"] for row in own)
        one |= {key: max(row[key] for row in own) for key in ("acting", "learning", "state_bytes")}
        found.append(one)
    return sorted(found, key=lambda one: -one.get("iqm", -1e9))


def table(track: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    """The page of a track, Markdown."""
    tasks, zero, found = track["tasks"], zeros(track, rows), summaries(track, rows)
    lines = [
        f"# Memories: {track['name']} track",
        "",
        track["about"],
        "",
        "Each row is one untuned configuration of a memory, whose layers differ from the published ones: the table does not say",
        "which memory is best.",
        "",
        "Scores are normalised for each task: 0 is the agent `none`, without memory, and 1 the scripted expert. IQM is the",
        "interquartile mean over all tasks and seeds, with its nominal 95 % interval by stratified percentile bootstrap, which",
        "is too narrow for few seeds: with three it covers about 79 %. The expert sees the whole state, so 1 minus a score is",
        "the gap to the fully observable task. Acting and learning are environment steps per second in that phase of training,",
        "in the run that other work disturbed least; they depend on the machine.",
        "",
    ]
    if (FOLDER / f"{track['name']}-light.svg").exists():
        picture = f'<source media="(prefers-color-scheme: dark)" srcset="{track["name"]}-dark.svg">'
        text = "interquartile mean of each memory with its interval, and its mean in each task"
        lines += [f'<picture>{picture}<img src="{track["name"]}-light.svg" alt="{text}"></picture>', ""]
    lines += [
        "| agent | size | IQM | 95 % | " + " | ".join(tasks) + " | parameters | acting | learning | bytes of state |",
        "| --- | --- | ---: | --- |" + " ---: |" * (len(tasks) + 4),
    ]
    for one in found:
        shown = ["", "incomplete"]
        if "iqm" in one:
            interval = f"{one['low']:.2f} to {one['high']:.2f}" if one["seeds"] > 1 else "one seed"
            shown = [f"{one['iqm']:.2f}", interval]
        cells = [f"{one['tasks'][task]:.2f}" if task in one["tasks"] else "" for task in tasks]
        numbers = [f"{one[key]:,.0f}" for key in ("parameters", "acting", "learning", "state_bytes")]
        lines.append(" | ".join([f"| `{one['agent']}`", one["size"], *shown, *cells, *numbers]) + " |")
    lines += longer_table(tasks, rows, found)
    lines += ["", "| task | measures | expert | `none` | gate |", "| --- | --- | ---: | ---: | --- |"]
    for task in (TASKS[name] for name in tasks):
        score = zero.get(task.name)
        gate = "" if score is None else "passed" if task.passes_gate(score) else "FAILED"
        lines.append(
            f"| {task.name} | {task.label} | {task.expert:g} | {'' if score is None else f'{score:.3f}'} | {gate} |"
        )
    return "\n".join(lines) + "\n"


def longer_table(tasks: list[str], rows: list[dict[str, Any]], found: list[dict[str, Any]]) -> list[str]:
    """Mean returns in tasks and in their longer versions; no lines if no task has one."""
    shown = [(TASKS[name], TASKS[name].longer) for name in tasks]
    versions = [(task, " ".join(longer[1]) or longer[0]) for task, longer in shown if longer is not None]
    if not versions:
        return []
    lines = [
        "",
        "Mean returns in a task, and after the arrow in a longer version of it, in which the agent did not train:",
        "",
        "| agent | size | " + " | ".join(f"{task.name} → `{version}`" for task, version in versions) + " |",
        "| --- | --- |" + " ---: |" * len(versions),
    ]
    for one in found:
        cells = []
        for task, _ in versions:
            own = [row for row in rows if all(row[key] == one[key] for key in KEYS[:2]) and row["task"] == task.name]
            means = [f"{statistics.mean(row[key] for row in own):.2f}" for key in ("score", "longer")] if own else []
            cells.append(" → ".join(means))
        lines.append(" | ".join([f"| `{one['agent']}`", one["size"], *cells]) + " |")
    return lines


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
    parser.add_argument("--best", type=Path, help="folder to export the best agent of each task to, for the page")
    args = parser.parse_args()
    track = read(args.track)
    tasks, agents = args.tasks or track["tasks"], args.agents or track["agents"]
    written = experiment(track, tasks, agents, args.sizes)
    args.out.mkdir(parents=True, exist_ok=True)
    file = args.out / f"{args.track}.json"
    atomic.write(file, json.dumps(written, indent=1) + "\n")
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
    done: dict[str, list[tuple[float, Job]]] = {}
    for job in planning.jobs_of(definitions.load(str(file)), args.out, planning.read_scale(args.scale), seeds):
        if job.state() == "done":
            task, agent, size = named[job.run.name]
            found = row(job, TASKS[task], Path(agent).name, size)
            rows[tuple(found[key] for key in KEYS)] = found
            done.setdefault(task, []).append((found["score"], job))
    machine = {
        "machine": platform.processor() or platform.machine(),
        "cores": _native.cores(),
        "torch": torch.__version__,
    }
    lines = ",\n".join(json.dumps(rows[key]) for key in sorted(rows, key=str))
    summary = ",\n".join(map(json.dumps, summaries(track, list(rows.values()))))
    atomic.write(
        results,
        f'{{"track": {json.dumps(args.track)}, "machine": {json.dumps(machine)}, "summary": [\n{summary}\n], "rows": [\n'
        f"{lines}\n]}}\n",
    )
    atomic.write(results.with_name(f"{results.name.partition('.')[0]}.md"), table(track, list(rows.values())))
    print(f"{len(rows)} rows in {results}")
    if args.best is not None:
        export_best(done, args.best)
    if failure is not None:
        raise SystemExit(str(failure))


if __name__ == "__main__":
    main()
