"""Point and interval estimates of the scores of few runs, as recommended by Agarwal et al., "Deep Reinforcement Learning at the
Edge of the Statistical Precipice" (2021).

Scores are arrays (runs, tasks): each column contains the scores of the independent runs of one task. A single task is one column.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scores = NDArray[np.float64]

#: Fraction of the scores that the interquartile mean discards at each end.
TRIMMED = 0.25


def interquartile_mean(scores: ArrayLike) -> float:
    """Mean of the middle half of all scores, of any shape.

    The floor(n / 4) lowest and the floor(n / 4) highest of n scores are discarded. The interquartile mean is more robust to
    outliers than the mean, and has less variance than the median.
    """
    return float(_interquartile_means(np.asarray(scores, dtype=np.float64).reshape(1, -1))[0])


def _interquartile_means(samples: Scores) -> Scores:
    """The interquartile mean of each row: (samples, scores) to (samples,)."""
    ordered = np.sort(samples, axis=1)
    cut = int(TRIMMED * ordered.shape[1])
    means: Scores = ordered[:, cut : ordered.shape[1] - cut].mean(axis=1)
    return means


def _means(samples: Scores) -> Scores:
    """The mean of each row: (samples, scores) to (samples,)."""
    means: Scores = samples.mean(axis=1)
    return means


def stratified_bootstrap(
    scores: ArrayLike,
    estimate: Callable[[Scores], Scores] = _interquartile_means,
    *,
    repetitions: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[float, float]:
    """Percentile confidence interval of an estimate by stratified bootstrap.

    Each bootstrap sample draws as many runs as there are, with replacement, for each task independently.

    Args:
        scores: (runs, tasks) or (runs,).
        estimate: Function from samples (repetitions, runs * tasks) to estimates (repetitions,); the interquartile mean by
            default.
        repetitions: Number of bootstrap samples.
        confidence: Confidence level, between 0 and 1.
        seed: Seed of the resampling.

    Returns:
        The lower and the upper end of the interval.
    """
    table = np.asarray(scores, dtype=np.float64)
    table = table[:, None] if table.ndim == 1 else table
    runs, tasks = table.shape
    drawn = np.random.default_rng(seed).integers(runs, size=(repetitions, runs, tasks))
    samples = table[drawn, np.arange(tasks)].reshape(repetitions, runs * tasks)
    low, high = np.quantile(estimate(samples), [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


@dataclass(frozen=True)
class Summary:
    """Estimates of a set of scores.

    Attributes:
        mean: Mean.
        std: Population standard deviation of all scores, as in the paper's plots.
        iqm: Interquartile mean of runs; `None` for the episodes of one run, of which it would hide the rare ones.
        low: Lower end of the 95 % bootstrap interval of the interquartile mean, or, of episodes, of the mean.
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
    low, high = stratified_bootstrap(table, _interquartile_means if of_runs else _means)
    iqm = interquartile_mean(table) if of_runs else None
    return Summary(float(table.mean()), float(table.std()), iqm, low, high)
