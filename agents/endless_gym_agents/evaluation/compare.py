"""`endless-compare`: compare agents over tasks, with intervals that hold for few seeds.

Reads results of `endless-eval --json`, of `endless-reproduce` and of `endless-leaderboard`. The score of a run is the mean return
of its last evaluated checkpoint, normalised for each task: 0 is the mean of the runs of `none`, without memory, and 1 the
scripted expert; `--range` sets other values.

```console
endless-eval runs --last --json results.json
endless-compare results.json                              # tables and figures in the folder `comparison`
endless-compare results.json --range MyEnv-v0=0,1         # where a task has no runs of `none`, or no expert
endless-compare --coverage                                # how often the intervals cover, simulated
```
"""

from __future__ import annotations

import itertools
import json
import re
import statistics
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import NDArray

from endless_gym.specs import spec
from endless_gym_agents.common import atomic, command, regular, tables
from endless_gym_agents.common.palette import AGENTS
from endless_gym_agents.evaluation import results, ruler
from endless_gym_agents.evaluation import statistics as estimates
from endless_gym_agents.settings import Environment, Settings

#: What a row may say about its cost: name in the files, heading, and how those of an agent's runs are put together.
COSTS: dict[str, tuple[str, Callable[[Sequence[float]], float]]] = {
    "parameters": ("parameters", statistics.median),
    "core_seconds": ("core-seconds of a run", min),
    "tuning_core_seconds": ("core-seconds of tuning", max),
    "state_bytes": ("bytes of state", max),
    "acting": ("acting, steps/s", max),
    "learning": ("learning, steps/s", max),
}
#: Scores at which the performance profile is computed.
THRESHOLDS = np.linspace(0, 1, 51)
#: Most agents whose profiles are drawn.
PROFILES = 6
#: Designs that `--coverage` simulates: tasks and seeds.
DESIGNS = tuple(itertools.product((1, 3, 6, 10), (3, 5, 10)))


@dataclass(frozen=True)
class CompareArguments:
    """Arguments of `endless-compare`."""

    paths: tyro.conf.Positional[tuple[Path, ...]] = ()
    """files of results, or folders: the files of results in a folder or, if it has none, in the folders below it"""
    range: tuple[str, ...] = ()
    """the scores that become 0 and 1 in a task, as TASK=ZERO,ONE, or a JSON file {"TASK": [ZERO, ONE]}; by default the mean of
    the runs of `none`, and the scripted expert"""
    metric: str = "reward"
    """the score: `reward`, the return, or another metric of the results, such as `task_progress`, for which --range is needed"""
    out: Path = Path("comparison")
    """folder of the tables and figures"""
    json: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """also write all numbers to this file; `-` for standard output, instead of the table"""
    coverage: bool = False
    """only simulate how often the intervals cover, for several numbers of tasks and seeds"""


@dataclass(frozen=True)
class Score:
    """The score of a run.

    Attributes:
        agent: Name of the agent.
        task: Name of the task.
        seed: Seed of the training.
        score: Mean over the episodes of its evaluation.
        steps: Environment steps of its training.
        source: Where it comes from.
        cost: Those of `COSTS` that are known.
    """

    agent: str
    task: str
    seed: int
    score: float
    steps: int
    source: str
    cost: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Estimate:
    """An estimate with its 95 % interval; without ends, if there is only one seed."""

    value: float
    low: float | None = None
    high: float | None = None

    def __str__(self) -> str:
        # Without the sign of a rounded zero.
        value, *ends = (f"{round(one, 2) + 0.0:.2f}" for one in (self.value, self.low, self.high) if one is not None)
        return f"{value} [{', '.join(ends)}]" if ends else value


@dataclass(frozen=True)
class Aggregate:
    """The estimates of an agent over all tasks.

    Attributes:
        seeds: Number of runs in each task.
        iqm: Interquartile mean of the normalised scores.
        gap: Optimality gap: mean of max(0, 1 - score).
        profile: Share of the scores above each of `THRESHOLDS`.
    """

    seeds: int
    iqm: Estimate
    gap: Estimate
    profile: list[Estimate]


