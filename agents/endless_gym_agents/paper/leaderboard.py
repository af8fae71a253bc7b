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
import itertools
import json
import platform
import re
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro

from endless_gym import _native
from endless_gym.specs import spec
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import atomic, command, regular, tables
from endless_gym_agents.common.ranges import Natural, Range
from endless_gym_agents.evaluation import compare, export, protocol, ruler
from endless_gym_agents.evaluation.compare import Comparison
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.evaluation.ruler import TASKS, Task
from endless_gym_agents.paper import jobs_ray, reproduce
from endless_gym_agents.paper.experiments import definitions, planning
from endless_gym_agents.paper.experiments.planning import Job
from endless_gym_agents.settings import Environment
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress

#: The tracks of the package, each with its rows.
TRACKS = Path(__file__).parent / "tracks"
#: Agents without memory have one size.
MEMORYLESS = ("none", "position")
#: The columns that identify a row.
KEYS = ("agent", "size", "task", "seed")
Flags = dict[str, Any]


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


@dataclass(frozen=True)
class Entry:
    """An agent of a track.

    Attributes:
        name: Name in the table.
        flags: Flags of its runs, with `agent`.
        observable: Whether it trains on the fully observable twins of the tasks, where there are any.
    """

    name: str
    flags: Flags
    observable: bool = False

    @property
    def agent(self) -> str:
        """As --agent of `endless-train` takes it."""
        return str(self.flags["agent"])


@dataclass(frozen=True)
class Track:
    """Tasks, agents and what their runs share.

    Attributes:
        name: Name.
        about: A paragraph about the runs.
        tasks: The tasks by name.
        zeros: Scores that become 0, of the tasks where they are not the mean of the runs of `none`.
        agents: The agents by name.
        seeds: Seeds of the runs.
        flags: Flags of all runs.
        task_flags: Flags of the runs of a task, by its name.
        sizes: Flags by size and agent, or `other` for the agents that are not named; empty for one size.
        evaluation: As in an experiment of `endless-reproduce`.
        tuning: How the flags of each agent are chosen; empty for no choice.
        published: Results of others, each with its `source`, what it has `found`, and which `agents` of the track it compares.
        rows: The rows, and the trials of the tuning by agent and size, that the package has.
    """

    name: str
    about: str
    tasks: dict[str, Task]
    zeros: dict[str, float]
    agents: dict[str, Entry]
    seeds: tuple[int, ...]
    flags: Flags
    task_flags: dict[str, Flags]
    sizes: dict[str, dict[str, Flags]]
    evaluation: dict[str, int]
    tuning: dict[str, Any]
    published: list[dict[str, Any]]
    rows: dict[str, Any]

    def run(self, task: Task, entry: Entry, size: str, chosen: Mapping[str, Any] | None = None) -> tuple[Task, Flags]:
        """The task, or its fully observable twin, and the flags of a run of it."""
        own = task.flags()
        if entry.observable and (twin := task.twin()):
            task, own = dataclasses.replace(task, env=twin[0], longer=None), twin[1]
        flags = self.flags | own | self.task_flags.get(task.name, {})
        # The flags of a size are those of the agent, or of all others.
        flags |= {} if size == "-" else self.sizes[size].get(entry.agent, self.sizes[size]["other"])
        return task, flags | entry.flags | dict(chosen or {})

    def sized(self, entries: Sequence[Entry], sizes: Sequence[str]) -> list[tuple[Entry, str]]:
        """Agents with each size in which they are trained."""
        return [
            (entry, size)
            for entry in entries
            for size in (("-",) if entry.agent in MEMORYLESS or not self.sizes else sizes)
        ]


