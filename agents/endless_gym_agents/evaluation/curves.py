"""Learning curves from evaluations, training logs and the paper, and their aggregation over environments as in the paper.

A curve contains the scores of one environment, float64 (runs, checkpoints), over the number of environment steps before each
checkpoint.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from endless_gym_agents.common.command import assignments
from endless_gym_agents.evaluation.results import Experiment, label, metric
from endless_gym_agents.evaluation.statistics import interquartile_means, interval
from endless_gym_agents.training.checkpoint import read_settings
from endless_gym_agents.training.logs import PROGRESS, read_progress

Floats = NDArray[np.float64]
Family = Literal["finite", "endless"]

#: The environments whose scores the paper aggregates into one plot.
FAMILIES: dict[Family, tuple[str, str, str]] = {
    "finite": ("MortarMayhem-v0", "MysteryPath-v0", "SearingSpotlights-v0"),
    "endless": ("Endless-MortarMayhem-v0", "Endless-MysteryPath-v0", "Endless-SearingSpotlights-v0"),
}
#: Labels of the score axis of the aggregated plots.
AXES: dict[Family, str] = {"finite": "Task progress", "endless": "Normalised score"}
#: In this environment all agents of the paper use observation reconstruction, so `gru_rec` takes the place of `gru`.
_WITH_RECONSTRUCTION = "Endless-SearingSpotlights-v0"


@dataclass(frozen=True)
class Curve:
    """The learning curve of an agent.

    Attributes:
        env: Environment id, or the name of an aggregated family.
        label: Name of the agent.
        source: Origin of the scores.
        steps: Environment steps, int64 (checkpoints,).
        scores: float64 (runs, checkpoints).
        tasks: Number of environments in the curve. Each has the same number of runs; the runs are ordered by environment.
    """

    env: str
    label: str
    source: Literal["published", "evaluated", "training"]
    steps: NDArray[np.int64]
    scores: Floats
    tasks: int = 1

    def mean(self) -> tuple[Floats, Floats, Floats]:
        """Mean over the runs, mean minus and mean plus one standard deviation, float64 (checkpoints,) each."""
        mean, std = self.scores.mean(0), self.scores.std(0)
        return mean, mean - std, mean + std

    def interquartile_mean(self) -> tuple[Floats, Floats, Floats]:
        """Interquartile mean over the runs, and the ends of its 95 % interval, float64 (checkpoints,) each."""
        tables = [column.reshape(self.tasks, -1).T for column in self.scores.T]
        ends = np.array([interval(table, repetitions=1000) for table in tables])
        return interquartile_means(self.scores.T), ends[:, 0], ends[:, 1]

    def until(self, steps: int) -> Curve:
        """The curve up to a number of environment steps."""
        kept = self.steps <= steps
        return Curve(self.env, self.label, self.source, self.steps[kept], self.scores[:, kept], self.tasks)


@cache
def _published() -> dict[str, Any]:
    file = resources.files("endless_gym_agents.evaluation") / "published.json"
    read: dict[str, Any] = json.loads(file.read_text())
    return read


def published(env: str, labels: Sequence[str] | None = None) -> list[Curve]:
    """The paper's curves for an environment: of the agents in `labels` where they exist, or of all agents."""
    known, step = _published()["curves"].get(env, {}), _published()["steps_per_checkpoint"]
    chosen = known if labels is None else [name for name in labels if name in known]
    curves = []
    for name in chosen:
        scores = np.array(known[name])
        curves.append(Curve(env, name, "published", np.arange(scores.shape[1], dtype=np.int64) * step, scores))
    return curves


def published_labels() -> list[str]:
    """The agents of which the paper has curves, in any environment."""
    return list(dict.fromkeys(name for curves in _published()["curves"].values() for name in curves))


def published_environments() -> list[str]:
    """Ids of the environments for which the paper has curves."""
    return list(_published()["curves"])


