"""Tracks: JSON files that say what `endless-leaderboard` compares."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from endless_gym.specs import spec
from endless_gym_agents.common import regular
from endless_gym_agents.evaluation import ruler
from endless_gym_agents.evaluation.ruler import TASKS, Task

#: The tracks of the package, each with its rows.
TRACKS = Path(__file__).parent / "tracks"
#: Agents without memory have one size.
MEMORYLESS = ("none", "position")
Flags = dict[str, Any]


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


def read_track(name: str) -> Track:
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
    tasks = [read_task(each, where) for each in given["tasks"]]
    zeros = {each["name"]: float(each["zero"]) for each in given["tasks"] if isinstance(each, dict) and "zero" in each}
    rows = file.with_name(f"{file.stem}.results.json")
    return Track(
        file.stem,
        given.get("about", ""),
        {task.name: task for task in tasks},
        zeros,
        {entry.name: entry for entry in (read_agent(each, where) for each in given["agents"])},
        tuple(given["seeds"]),
        given["flags"],
        given.get("task-flags", {}),
        given.get("sizes", {}),
        {"interval": 1_000_000, **given.get("evaluation", {})},
        given.get("tuning", {}),
        [_checked(each, "source", ("found", "agents"), f"{where}, published") for each in given.get("published", [])],
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


def read_task(given: Any, where: str) -> Task:
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


def read_agent(given: Any, where: str = "--agents") -> Entry:
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