def read(name: str) -> Track:
    """A track of the package by name, or one from a file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: There is no such track, or the file is invalid.
    """
    known = sorted(file.stem for file in TRACKS.glob("*.json") if "." not in file.stem)
    file = Path(name) if name.endswith(".json") else TRACKS / f"{name}.json"
    if not name.endswith(".json") and name not in known:
        raise ValueError(f"track must be one of {', '.join(known)}, or a JSON file; got `{name}`")
    where = f"track {file.stem}"
    try:
        given = json.loads(regular.text(file))
    except json.JSONDecodeError as error:
        raise ValueError(f"{where}: not JSON: {error}") from None
    fields = [
        field.name.replace("_", "-")
        for field in dataclasses.fields(Track)
        if field.name not in ("name", "zeros", "rows")
    ]
    needed = ("tasks", "agents", "seeds", "flags")
    given = {key.replace("_", "-"): value for key, value in given.items()}
    if wrong := [key for key in given if key not in fields] or [key for key in needed if not given.get(key)]:
        raise ValueError(f"{where}: `{wrong[0]}` is unknown, missing or empty; allowed: {', '.join(fields)}")
    tasks = [_task(each, where) for each in given["tasks"]]
    zeros = {each["name"]: float(each["zero"]) for each in given["tasks"] if isinstance(each, dict) and "zero" in each}
    rows = file.with_name(f"{file.stem}.results.json")
    return Track(
        file.stem,
        given.get("about", ""),
        {task.name: task for task in tasks},
        zeros,
        {entry.name: entry for entry in (_entry(each, where) for each in given["agents"])},
        tuple(given["seeds"]),
        given["flags"],
        given.get("task-flags", {}),
        given.get("sizes", {}),
        {"interval": 1_000_000, **given.get("evaluation", {})},
        given.get("tuning", {}),
        [_checked(each, "source", ("found", "agents"), where) for each in given.get("published", [])],
        json.loads(rows.read_text()) if rows.exists() else {},
    )


def _checked(given: Any, needed: str, allowed: Sequence[str], where: str) -> dict[str, Any]:
    if not isinstance(given, dict) or needed not in given or not set(given) <= {needed, *allowed}:
        raise ValueError(
            f"{where}: must be a name, or an object with `{needed}` and some of {', '.join(allowed)}; got {given}"
        )
    return given


def _named(name: str, where: str) -> str:
    if not re.fullmatch(r"[\w.:=+-]+", name):
        raise ValueError(f"{where}: a name has letters, digits and any of `_.:=+-`, got `{name}`")
    return name


def _task(given: Any, where: str) -> Task:
    """A task of the ruler by name, or one of your own."""
    if isinstance(given, str):
        if given not in TASKS:
            raise ValueError(f"{where}: a task must be an object, or one of {', '.join(TASKS)}; got `{given}`")
        return TASKS[given]
    one = _checked(given, "env", ("name", "options", "zero", "expert", "observable"), f"{where}, tasks")
    try:
        env = spec(one["env"]).full_id
        name, options = _named(one.get("name", re.sub("[?&,]", "_", env)), where), tuple(one.get("options", ()))
        task = Task(name, "object", env, 0.0, 0.0, options, observable=one.get("observable"))
        return dataclasses.replace(task, expert=float(one.get("expert") or ruler.mean_return(task, expert=True)))
    except ValueError as error:
        raise ValueError(
            f"{where}, task {one.get('name', one['env'])}: {error}; without an expert, `expert` has its return"
        ) from None


def _entry(given: Any, where: str = "--agents") -> Entry:
    """An agent: as --agent of `endless-train` takes it, or with a name and flags of its own."""
    if isinstance(given, str):
        # A name is a folder.
        return Entry(_named(Path(given).name, where), {"agent": given})
    one = _checked(given, "name", ("agent", "flags", "observable"), f"{where}, agents")
    flags = {"agent": one.get("agent", one["name"])} | one.get("flags", {})
    return Entry(_named(one["name"], where), flags, bool(one.get("observable")))


