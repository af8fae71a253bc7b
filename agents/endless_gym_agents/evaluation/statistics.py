"""Point and interval estimates of the scores of few runs: the estimates that Agarwal et al. recommend in "Deep Reinforcement
Learning at the Edge of the Statistical Precipice" (2021), with intervals that also cover with few runs.

Scores are arrays (runs, tasks): each column contains the scores of the independent runs of one task. A single task is one column.

Percentile intervals by stratified bootstrap are too narrow for 3 to 5 runs. Here, estimates of scores have the bootstrap's
standard error, times what makes up for the runs' own mean, and the quantile of Student's t; shares of scores have Wilson's
interval; and the probability of improvement has Newcombe's interval. `coverage` simulates how often they cover.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scores = NDArray[np.float64]
#: Function from samples (samples, runs * tasks) to estimates (samples,).
Estimator = Callable[[Scores], Scores]

#: Fraction of the scores that the interquartile mean discards at each end.
TRIMMED = 0.25
#: The quantile 0.975 of the standard normal distribution, and of Student's t for some degrees of freedom; in between it is
#: about linear in their inverse.
_NORMAL = 1.95996
_DEGREES = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12, 15, 20, 30, 60, np.inf)
_STUDENT = (12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306, 2.228, 2.179, 2.131, 2.086, 2.042, 2.000, _NORMAL)


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, of any shape.

    The floor(n / 4) lowest and the floor(n / 4) highest of n scores are discarded. The interquartile mean is more robust to
    outliers than the mean, and has less variance than the median.
    """
    return float(interquartile_means(np.asarray(scores, dtype=np.float64).reshape(1, -1))[0])


def interquartile_means(samples: Scores) -> Scores:
    """The interquartile mean of each row: (samples, scores) to (samples,)."""
    ordered = np.sort(samples, axis=1)
    cut = int(TRIMMED * ordered.shape[1])
    means: Scores = ordered[:, cut : ordered.shape[1] - cut].mean(axis=1)
    return means


def _table(scores: ArrayLike) -> Scores:
    """Scores (runs, tasks), also of (runs,)."""
    table = np.asarray(scores, dtype=np.float64)
    return table[:, None] if table.ndim == 1 else table


def _means(samples: Scores) -> Scores:
    """The mean of each row: (samples, scores) to (samples,)."""
    means: Scores = samples.mean(axis=1)
    return means


def stratified_bootstrap(
    scores: ArrayLike, estimator: Estimator = interquartile_means, *, repetitions: int = 2000
) -> tuple[float, float]:
    """Percentile 95 % interval of an estimate by stratified bootstrap.

    Each bootstrap sample draws as many runs as there are, with replacement, for each task independently.

    Args:
        scores: (runs, tasks) or (runs,).
        estimator: The estimator; the interquartile mean by default.
        repetitions: Number of bootstrap samples.

    Returns:
        The lower and the upper end of the interval.
    """
    table = _table(scores)
    runs, tasks = table.shape
    drawn = np.random.default_rng(0).integers(runs, size=(repetitions, runs, tasks))
    samples = table[drawn, np.arange(tasks)].reshape(repetitions, runs * tasks)
    low, high = np.quantile(estimator(samples), [0.025, 0.975])
    return float(low), float(high)


def optimality_gaps(samples: Scores) -> Scores:
    """The mean of max(0, 1 - score) of each row, (samples, scores) to (samples,): how far normalised scores are from 1."""
    gaps: Scores = np.maximum(0.0, 1.0 - samples).mean(axis=1)
    return gaps