@dataclass(frozen=True)
class Pair:
    """The probability that a run of the first agent scores higher than one of the second."""

    first: str
    second: str
    probability: Estimate

    @property
    def is_claim(self) -> bool:
        """Whether the interval excludes one half."""
        low, high = self.probability.low, self.probability.high
        return low is not None and high is not None and not low <= 0.5 <= high


class Comparison:
    """Scores of agents in tasks, and what they show.

    Attributes:
        tasks: Names of the tasks.
        ranges: The scores that become 0 and 1 in each task.
        scores: Scores by agent, task and seed.
        steps: Environment steps of the runs of each task.
        aggregates: Estimates of the agents that have the same seeds in all tasks, the best first.
        pairs: The probability of improvement of each of these over each that follows.
        coverage: How often the intervals cover for the smallest number of seeds, simulated; empty with one seed.
    """

    def __init__(self, rows: Sequence[Score], ranges: Mapping[str, tuple[float, float]]) -> None:
        """Compare.

        Args:
            rows: The scores of all runs.
            ranges: The scores that become 0 and 1, by task.

        Raises:
            ValueError: There are no scores, two of the same agent, task and seed, or runs of different lengths in a task; or the
                range of a task is missing or empty.
        """
        if not rows:
            raise ValueError("there are no scores to compare")
        self.tasks = list(dict.fromkeys(row.task for row in rows))
        self.rows = list(rows)
        self.scores: dict[str, dict[str, dict[int, float]]] = {}
        sources: dict[tuple[str, str, int], str] = {}
        for row in rows:
            if (key := (row.agent, row.task, row.seed)) in sources:
                raise ValueError(
                    f"two runs of {row.agent} in {row.task} have the seed {row.seed}: {sources[key]} and {row.source}; compare "
                    "one of them"
                )
            sources[key] = row.source
            self.scores.setdefault(row.agent, {}).setdefault(row.task, {})[row.seed] = row.score
        self.steps = {task: _budget(task, rows) for task in self.tasks}
        for task in self.tasks:
            if task not in ranges or ranges[task][0] == ranges[task][1]:
                got = f"got {ranges[task]}" if task in ranges else "it has none"
                raise ValueError(
                    f"{task} needs two different scores that become 0 and 1: --range '{task}=ZERO,ONE'; {got}"
                )
        self.ranges = {task: ranges[task] for task in self.tasks}
        found = {agent: table for agent in self.scores if (table := self.table(agent)) is not None}
        self.aggregates = dict(
            sorted(((agent, _aggregate(table)) for agent, table in found.items()), key=lambda one: -one[1].iqm.value)
        )
        self.pairs = [_pair(a, b, found[a], found[b]) for a, b in itertools.combinations(self.aggregates, 2)]
        fewest = min((one.seeds for one in self.aggregates.values()), default=1)
        self.coverage = estimates.coverage(fewest, len(self.tasks), 500) if fewest > 1 else []

    def normalised(self, task: str, score: float) -> float:
        """A score between those that become 0 and 1."""
        zero, one = self.ranges[task]
        return (score - zero) / (one - zero)

    def table(self, agent: str) -> NDArray[np.float64] | None:
        """Normalised scores (seeds, tasks) of an agent; None if a run is missing."""
        own = self.scores[agent]
        seeds = sorted({seed for scores in own.values() for seed in scores})
        if any(set(own.get(task, ())) != set(seeds) for task in self.tasks):
            return None
        return np.array([[self.normalised(task, own[task][seed]) for task in self.tasks] for seed in seeds])

    def mean(self, agent: str, task: str) -> float | None:
        """Mean normalised score of an agent in a task; None without runs."""
        scores = self.scores[agent].get(task)
        return self.normalised(task, statistics.mean(scores.values())) if scores else None

    def contenders(self, task: str, agents: Sequence[str]) -> list[str]:
        """Those of some agents with runs in a task that the best by its mean, the first, is not shown to be better than."""
        scores = {agent: np.array([*self.scores[agent][task].values()])[:, np.newaxis] for agent in agents}
        best, *others = sorted(scores, key=lambda agent: -scores[agent].mean())
        return [best, *(other for other in others if not _pair(best, other, scores[best], scores[other]).is_claim)]

    def agents(self) -> list[str]:
        """All agents: those with all runs, the best first, and then the others."""
        return [*self.aggregates, *(agent for agent in self.scores if agent not in self.aggregates)]

    def costs(self, agent: str) -> dict[str, float]:
        """What the runs of an agent cost, as far as it is known, by the names of `COSTS`."""
        own = {name: [row.cost[name] for row in self.rows if row.agent == agent and name in row.cost] for name in COSTS}
        return {name: float(COSTS[name][1](values)) for name, values in own.items() if values}

    def to_json(self) -> dict[str, Any]:
        """All numbers, JSON-serialisable."""
        return {
            "tasks": {task: {"steps": self.steps[task], "range": list(self.ranges[task])} for task in self.tasks},
            "agents": {
                agent: (asdict(self.aggregates[agent]) if agent in self.aggregates else {})
                | {"scores": self.scores[agent], "cost": self.costs(agent)}
                for agent in self.agents()
            },
            "thresholds": THRESHOLDS.round(2).tolist(),
            "improvement": [asdict(pair) for pair in self.pairs],
            "coverage": [asdict(one) for one in self.coverage],
        }

    def claims(self) -> list[str]:
        """Sentences about the pairs whose interval of the probability of improvement excludes one half."""
        better: dict[str, list[str]] = {}
        for pair in self.pairs:
            if pair.is_claim:
                p = pair.probability
                first, second = (pair.first, pair.second) if p.value > 0.5 else (pair.second, pair.first)
                shown = p if p.value > 0.5 else Estimate(1 - p.value, 1 - (p.high or 0), 1 - (p.low or 0))
                seeds = " and ".join(str(self.aggregates[agent].seeds) for agent in (first, second))
                better.setdefault(first, []).append(f"`{second}` with {shown} ({seeds} seeds)")
        return [f"`{first}` is better than {', '.join(others)}." for first, others in better.items()]

    def note(self) -> str:
        """How the intervals were made, and how often they cover."""
        if not self.coverage:
            return "One seed: there are no intervals, and no agent can be said to be better."
        fewest = min(one.seeds for one in self.aggregates.values())

        def share(name: str) -> str:
            values = [round(100 * getattr(one, name)) for one in self.coverage]
            return f"{min(values)} to {max(values)} %" if min(values) < max(values) else f"{values[0]} %"

        tasks = f"each of {len(self.tasks)} tasks" if len(self.tasks) > 1 else "one task"
        return (
            f"Intervals of nominally 95 %. In simulations with {fewest} seeds in {tasks}, those of the interquartile mean cover "
            f"{share('iqm')}, those of the optimality gap {share('gap')}, and those of the probability of improvement between "
            f"equal agents {share('improvement')}, depending on what the scores are like; percentile bootstrap intervals of the "
            f"interquartile mean would cover {share('percentile')}. The tasks, and the scores that become 0 and 1, are taken "
            "as they are."
        )


