"""`endless-leaderboard`: train and evaluate agents on the tasks of a track, and write a table to cite.

A track is a JSON file: tasks, agents, seeds, the flags that all runs share, and how agents are tuned; the page "From idea to
table" of the documentation describes it. Each run is one `endless-train` and one `endless-eval`. The same command again resumes
what was interrupted and skips what is done. A track of the package comes with rows, to which the runs of other agents are added.

```console
endless-leaderboard million                                    # everything, as many runs at a time as there are cores
endless-leaderboard million --agents own.py:Mine               # a memory of your own among those of the table
endless-leaderboard mine.json                                  # a track of your own
endless-leaderboard million --table                            # only the table, from the runs so far
```
"""

from __future__ import annotations

import dataclasses
import json
import platform
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from endless_gym import _native
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import atomic, command
from endless_gym_agents.common.ranges import Natural, Range
from endless_gym_agents.evaluation import compare, export, protocol
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS, evaluate, mean
from endless_gym_agents.evaluation.ruler import Task
from endless_gym_agents.paper import jobs_ray, reproduce
from endless_gym_agents.paper.experiments import definitions, planning
from endless_gym_agents.paper.experiments.planning import Job
from endless_gym_agents.paper.track import Entry, Flags, Track, read_agent, read_task, read_track, trials
from endless_gym_agents.paper.track_page import compared, page
from endless_gym_agents.settings import Environment
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress

#: The columns that identify a row.
KEYS = ("agent", "size", "task", "seed")


@dataclass(frozen=True)
class LeaderboardArguments:
    """Arguments of `endless-leaderboard`."""

    track: tyro.conf.Positional[str]
    """name of a track of the package, or a JSON file"""
    agents: tuple[str, ...] = ()
    """agents, by their names in the track or as --agent of `endless-train` takes them; by default those of the track"""
    tasks: tuple[str, ...] = ()
    """tasks; by default those of the track"""
    sizes: tuple[str, ...] = ("gru",)
    """sizes of the agents, if the track has several"""
    seeds: Annotated[tuple[int, ...], Range(0)] = ()
    """seeds of the runs; by default those of the track"""
    own: str = ""
    """in a track that tunes: choices for settings of memories of your own, as JSON, such as
    {"agent-option": [["width=1"], ["width=2"]]}"""
    jobs: Natural = 0
    """runs at the same time; 0 for one per GPU, or without GPUs one per core"""
    device: str = "auto"
    """`cpu`, `cuda`, ...; `auto` for CUDA if available, else the CPU"""
    ray: str = ""
    """run on Ray, as for `endless-reproduce`"""
    out: Path = Path("leaderboard")
    """folder of the runs, and of a folder with the table"""
    scale: str = "1"
    """a smaller version, for a try, as for `endless-reproduce`"""
    table: bool = False
    """train nothing, and write the table"""
    best: Path | None = None
    """export the best agent of each task of Memory Gym to this folder, for the page"""


def experiment(track: Track, runs: Mapping[str, tuple[Task, Flags]]) -> dict[str, Any]:
    """The experiment of `endless-reproduce` with runs by name."""
    written = {"title": f"{track.name} track", "section": "-", "about": track.about, "kind": "curves", "seeds": 1}
    listed = [{"name": name, "env": task.env, "flags": flags} for name, (task, flags) in runs.items()]
    return written | {"evaluation": track.evaluation, "runs": listed}


def trained(
    track: Track,
    name: str,
    runs: Mapping[str, tuple[Task, Flags]],
    seeds: Sequence[int],
    arguments: LeaderboardArguments,
) -> tuple[list[Job], ValueError | None]:
    """Train and evaluate runs, unless only the table is wanted; the jobs that are done, and why others have failed."""
    arguments.out.mkdir(parents=True, exist_ok=True)
    file = arguments.out / f"{track.name}.{name}.json"
    atomic.write(file, json.dumps(experiment(track, runs), indent=1) + "\n")
    # Read at once: another command with the same folder may write its own runs meanwhile.
    defined, failure = definitions.load(str(file)), None
    if not arguments.table:
        given = reproduce.ReproduceArguments(
            names=(str(file),),
            out=arguments.out,
            scale=arguments.scale,
            seeds=tuple(seeds),
            jobs=arguments.jobs,
            device=arguments.device,
            ray=arguments.ray,
        )
        try:
            reproduce.execute(given)
        except ValueError as error:  # Some runs failed; the others have rows.
            failure = error
    scale = planning.read_scale(arguments.scale)
    jobs = planning.jobs_of(defined, arguments.out, scale, seeds)
    return [job for job in jobs if job.state() == "done"], failure