def _half_widths(tables: Scores, estimator: Estimator, repetitions: int, seed: int) -> Scores:
    """Half of the width of the 95 % interval of an estimate of each table: (tables, runs, tasks) to (tables,); runs >= 2.

    The degrees of freedom are Satterthwaite's: few, if few tasks account for the variance. The jackknife says which do.
    """
    count, runs, tasks = tables.shape
    size = runs * tasks
    drawn = np.random.default_rng(seed).integers(runs, size=(repetitions, runs, tasks))
    resampled = tables[:, drawn, np.arange(tasks)].reshape(-1, size)
    error = estimator(resampled).reshape(count, repetitions).std(axis=1) * sqrt(runs / (runs - 1))
    others = np.array([np.delete(np.arange(size), left_out) for left_out in range(size)])
    without = estimator(tables.reshape(count, size)[:, others].reshape(-1, size - 1)).reshape(count, runs, tasks)
    variances = without.var(axis=1)
    squares = np.maximum((variances**2).sum(axis=1), 1e-300)
    degrees = (runs - 1) * np.clip(variances.sum(axis=1) ** 2 / squares, 1, tasks)
    widths: Scores = error * np.interp(1 / degrees, 1 / np.array(_DEGREES)[::-1], _STUDENT[::-1])
    return widths


def interval(
    scores: ArrayLike, estimator: Estimator = interquartile_means, *, repetitions: int = 2000
) -> tuple[float, float]:
    """95 % interval of an estimate: its standard error by stratified bootstrap, corrected for few runs, times Student's t.

    Args:
        scores: (runs, tasks) or (runs,).
        estimator: The estimator; the interquartile mean by default.
        repetitions: Number of bootstrap samples.

    Returns:
        The lower and the upper end; of a single run, which has no interval, both are its estimate.
    """
    table = _table(scores)
    centre = float(estimator(table.reshape(1, -1))[0])
    half = float(_half_widths(table[None], estimator, repetitions, 0)[0]) if len(table) > 1 else 0.0
    return centre - half, centre + half


