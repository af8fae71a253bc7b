"""The page of a track: its answers, its tables, and what others have published."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from endless_gym_agents.common import tables
from endless_gym_agents.evaluation import compare
from endless_gym_agents.evaluation.compare import Comparison
from endless_gym_agents.evaluation.ruler import TASKS
from endless_gym_agents.paper.track import MEMORYLESS, Track


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
        "environment steps per second in that phase of training; they and the core-seconds are those of the run that other",
        "work on the machine disturbed least.",
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
        "## Compared with published results",
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

    agents = dict.fromkeys(agent for agent, one in named if one["longer"] is not None)
    shown = [[name, *(means(name, task.name) for task, _ in versions)] for name in agents]
    about = "Mean returns in a task, and after the arrow in a longer version of it, in which the agent did not train:"
    columns = ["agent", *(f"{task.name} → `{version}`" for task, version in versions)]
    return [about, "", *compare.markdown_table(columns, shown), ""]