def _budget(task: str, rows: Sequence[Score]) -> int:
    """Steps of all runs of a task."""
    found: dict[int, list[str]] = {}
    for row in rows:
        if row.task == task and row.agent not in found.setdefault(row.steps, []):
            found[row.steps].append(row.agent)
    if len(found) > 1:
        each = "; ".join(f"{steps:,} steps of {', '.join(agents)}" for steps, agents in sorted(found.items()))
        raise ValueError(f"unequal budgets in {task}: {each}; train all for as long, with --no-stop-when-learnt")
    return next(iter(found))


def _aggregate(table: NDArray[np.float64]) -> Aggregate:
    seeds = len(table)

    def estimated(estimator: estimates.Estimator) -> Estimate:
        value = float(estimator(table.reshape(1, -1))[0])
        return Estimate(value, *(estimates.interval(table, estimator) if seeds > 1 else ()))

    shares = [float((table > threshold).mean()) for threshold in THRESHOLDS]
    profile = [Estimate(share, *(estimates.wilson(share, table.size) if seeds > 1 else ())) for share in shares]
    return Aggregate(seeds, estimated(estimates.interquartile_means), estimated(estimates.optimality_gaps), profile)


def _pair(a: str, b: str, first: NDArray[np.float64], second: NDArray[np.float64]) -> Pair:
    seeds, other, probability = len(first), len(second), estimates.improvement(first, second)
    ends = estimates.improvement_interval(probability, seeds, other, first.shape[1]) if min(seeds, other) > 1 else ()
    return Pair(a, b, Estimate(probability, *ends))