def trials(track: Track, entry: Entry, own: Mapping[str, Sequence[Any]] | None = None) -> list[Flags]:
    """The flags of an agent's trials: the first choices, and then random ones.

    What is common is drawn alike for all agents, but a configuration that an agent already has is drawn anew.

    Args:
        track: The track.
        entry: The agent.
        own: Choices for settings of a memory that the track does not name.
    """
    tuning = track.tuning
    of = tuning.get("of", {})
    own = tuning.get("own", {}).get(entry.agent, {} if entry.agent in track.agents else own or {})
    space = tuning["space"] | ({} if entry.agent in MEMORYLESS else of.get(entry.agent, of.get("other", {}))) | own
    found = [{name: choices[0] for name, choices in space.items()}]
    most = min(tuning["trials"], int(np.prod([len(choices) for choices in space.values()])))
    numbers = itertools.count()
    while len(found) < most:
        generator = np.random.default_rng(next(numbers))
        drawn = {name: choices[int(generator.random() * len(choices))] for name, choices in space.items()}
        found += [] if drawn in found else [drawn]
    return found


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
    failure = None
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
    jobs = planning.jobs_of(definitions.load(str(file)), arguments.out, scale, seeds)
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
    own, task = json.loads(arguments.own or "{}"), _task(track.tuning["task"], f"track {track.name}, tuning")
    if task.name in track.tasks:
        raise ValueError(f"track {track.name}: agents must be tuned on a task outside of the table, got {task.name}")
    planned = {(entry.name, size): trials(track, entry, own) for entry, size in left}
    runs = {
        f"{entry.name} {size} trial-{number}": track.run(task, entry, size, track.tuning.get("flags", {}) | flags)
        for entry, size in left
        for number, flags in enumerate(planned[entry.name, size])
    }
    done, failure = trained(track, "tuning", runs, [track.tuning.get("seed", 0)], arguments)
    results = {job.run.name: row(job, task) for job in done}
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
        known = [run for run in runs if run[1].run.flags["agent"] in _native.PAGE_AGENTS]
        if not known or known[0][1].run.env.startswith("popgym"):
            print(f"{task}: no agent that the page can compute")
            continue
        score, job = max(known, key=lambda run: run[0])
        print(f"{task}: {job.run.flags['agent']} with seed {job.seed}, mean return {score:.3f}")
        export.execute(export.ExportArguments(job.folder, out=folder / f"{task}.safetensors"))


def compared(track: Track, rows: Sequence[Mapping[str, Any]], where: Path) -> Comparison:
    """The comparison of the rows of a track, in the tasks whose zero is known.

    Raises:
        ValueError: There is no such task.
    """
    scores = [compare.of_row(one, where) for one in rows]
    known = {one.task for one in scores if one.agent == "none"} | track.zeros.keys()
    scores = [one for task in track.tasks for one in scores if one.task == task and task in known]
    if not scores:
        raise ValueError("a table needs the runs of `none` in a task, or a `zero` of the task: add `none` to --agents")
    given = [
        f"{name}={zero},{track.tasks[name].expert}"
        for name, zero in track.zeros.items()
        if name in {one.task for one in scores}
    ]
    return Comparison(
        scores, compare.ranges_of(scores, {name: task.expert for name, task in track.tasks.items()}, given)
    )


def page(track: Track, rows: Sequence[Mapping[str, Any]], comparison: Comparison, tuning: Mapping[str, Any]) -> str:
    """The page of a track, Markdown."""
    lines = [f"# Memories: {track.name} track", "", track.about, ""]
    if tuning:
        number = max(len(one["trials"]) for one in tuning.values())
        lines += [f"Each agent was tuned with up to {number} configurations on a task outside of the table.", ""]
    else:
        lines += ["Each row is one untuned configuration: the table does not say which memory is best.", ""]
    lines += [
        "The expert sees the whole state, so the optimality gap is that to the fully observable task. Acting and learning are",
        "environment steps per second in that phase of training, in the run that other work disturbed least; they depend on the",
        "machine.",
        "",
        "![comparison](comparison.svg)",
        "",
        *(answers(track, comparison) if tuning else ()),
        *orders(track, comparison),
        *compare.markdown(comparison, "## Agents"),
        *longer_table(track, rows),
    ]
    # Each agent that trains on the twins, and the same agent in the tasks.
    agents = track.agents.values()
    pairs = [
        (twin, one)
        for twin in agents
        if twin.observable
        for one in agents
        if (one.flags, one.observable) == (twin.flags, False)
    ]
    gates = []
    for name in comparison.tasks:
        task, zero = track.tasks[name], comparison.ranges[name][0]
        gate, label = ("passed" if task.passes_gate(zero) else "FAILED", task.label) if name in TASKS else ("", "")
        gaps = [gap(comparison, name, twin.name, one.name) for twin, one in pairs]
        gates.append([name, label, f"{task.expert:g}", f"{zero:.3f}", gate, *gaps])
    columns = {"task": False, "measures": False, "expert": True, "`none`": True, "gate": False}
    columns |= {f"gap of `{one.name}`": True for _, one in pairs}
    if pairs:
        lines += [
            "The observability gap is the mean normalised score in the fully observable twin of a task less that in the task.",
            "",
        ]
    return "\n".join([*lines, *tables.markdown(columns, gates)]) + "\n"