def wilson(share: float, number: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of `number` scores; conservative if they belong to several tasks."""
    square = _NORMAL**2 / number
    centre, half = share + square / 2, sqrt(square * (share * (1 - share) + square / 4))
    return max(0.0, (centre - half) / (1 + square)), min(1.0, (centre + half) / (1 + square))


def improvement(first: ArrayLike, second: ArrayLike) -> float:
    """Probability that a run of the first agent scores higher than one of the second, mean over the tasks; ties count as half.

    Args:
        first: (runs, tasks).
        second: (other runs, tasks).
    """
    return float(_improvements(np.asarray(first, np.float64)[None], np.asarray(second, np.float64)[None])[0])


def _improvements(first: Scores, second: Scores) -> Scores:
    """As `improvement`, of tables: (tables, runs, tasks) and (tables, other runs, tasks) to (tables,)."""
    wins = np.sign(first[:, :, None] - second[:, None]) / 2 + 0.5
    means: Scores = wins.mean(axis=(1, 2, 3))
    return means


def improvement_interval(probability: float, runs: int, other: int, tasks: int) -> tuple[float, float]:
    """Newcombe's 95 % interval of the probability of improvement (2006, method 5), for tasks, and corrected for continuity.

    It contains the probabilities that the observed one does not reject. For one half, this is the test of Mann and Whitney in
    each task. It therefore has a width even if all runs of one agent are better, where a bootstrap has none; ties make it wider
    than necessary.

    Args:
        probability: The observed one.
        runs: Runs of the first agent in each task.
        other: Runs of the second agent in each task.
        tasks: Number of tasks.
    """
    p, pairs = np.linspace(0, 1, 2001), runs * other
    factor = 1 + ((runs + other) / 2 - 1) * ((1 - p) / (2 - p) + p / (1 + p))
    distance = np.maximum(0.0, np.abs(probability - p) - 0.5 / (pairs * tasks))
    kept = p[distance <= _NORMAL * np.sqrt(p * (1 - p) * factor / (pairs * tasks))]
    return float(kept[0]), float(kept[-1])


@dataclass(frozen=True)
class Coverage:
    """How often 95 % intervals contain the true value, in simulated runs.

    Attributes:
        population: What the scores are like; a key of `POPULATIONS`.
        iqm: Share of the intervals of the interquartile mean that contain it.
        gap: Share of those of the optimality gap.
        improvement: Share of those of the probability of improvement between two equal agents that contain one half; the others
            would claim that one of them is better.
        percentile: Share of the percentile bootstrap intervals of the interquartile mean, for comparison.
    """

    population: str
    iqm: float
    gap: float
    improvement: float
    percentile: float


def _graded(generator: np.random.Generator, count: int, runs: int, tasks: int) -> Scores:
    means = np.linspace(0.05, 0.97, tasks) if tasks > 1 else np.array([0.5])
    noise = 0.3 * np.sqrt(means * (1 - means)) * generator.normal(size=(count, runs, tasks))
    clipped: Scores = np.clip(means + noise, 0, 1)
    return clipped


def _extreme(generator: np.random.Generator, count: int, runs: int, tasks: int) -> Scores:
    means, noise = (
        np.resize(values, tasks) for values in ((0.6, 1, 0.1, 0.4, 0.99, 0.12), (0.2, 0.003, 0.03, 0.15, 0.01, 0.03))
    )
    drawn: Scores = means + noise * generator.normal(size=(count, runs, tasks))
    return drawn


def _two_modes(generator: np.random.Generator, count: int, runs: int, tasks: int) -> Scores:
    shares = np.linspace(0.05, 0.97, tasks) if tasks > 1 else np.array([0.5])
    shape = (count, runs, tasks)
    drawn: Scores = np.where(generator.random(shape) < shares, 0.95, 0.1) + 0.02 * generator.normal(size=shape)
    return drawn


#: Populations of normalised scores: tasks from hard to easy; most tasks at an end of the scale; runs that learn a task or do not.
POPULATIONS = {"graded": _graded, "extreme": _extreme, "two modes": _two_modes}


@cache
def coverage(runs: int, tasks: int, repetitions: int = 1000) -> list[Coverage]:
    """Simulate how often the intervals cover with this number of runs, 2 or more, in each of this number of tasks."""
    found = []
    for name, draw in POPULATIONS.items():
        generator = np.random.default_rng(0)
        everything, tables = (
            draw(generator, 1, 400_000 // tasks, tasks).reshape(1, -1),
            draw(generator, repetitions, runs, tasks),
        )
        flat, shares = tables.reshape(repetitions, -1), []
        for estimator in (interquartile_means, optimality_gaps):
            error = np.abs(estimator(flat) - estimator(everything)[0])
            shares.append(float(np.mean(error <= _half_widths(tables, estimator, 200, 1) + 1e-9)))
        equal = _improvements(tables, draw(generator, repetitions, runs, tasks))
        ends = {p: improvement_interval(p, runs, runs, tasks) for p in np.unique(equal).tolist()}
        halves = [ends[p][0] <= 0.5 <= ends[p][1] for p in equal.tolist()]
        percentiles = [stratified_bootstrap(table, repetitions=200) for table in tables[: repetitions // 2]]
        true = float(interquartile_means(everything)[0])
        contained = [low <= true <= high for low, high in percentiles]
        iqm, gap = shares
        found.append(Coverage(name, iqm, gap, float(np.mean(halves)), float(np.mean(contained))))
    return found


@dataclass(frozen=True)
class Summary:
    """Estimates of a set of scores.

    Attributes:
        mean: Mean.
        std: Population standard deviation of all scores, as in the paper's plots.
        iqm: Interquartile mean of runs; `None` for the episodes of one run, of which it would hide the rare ones.
        low: Lower end of the 95 % interval of the interquartile mean, or, of episodes, of the mean.
        high: Upper end of that interval.
    """

    mean: float
    std: float
    iqm: float | None
    low: float
    high: float


def summarise(scores: ArrayLike, of_runs: bool = True) -> Summary:
    """Compute all estimates of scores (runs, tasks) or (runs,), or of the episodes of one run.

    Raises:
        ValueError: There are no scores.
    """
    table = np.asarray(scores, dtype=np.float64)
    if not table.size:
        raise ValueError("scores must contain at least one number, got none")
    low, high = interval(table) if of_runs else stratified_bootstrap(table, _means)
    iqm = interquartile_mean(table) if of_runs else None
    return Summary(float(table.mean()), float(table.std()), iqm, low, high)