def task_name(env: str, options: Mapping[str, Any]) -> str:
    """Name of a task: that of the ruler, or else the environment with its reset parameters."""
    for task in ruler.TASKS.values():
        if (task.env, Settings(environment=Environment(option=task.options)).options()) == (env, dict(options)):
            return task.name
    return " ".join([env, *command.assignments(options)])


def read_scores(paths: Sequence[Path], metric: str = "reward") -> tuple[list[Score], dict[str, float]]:
    """Read the scores of runs.

    Args:
        paths: Files of results, or folders with them.
        metric: The score.

    Returns:
        The scores, each run once, and the scores of experts, by task, where they are known.

    Raises:
        FileNotFoundError: A path does not exist, or contains no results.
        ValueError: A file has another format, runs lack the metric, or files were evaluated differently.
    """
    rows: dict[tuple[str, str, int, float, int], Score] = {}
    experts: dict[str, float] = {}
    protocols: dict[str, Path] = {}
    for file, data in itertools.chain.from_iterable(map(_contents, paths)):
        if "experiments" in data:
            protocols.setdefault(json.dumps(data.get("protocol"), sort_keys=True), file)
            found = _of_evaluation(results.from_json(data, file), file, metric, experts)
        else:
            found = [of_row(row, file) for row in data["rows"]]
            if metric != "reward":
                raise ValueError(f"--metric {metric}: {file} has only returns")
            experts |= {name: ruler.TASKS[name].expert for name in {row.task for row in found} & ruler.TASKS.keys()}
        # The same run may be in several files.
        rows |= {(row.agent, row.task, row.seed, row.score, row.steps): row for row in found}
    if len(protocols) > 1:
        each = "; ".join(f"{file}: {protocol}" for protocol, file in protocols.items())
        raise ValueError(f"the runs were evaluated differently, so that their scores cannot be compared: {each}")
    return list(rows.values()), experts


def _content(file: Path) -> dict[str, Any] | None:
    """The content of a file of results; None of another file."""
    try:
        data = json.loads(regular.text(file))
    except (UnicodeDecodeError, json.JSONDecodeError):
        return None
    return data if isinstance(data, dict) and data.keys() & {"rows", "experiments"} else None


def _contents(path: Path) -> list[tuple[Path, dict[str, Any]]]:
    """The files of results that a path names, and their contents."""
    if not path.exists():
        raise FileNotFoundError(
            f"no such file or folder: {path}; expected results, as `endless-eval --json` writes them"
        )
    if not path.is_dir():
        if (data := _content(path)) is None:
            raise ValueError(f"{path} is not a file of results, as `endless-eval --json` writes it")
        return [(path, data)]
    for pattern in ("*.json", "**/*.json"):
        if found := [(file, data) for file in sorted(path.glob(pattern)) if (data := _content(file)) is not None]:
            return found
    raise FileNotFoundError(
        f"no results in {path}; evaluate its runs with: endless-eval {path} --last --json results.json"
    )


def _of_evaluation(
    experiments: Sequence[results.Experiment], file: Path, metric: str, experts: dict[str, float]
) -> list[Score]:
    found = []
    for experiment in experiments:
        task = task_name(experiment.env, experiment.options)
        for run in experiment.runs:
            if metric not in run.metrics:
                raise ValueError(f"--metric must be one of {', '.join(run.metrics)} in {file}, got `{metric}`")
            # `endless-reproduce` has a folder for each run of an experiment, which has a name.
            is_named = re.fullmatch(r"seed-\d+", file.parent.name)
            agent = file.parent.parent.name if is_named else results.own_name(experiment.label)
            found.append(Score(agent, task, run.seed, run.metrics[metric][-1], run.steps[-1], run.run, run.cost))
        if metric == "reward" and task in ruler.TASKS:
            experts[task] = ruler.TASKS[task].expert
        elif metric == "reward" and task not in experts and (played := _expert(experiment)) is not None:
            experts[task] = played
    return found