def evaluated(experiment: Experiment) -> Curve:
    """The curve of an experiment in the metric of the paper, at the steps at which all runs have a checkpoint.

    Raises:
        ValueError: There are no such steps.
    """
    name, _ = metric(experiment.env)
    steps = np.array(experiment.common_steps(), dtype=np.int64)
    if not steps.size:
        raise ValueError(
            f"the runs of {experiment.env}, {experiment.label}, have no checkpoints at a common number of steps"
        )
    scores = experiment.scores(name)
    # Reset parameters change the paper's task, so the label shows them.
    shown = ", ".join([experiment.label, *assignments(experiment.options)])
    return Curve(experiment.env, shown, "evaluated", steps, scores)


def training(run: Path) -> Curve:
    """The mean reward of the last 100 training episodes of the run in folder `run`.

    Raises:
        FileNotFoundError: The folder contains no run.
        ValueError: No episode has ended yet.
    """
    if not (run / PROGRESS).exists():
        raise FileNotFoundError(
            f"no {PROGRESS} in {run}; expected the folder of a run, or a file of `endless-eval --json`"
        )
    settings = read_settings(run)
    rows = [row for row in read_progress(run) if row.get("episode/reward") is not None]
    if not rows:
        raise ValueError(f"no episode of the run {run} has ended yet; train longer")
    steps = np.array([row["steps"] for row in rows], dtype=np.int64)
    scores = np.array([[row["episode/reward"] for row in rows]])
    return Curve(settings.env, f"{label(settings)}-{settings.seed}", "training", steps, scores)


def scale(env: str) -> float:
    """Divisor that normalises the scores of an environment before aggregation.

    1 for task progress. Commands, tiles and coins are divided by the highest mean over runs that the GRU of the paper reaches
    at any checkpoint.
    """
    if metric(env).name == "task_progress":
        return 1.0
    name = "gru_rec" if env == _WITH_RECONSTRUCTION else "gru"
    (curve,) = published(env, [name])
    return float(curve.scores.mean(0).max())


def aggregate(family: Family, curves: Sequence[Curve]) -> list[Curve]:
    """Aggregate the normalised scores over the environments of a family.

    An aggregated curve has the steps that all its curves share. Each environment contributes the same number of runs: as many as
    the environment with the fewest has.

    Args:
        family: The environments.
        curves: Curves of any environments; those of other environments and of training are ignored.

    Returns:
        One curve for each agent that has curves in all environments of the family.

    Raises:
        ValueError: The curves of an agent have no common steps.
    """
    found: dict[tuple[str, str], dict[str, Curve]] = {}
    for curve in curves:
        if curve.env in FAMILIES[family] and curve.source != "training":
            found.setdefault((curve.source, curve.label), {})[curve.env] = curve
    aggregated = []
    for (source, name), own in found.items():
        if _WITH_RECONSTRUCTION not in own and (source, f"{name}_rec") in found:
            # Take the curve with reconstruction in the environment where the paper uses it.
            others = found[source, f"{name}_rec"].items()
            own = own | {env: curve for env, curve in others if env == _WITH_RECONSTRUCTION}
        if set(own) == set(FAMILIES[family]):
            curves = [own[env] for env in FAMILIES[family]]
            aggregated.append(
                joined(family, name, [replace(one, scores=one.scores / scale(one.env)) for one in curves])
            )
    return aggregated


def joined(family: str, name: str, curves: Sequence[Curve]) -> Curve:
    """A curve over several environments, from normalised ones: their common steps, and as many runs as each has.

    Raises:
        ValueError: There are no such steps.
    """
    steps = sorted(set(curves[0].steps.tolist()).intersection(*(curve.steps.tolist() for curve in curves)))
    if not steps:
        raise ValueError(
            f"the runs of {name} have no checkpoints at a common number of steps in all {family} environments"
        )
    runs = min(len(curve.scores) for curve in curves)
    parts = [curve.scores[:runs, np.isin(curve.steps, steps)] for curve in curves]
    at = np.array(steps, dtype=np.int64)
    return Curve(family, name, curves[0].source, at, np.concatenate(parts), len(curves))