def tuned(track: Track, entries: Sequence[Entry], data: dict[str, Any], arguments: LeaderboardArguments) -> None:
    """Run the trials of the agents that have none in `data`, and add them with the number of the best.

    Raises:
        ValueError: Trials have failed, or are missing.
    """
    pairs = track.sized(entries, arguments.sizes)
    left = [(entry, size) for entry, size in pairs if f"{entry.name} {size}" not in data["tuning"]]
    if not left:
        return
    own, task = json.loads(arguments.own or "{}"), read_task(track.tuning["task"], f"track {track.name}, tuning")
    if task.name in track.tasks:
        raise ValueError(f"track {track.name}: agents must be tuned on a task outside of the table, got {task.name}")
    planned = {(entry.name, size): trials(track, entry, own) for entry, size in left}
    runs = {
        f"{entry.name} {size} trial-{number}": track.run(task, entry, size, track.tuning.get("flags", {}) | flags)
        for entry, size in left
        for number, flags in enumerate(planned[entry.name, size])
    }
    done, failure = trained(track, "tuning", runs, [track.tuning.get("seed", 0)], arguments)
    results = {job.run.name: row(job, runs[job.run.name][0]) for job in done}
    for (name, size), flags in planned.items():
        found = [results.get(f"{name} {size} trial-{number}") for number in range(len(flags))]
        if any(one is None for one in found):
            raise failure or ValueError(f"trials of {name} are missing; repeat the command without --table")
        rows = [
            {"flags": chosen} | {key: one[key] for key in ("score", "steps", "core_seconds")}
            for chosen, one in zip(flags, found, strict=True)
            if one is not None
        ]
        best = max(range(len(rows)), key=lambda number: float(rows[number]["score"]))
        data["tuning"][f"{name} {size}"] = {"task": task.name, "best": best, "trials": rows}


def row(job: Job, task: Task) -> dict[str, Any]:
    """The results of a run that is done."""
    file = job.folder / "row.json"
    if file.exists():
        return dict(json.loads(file.read_text()))
    loaded = checkpoint.load(job.folder)
    (results,) = json.loads((job.folder / planning.EVALUATION).read_text())["experiments"]
    progress = read_progress(job.folder)
    per_update = loaded.settings.environment.num_envs * loaded.settings.ppo.steps

    def speed(phase: str) -> int:
        return round(per_update / statistics.median(float(line[f"seconds/{phase}"]) for line in progress))

    found = {
        "seed": job.seed,
        "score": round(float(results["runs"][0]["metrics"]["reward"][-1]), 5),
        "longer": None
        if task.longer is None
        else round(longer(loaded.agent, task, job.experiment.evaluation.seeds), 5),
        "acting": speed("inference"),
        "learning": speed("learning"),
        "steps": loaded.steps,
    } | protocol.cost(loaded, job.folder)
    atomic.write(file, json.dumps(found) + "\n")
    return found


def longer(agent: Agent, task: Task, seeds: int) -> float:
    """Mean return in the longer version of a task."""
    assert task.longer is not None
    env, options = task.longer
    environment: Environment = dataclasses.replace(agent.settings.environment, option=options)
    settings = dataclasses.replace(agent.settings, env=env, environment=environment)
    chosen = range(EVALUATION_SEEDS.start, EVALUATION_SEEDS.start + seeds)
    return mean(evaluate(agent, chosen, 1, num_threads=1, settings=settings))