def answers(track: Track, comparison: Comparison) -> list[str]:
    """Which memories suit which task, of the tasks with two memories or more; no lines without such a task."""
    others = {entry.name for entry in track.agents.values() if entry.observable or entry.agent in MEMORYLESS}
    rows = []
    for task in comparison.tasks:
        agents = [agent for agent, runs in comparison.scores.items() if agent not in others and task in runs]
        if len(agents) < 2:
            continue
        best, *rest = found = comparison.contenders(task, agents)
        cost = {agent: comparison.costs(agent).get("core_seconds", 0.0) for agent in found}
        cheapest = min(found, key=cost.__getitem__)
        named = f"`{best}` {comparison.mean(best, task):.2f}", ", ".join(f"`{agent}`" for agent in rest)
        rows.append([task, track.tasks[task].label, *named, f"`{cheapest}` {cost[cheapest]:.0f}"])
    columns = {"task": False, "measures": False, "highest normalised mean": False, "not shown to be worse": False}
    if not rows:
        return []
    return [
        "## Which memory for which task",
        "",
        "An agent is not shown to be worse if the 95 % interval of the probability that a run of the best scores higher includes",
        "one half. Not known: other budgets, sizes and tasks, frames in place of features, and other configurations.",
        "",
        *tables.markdown(columns | {"cheapest of these, core-seconds": False}, rows),
        "",
    ]


def orders(track: Track, comparison: Comparison) -> list[str]:
    """What others have published, beside the order of the same agents here; no lines without such results."""
    if not track.published:
        return []
    rows = []
    for each in track.published:
        agents, found = each.get("agents", []), comparison.aggregates
        here = ", ".join(f"`{agent}` {found[agent].iqm}" for agent in found if agent in agents)
        missing = ", ".join(f"`{agent}`" for agent in agents if agent not in found)
        rows.append([each["source"], each.get("found", ""), here + (f"; no rows of {missing}" if missing else "")])
    return [
        "## Beside published results",
        "",
        "Observations, tasks, sizes and lengths of training differ, so only orders can be compared.",
        "",
        *tables.markdown({"source": False, "published": False, "interquartile means here": False}, rows),
        "",
    ]


def gap(comparison: Comparison, task: str, twin: str, agent: str) -> str:
    """What the fully observable twin of a task adds to an agent's mean normalised score; empty if runs are missing."""
    means = [comparison.mean(name, task) for name in (twin, agent) if name in comparison.scores]
    known = [mean for mean in means if mean is not None]
    return f"{known[0] - known[1]:.2f}" if len(known) == 2 else ""


def longer_table(track: Track, rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Mean returns in tasks and in their longer versions; no lines if no task has one."""
    versions = [
        (task, " ".join(task.longer[1]) or task.longer[0]) for task in track.tasks.values() if task.longer is not None
    ]
    if not versions:
        return []
    named = [(compare.of_row(one, Path()).agent, one) for one in rows]

    def means(name: str, task: str) -> str:
        own = [one for agent, one in named if (agent, one["task"]) == (name, task) and one["longer"] is not None]
        return " → ".join(f"{statistics.mean(one[key] for one in own):.2f}" for key in ("score", "longer") if own)

    shown = [[name, *(means(name, task.name) for task, _ in versions)] for name in dict.fromkeys(n for n, _ in named)]
    about = "Mean returns in a task, and after the arrow in a longer version of it, in which the agent did not train:"
    columns = ["agent", *(f"{task.name} → `{version}`" for task, version in versions)]
    return [about, "", *compare.markdown_table(columns, shown), ""]


def execute(arguments: LeaderboardArguments) -> None:
    """Train, evaluate and write.

    Raises:
        ValueError: An argument is invalid, or runs have failed; the table has the others.
    """
    track = read(arguments.track)
    if wrong := [name for name in arguments.tasks if name not in track.tasks]:
        raise ValueError(f"--tasks must be among {', '.join(track.tasks)}, got `{wrong[0]}`")
    if wrong := [size for size in arguments.sizes if track.sizes and size not in track.sizes]:
        raise ValueError(f"--sizes must be among {', '.join(track.sizes)}, got `{wrong[0]}`")
    command.check_installed("a comparison", "matplotlib")
    entries = [track.agents.get(name) or _entry(name) for name in arguments.agents] or list(track.agents.values())
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