def _expert(experiment: results.Experiment) -> float | None:
    """Mean return of the scripted expert in the environment of an experiment; None if it has none."""
    options = command.assignments(experiment.options)
    try:
        spec(experiment.env)
        return ruler.mean_return(ruler.Task("", "object", experiment.env, 0, 0, options), expert=True)
    except ValueError:
        return None


def of_row(row: Mapping[str, Any], file: Path) -> Score:
    """A row of `endless-leaderboard`; agents without memory have the size `-`, and others `gru` by default."""
    agent = row["agent"] if row.get("size", "-") in ("-", "gru") else f"{row['agent']} ({row['size']})"
    cost = {name: float(row[name]) for name in COSTS if row.get(name) is not None}
    source = f"{file}, {row['agent']} {row.get('size', '-')}"
    return Score(agent, row["task"], int(row["seed"]), float(row["score"]), int(row["steps"]), source, cost)


def ranges_of(
    rows: Sequence[Score], experts: Mapping[str, float], given: Sequence[str] = ()
) -> dict[str, tuple[float, float]]:
    """The scores that become 0 and 1 in each task: the mean of the runs of `none` and the expert, or what is given.

    Args:
        rows: The scores.
        experts: Scores of experts, by task.
        given: As `--range` takes them.

    Raises:
        ValueError: What is given has another form, or is of a task without runs.
        FileNotFoundError: There is no such file.
    """
    chosen: dict[str, Any] = {}
    for each in given:
        name, equals, values = each.rpartition("=")
        try:
            chosen |= (
                {name: [float(value) for value in values.split(",")]} if equals else json.loads(regular.text(each))
            )
        except (ValueError, TypeError):
            raise ValueError(f"--range must be TASK=ZERO,ONE with two numbers, or a JSON file, got `{each}`") from None
    tasks = list(dict.fromkeys(row.task for row in rows))
    for name, values in chosen.items():
        if name not in tasks:
            raise ValueError(f"--range: no runs of task `{name}`; there are runs of {', '.join(tasks)}")
        if not isinstance(values, list) or len(values) != 2 or not all(isinstance(one, int | float) for one in values):
            raise ValueError(f"--range: {name} must have two numbers, got {values}")
    found = {}
    for task in tasks:
        zero = [row.score for row in rows if (row.agent, row.task) == ("none", task)]
        if task in chosen:
            found[task] = (float(chosen[task][0]), float(chosen[task][1]))
        elif zero and task in experts:
            found[task] = (statistics.mean(zero), experts[task])
        else:
            missing = " and ".join(
                (["runs of `none`"] if not zero else []) + (["an expert"] if task not in experts else [])
            )
            raise ValueError(
                f"{task} has no score to become 0 or 1, since it lacks {missing}: --range '{task}=ZERO,ONE'"
            )
    return found