def export_best(done: dict[str, list[tuple[float, Job]]], folder: Path) -> None:
    """Write the best agent of each task, among those that the page can compute, as TASK.safetensors.

    Args:
        done: Scores and runs of each task.
        folder: Folder to write to; made if it does not exist.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for task, runs in done.items():
        known = [run for run in runs if run[1].run.flags["agent"] in _native.PAGE_AGENTS]
        if not known or known[0][1].run.env.startswith("popgym"):
            print(f"{task}: no agent that the page can compute")
            continue
        score, job = max(known, key=lambda run: run[0])
        print(f"{task}: {job.run.flags['agent']} with seed {job.seed}, mean return {score:.3f}")
        export.execute(export.ExportArguments(job.folder, out=folder / f"{task}.safetensors"))


def execute(arguments: LeaderboardArguments) -> None:
    """Train, evaluate and write.

    Raises:
        ValueError: An argument is invalid, or runs have failed; the table has the others.
    """
    track = read_track(arguments.track)
    if wrong := [name for name in arguments.tasks if name not in track.tasks]:
        raise ValueError(f"--tasks must be among {', '.join(track.tasks)}, got `{wrong[0]}`")
    if wrong := [size for size in arguments.sizes if track.sizes and size not in track.sizes]:
        raise ValueError(f"--sizes must be among {', '.join(track.sizes)}, got `{wrong[0]}`")
    command.check_installed("a comparison", "matplotlib")
    entries = [track.agents.get(name) or read_agent(name) for name in arguments.agents] or list(track.agents.values())
    scale = planning.read_scale(arguments.scale)
    folder = planning.folder_of(arguments.out, scale) / track.name
    results = folder / "results.json"
    # Those of the package have another budget than a smaller version.
    data = json.loads(results.read_text()) if results.exists() else track.rows if scale == 1 else {}
    data = {"rows": data.get("rows", []), "tuning": data.get("tuning", {})}
    if track.tuning:
        tuned(track, entries, data, arguments)
    named, runs = {}, {}
    for task in (track.tasks[name] for name in arguments.tasks or track.tasks):
        for entry, size in track.sized(entries, arguments.sizes):
            if entry.observable and task.twin() is None:
                continue
            tuning = data["tuning"].get(f"{entry.name} {size}")
            chosen = tuning["trials"][tuning["best"]]["flags"] if tuning else {}
            name = f"{task.name} {entry.name} {size}"
            spent = {"tuning_core_seconds": sum(one["core_seconds"] for one in tuning["trials"])} if tuning else {}
            runs[name] = track.run(task, entry, size, chosen)
            named[name] = (
                runs[name][0],
                entry.observable,
                {"agent": entry.name, "size": size, "task": task.name} | spent,
            )
    torch.set_num_threads(1)
    jobs, failure = trained(track, "runs", runs, arguments.seeds or track.seeds, arguments)
    rows = {tuple(one[key] for key in KEYS): one for one in data["rows"]}
    done: dict[str, list[tuple[float, Job]]] = {}
    for job in jobs:
        task, observable, about = named[job.run.name]
        found = about | row(job, task)
        rows[tuple(found[key] for key in KEYS)] = found
        if not observable:
            done.setdefault(task.name, []).append((found["score"], job))
    folder.mkdir(parents=True, exist_ok=True)
    every = [rows[key] for key in sorted(rows, key=str)]
    comparison = compared(track, every, results)
    machine = {
        "machine": platform.processor() or platform.machine(),
        "cores": _native.cores(),
        "torch": torch.__version__,
    }
    parts: Any = {"track": track.name, "machine": machine, "tuning": data["tuning"]}
    lines = ",\n".join(map(json.dumps, every))
    parts = "".join(f'"{name}": {json.dumps(value)}, ' for name, value in parts.items())
    atomic.write(results, f'{{{parts}"rows": [\n{lines}\n]}}\n')
    compare.write(comparison, folder, page(track, every, comparison, data["tuning"]))
    print(f"{len(every)} rows in {results}, and the table in {folder / 'README.md'}")
    if arguments.best is not None:
        export_best(done, arguments.best)
    if failure is not None:
        raise failure


def main() -> int:
    """Entry point of the command `endless-leaderboard`; returns the exit status."""
    given = jobs_ray.with_address(sys.argv[1:])
    return command.main("endless-leaderboard", LeaderboardArguments, execute, __doc__, given)


if __name__ == "__main__":
    sys.exit(main())
