"""Learning curves: of evaluations, of training, and the paper's; and the paper's way to put several environments into one.

A curve has one environment's scores, float64 (runs, checkpoints), over the environment steps that the checkpoints have learned
from.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from endless_gym.agents import metrics
from endless_gym.agents.logs import PROGRESS, read_progress
from endless_gym.agents.results import Experiment, label
from endless_gym.agents.settings import from_dict
from endless_gym.agents.statistics import interquartile_mean, stratified_bootstrap

Floats = NDArray[np.float64]
Family = Literal["finite", "endless"]

#: The environments whose scores the paper puts into one plot.
FAMILIES: dict[Family, tuple[str, str, str]] = {
    "finite": ("MortarMayhem-v0", "MysteryPath-v0", "SearingSpotlights-v0"),
    "endless": ("Endless-MortarMayhem-v0", "Endless-MysteryPath-v0", "Endless-SearingSpotlights-v0"),
}
#: In this environment the paper's agents reconstruct observations; there `gru_rec` stands for `gru`.
_WITH_RECONSTRUCTION = "Endless-SearingSpotlights-v0"


@dataclass(frozen=True)
class Curve:
    """One agent's learning curve.

    Attributes:
        env: Environment id, or the family that was put together.
        label: The agent's name.
        source: Where the scores are from.
        steps: Environment steps, int64 (checkpoints,).
        scores: float64 (runs, checkpoints).
        tasks: How many environments the runs are of, each with equally many, one environment after the other.
    """

    env: str
    label: str
    source: Literal["published", "evaluated", "training"]
    steps: NDArray[np.int64]
    scores: Floats
    tasks: int = 1

    def mean(self) -> tuple[Floats, Floats, Floats]:
        """The mean over the runs, and it minus and plus one standard deviation; each (checkpoints,)."""
        mean, std = self.scores.mean(0), self.scores.std(0)
        return mean, mean - std, mean + std

    def interquartile_mean(self) -> tuple[Floats, Floats, Floats]:
        """The interquartile mean over the runs, and the ends of its 95 % interval; each (checkpoints,)."""
        means = np.array([interquartile_mean(column) for column in self.scores.T])
        tables = [column.reshape(self.tasks, -1).T for column in self.scores.T]
        ends = np.array([stratified_bootstrap(table, repetitions=1000) for table in tables])
        return means, ends[:, 0], ends[:, 1]

    def until(self, steps: int) -> Curve:
        """Its part up to a number of steps."""
        kept = self.steps <= steps
        return Curve(self.env, self.label, self.source, self.steps[kept], self.scores[:, kept], self.tasks)


@cache
def _published() -> dict[str, Any]:
    file = resources.files("endless_gym.agents") / "published.json"
    read: dict[str, Any] = json.loads(file.read_text())
    return read


def published(env: str, labels: Sequence[str] | None = None) -> list[Curve]:
    """The paper's curves of an environment; of these agents, or of all."""
    known, step = _published()["curves"].get(env, {}), _published()["steps_per_checkpoint"]
    chosen = known if labels is None else [name for name in labels if name in known]
    curves = []
    for name in chosen:
        scores = np.array(known[name])
        curves.append(Curve(env, name, "published", np.arange(scores.shape[1], dtype=np.int64) * step, scores))
    return curves


def published_environments() -> list[str]:
    """Environments that the paper has curves of."""
    return list(_published()["curves"])


def evaluated(experiment: Experiment) -> Curve:
    """The curve of the paper's metric, from an evaluation, at the steps at which all runs have a checkpoint.

    Raises:
        ValueError: There are no such steps.
    """
    name, _ = metrics.metric(experiment.env)
    steps = np.array(experiment.common_steps(), dtype=np.int64)
    if not steps.size:
        raise ValueError(
            f"the runs of {experiment.env}, {experiment.label}, have no checkpoint at the same number of steps"
        )
    scores = experiment.scores(name)
    # Other reset parameters make another task than the paper's; the plot says so.
    options = "".join(f", {option}={value}" for option, value in experiment.options.items())
    return Curve(experiment.env, experiment.label + options, "evaluated", steps, scores)


def training(run: Path) -> Curve:
    """The mean reward of the last 100 training episodes, from a run's folder.

    Raises:
        FileNotFoundError: The folder is not a run's.
        ValueError: No episode has ended yet.
    """
    if not (run / PROGRESS).exists():
        raise FileNotFoundError(f"no {PROGRESS} in {run}; give a run's folder, or a file of `endless-eval --json`")
    settings = from_dict(json.loads((run / "settings.json").read_text()))
    rows = [row for row in read_progress(run) if row.get("episode/reward") is not None]
    if not rows:
        raise ValueError(f"in {run} no episode has ended yet; train longer")
    steps = np.array([row["steps"] for row in rows], dtype=np.int64)
    scores = np.array([[row["episode/reward"] for row in rows]])
    return Curve(settings.env, f"{label(settings)}-{settings.seed}", "training", steps, scores)


def scale(env: str) -> float:
    """What scores of an environment are divided by, before those of several are put together.

    A task progress stays as it is. Commands, tiles and coins are divided by the best mean over the runs that the paper's GRU has
    at any checkpoint.
    """
    if metrics.is_finite(env):
        return 1.0
    name = "gru_rec" if env == _WITH_RECONSTRUCTION else "gru"
    (curve,) = published(env, [name])
    return float(curve.scores.mean(0).max())


def aggregate(family: Family, curves: Sequence[Curve]) -> list[Curve]:
    """Put the normalised runs of a family's environments together, one curve for each agent that has all of them.

    The curve ends with the shortest, at the steps that all have; runs count alike, as many from each environment as the one with
    the fewest has.
    """
    found: dict[tuple[str, str], dict[str, Curve]] = {}
    for curve in curves:
        if curve.env in FAMILIES[family] and curve.source != "training":
            found.setdefault((curve.source, curve.label), {})[curve.env] = curve
    together = []
    for (source, name), own in found.items():
        if _WITH_RECONSTRUCTION not in own and (source, f"{name}_rec") in found:
            own = _with(own, found[source, f"{name}_rec"])
        if set(own) == set(FAMILIES[family]):
            together.append(_put_together(family, name, [own[env] for env in FAMILIES[family]]))
    return together


def _with(own: Mapping[str, Curve], others: Mapping[str, Curve]) -> dict[str, Curve]:
    """Completed by the curve with reconstruction, where that is the paper's way."""
    return {**own, **{env: curve for env, curve in others.items() if env == _WITH_RECONSTRUCTION}}


def _put_together(family: str, name: str, curves: Sequence[Curve]) -> Curve:
    steps = sorted(set(curves[0].steps.tolist()).intersection(*(curve.steps.tolist() for curve in curves)))
    if not steps:
        raise ValueError(
            f"the runs of {name} have no checkpoint at the same number of steps in all {family} environments"
        )
    runs = min(len(curve.scores) for curve in curves)
    parts = [curve.scores[:runs, np.isin(curve.steps, steps)] / scale(curve.env) for curve in curves]
    at = np.array(steps, dtype=np.int64)
    return Curve(family, name, curves[0].source, at, np.concatenate(parts), len(curves))