def cells(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """The table of the agents: its columns, and the cells of each row."""
    known = [name for name in COSTS if any(name in comparison.costs(agent) for agent in comparison.scores)]
    columns = [
        "agent",
        "seeds",
        "IQM [95 %]",
        "optimality gap [95 %]",
        *comparison.tasks,
        *(COSTS[name][0] for name in known),
    ]
    rows = []
    for agent in comparison.agents():
        found, costs = comparison.aggregates.get(agent), comparison.costs(agent)
        counts = sorted({len(scores) for scores in comparison.scores[agent].values()})
        first = [str(found.iqm), str(found.gap)] if found else ["incomplete", ""]
        means = [comparison.mean(agent, task) for task in comparison.tasks]
        rows.append(
            [agent, "-".join(map(str, sorted({counts[0], counts[-1]}))), *first]
            + ["" if mean is None else str(Estimate(mean)) for mean in means]
            + [f"{costs[name]:,.0f}" if name in costs else "" for name in known]
        )
    return columns, rows


def seed_cells(comparison: Comparison, task: str) -> tuple[list[str], list[list[str]]]:
    """The table of a task, with the score of every seed: its columns, and the cells of each row."""
    seeds = sorted({seed for own in comparison.scores.values() for seed in own.get(task, ())})
    rows = []
    for agent in comparison.agents():
        if own := comparison.scores[agent].get(task):
            shown = [f"{own[seed]:.4g}" if seed in own else "" for seed in seeds]
            mean = statistics.mean(own.values())
            rows.append([agent, str(Estimate(comparison.normalised(task, mean))), f"{mean:.4g}", *shown])
    return ["agent", "normalised", "mean", *(f"seed {seed}" for seed in seeds)], rows


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """The lines of a table whose first column has names of agents, and the others numbers."""
    shown = {name: name != columns[0] for name in columns}
    return tables.markdown(shown, ([f"`{row[0]}`", *row[1:]] for row in rows))


def markdown(comparison: Comparison, heading: str = "# Comparison") -> list[str]:
    """The lines of the page: the agents, which is better, and every seed of each task."""
    lines = [heading, "", comparison.note(), "", *markdown_table(*cells(comparison)), ""]
    lines += [
        "IQM is the interquartile mean of the normalised scores over tasks and seeds, and the optimality gap the mean of what",
        "they lack to 1. The columns of tasks are means of normalised scores.",
        "",
    ]
    if comparison.pairs and comparison.coverage:
        number = len(comparison.pairs)
        lines += [
            "The probability of improvement is that of a run of the first agent scoring higher than one of the second, mean",
            f"over the tasks. Only pairs whose interval excludes one half are listed, of {number}; of as many pairs of equal",
            f"agents, about {number * 0.05:.1f} would be.",
            "",
        ]
        claims = comparison.claims()
        lines += [f"- {claim}" for claim in claims] or [
            "No interval does: these runs do not show that an agent is better."
        ]
        lines += [""]
    for task in comparison.tasks:
        zero, one = comparison.ranges[task]
        lines += [
            f"## {task}",
            "",
            f"{comparison.steps[task]:,} steps; {zero:.4g} becomes 0, and {one:.4g} becomes 1.",
            "",
        ]
        lines += [*markdown_table(*seed_cells(comparison, task)), ""]
    return lines


_SPECIAL = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_SPECIAL |= {character: f"\\{character}" for character in "&%$#_{}"}


def latex(comparison: Comparison) -> str:
    """The table of the agents in LaTeX, for the package booktabs."""

    def escaped(text: str) -> str:
        return "".join(_SPECIAL.get(character, character) for character in text)

    columns, rows = cells(comparison)
    lines = [" & ".join(map(escaped, row)) + r" \\" for row in (columns, *rows)]
    return "\n".join(
        [
            r"% Needs \usepackage{booktabs}.",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{escaped(comparison.note())}}}",
            rf"\begin{{tabular}}{{l{'r' * (len(columns) - 1)}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def draw(comparison: Comparison, out: Path) -> None:
    """Draw interquartile means, optimality gaps and the best performance profiles, as `comparison.svg` and `.pdf`."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    agents = list(comparison.aggregates)
    figure = Figure(figsize=(11, 1.5 + 0.3 * max(6, len(agents))), layout="constrained")
    FigureCanvasAgg(figure)
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1, 1.4])
    for number, agent in enumerate(agents):
        found, colour = comparison.aggregates[agent], AGENTS.get(agent, (f"C{number % 10}",))[0]
        for axes, one in ((left, found.iqm), (middle, found.gap)):
            if one.low is not None and one.high is not None:
                axes.plot([one.low, one.high], [number] * 2, color=colour, lw=4, alpha=0.35)
            axes.plot(one.value, number, "o", color=colour)
        if number >= PROFILES:
            continue
        shares = [one.value for one in found.profile]
        right.plot(THRESHOLDS, shares, color=colour, label=f"{agent}, {found.seeds} seeds", drawstyle="steps-post")
        if found.seeds > 1:
            low, high = ([getattr(one, end) for one in found.profile] for end in ("low", "high"))
            right.fill_between(THRESHOLDS, low, high, color=colour, alpha=0.1, lw=0, step="post")
    left.set_yticks(range(len(agents)), agents)
    middle.set_yticks(range(len(agents)), [])
    for axes, title in ((left, "Interquartile mean"), (middle, "Optimality gap")):
        axes.set(title=title, ylim=(len(agents) - 0.5, -0.5))
    best = f" of the best {PROFILES}" if len(agents) > PROFILES else ""
    right.set(
        title=f"Performance profile{best}", xlabel="Normalised score", ylabel="Share of runs above it", ylim=(0, 1.02)
    )
    right.legend(fontsize="x-small")
    for axes in (left, middle, right):
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    with matplotlib.rc_context({"svg.hashsalt": "endless", "svg.fonttype": "none", "pdf.fonttype": 42}):
        for kind, date in (("svg", "Date"), ("pdf", "CreationDate")):
            with atomic.replacing(out / f"comparison.{kind}") as new:
                figure.savefig(new, format=kind, metadata={date: None})


def write(comparison: Comparison, out: Path, page: str = "") -> list[Path]:
    """Write the tables and figures of a comparison into a folder, which is made if it does not exist.

    Args:
        comparison: The comparison.
        out: The folder.
        page: The page, Markdown, if not that of `markdown`.

    Returns:
        The files.

    Raises:
        ModuleNotFoundError: Matplotlib is not installed.
    """
    command.check_installed("a comparison", "matplotlib")
    out.mkdir(parents=True, exist_ok=True)
    pages = {"README.md": page or "\n".join([*markdown(comparison), "![comparison](comparison.svg)"]) + "\n"}
    pages["agents.csv"] = tables.csv_text(*cells(comparison))
    rows = [
        (row.task, row.agent, row.seed, row.steps, row.score, comparison.normalised(row.task, row.score))
        for row in comparison.rows
    ]
    pages["runs.csv"] = tables.csv_text(("task", "agent", "seed", "steps", "score", "normalised"), rows)
    pairs = [(one.first, one.second, *asdict(one.probability).values()) for one in comparison.pairs]
    pages["improvement.csv"] = tables.csv_text(("first", "second", "probability", "low", "high"), pairs)
    pages["table.tex"] = latex(comparison)
    for name, text in pages.items():
        atomic.write(out / name, text)
    draw(comparison, out)
    return [out / name for name in (*pages, "comparison.svg", "comparison.pdf")]


def execute(arguments: CompareArguments) -> None:
    """Compare, write the tables and figures, and print the table; or simulate the coverage."""
    console = command.Terminal()
    if arguments.coverage:
        names = ("tasks", "seeds", "population", "IQM", "optimality gap", "improvement", "percentile IQM")
        table = tables.table(
            "Share of nominal 95 % intervals that contain the true value",
            {name: name != "population" for name in names},
        )
        for tasks, seeds in DESIGNS:
            for one in estimates.coverage(seeds, tasks):
                shares = (one.iqm, one.gap, one.improvement, one.percentile)
                table.add_row(str(tasks), str(seeds), one.population, *(f"{share:.3f}" for share in shares))
        tables.show(table, console)
        return
    if not arguments.paths:
        raise ValueError("no path given; expected files of `endless-eval --json`, or folders with them")
    command.check_installed("a comparison", "matplotlib")
    rows, experts = read_scores(arguments.paths, arguments.metric)
    comparison = Comparison(rows, ranges_of(rows, experts, arguments.range))
    if arguments.json not in ("", "-"):
        command.check_outputs([Path(arguments.json)], [path for path in arguments.paths if path.is_file()])
    written = write(comparison, arguments.out)
    text = json.dumps(comparison.to_json(), indent=1) + "\n"
    if arguments.json == "-":
        print(text, end="")
        return
    if arguments.json:
        atomic.write(arguments.json, text)
    columns, shown = cells(comparison)
    table = tables.table("", {name: name != "agent" for name in columns[:4]})
    for row in shown:
        table.add_row(*row[:4])
    tables.show(table, console)
    for line in (
        *comparison.claims(),
        comparison.note(),
        f"{written[0]}, with {', '.join(file.name for file in written[1:])}",
    ):
        console.print(line)


def main() -> int:
    """Entry point of the command `endless-compare`; returns the exit status."""
    return command.main("endless-compare", CompareArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
