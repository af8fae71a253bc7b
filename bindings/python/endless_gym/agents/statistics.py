"""Point and interval estimates of a few runs' scores, after Agarwal et al., "Deep Reinforcement Learning at the Edge of the
Statistical Precipice" (2021).

Scores are arrays (runs, tasks): each column has the scores of one task's independent runs. A single task is one column.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Scores = NDArray[np.float64]

#: The share of scores that the interquartile mean leaves out, at each end.
TRIMMED = 0.25


def interquartile_mean(scores: ArrayLike) -> float:
    """The mean of the middle half of all scores, of any shape.

    Of n scores the floor(n / 4) lowest and as many of the highest are left out: less swayed by outliers than the mean, and by
    luck than the median.
    """
    ordered = np.sort(np.asarray(scores, dtype=np.float64), axis=None)
    cut = int(TRIMMED * ordered.size)
    return float(ordered[cut : ordered.size - cut].mean())


def _interquartile_means(samples: Scores) -> Scores:
    """Of many samples at once, (samples, scores) -> (samples,)."""
    ordered = np.sort(samples, axis=1)
    cut = int(TRIMMED * ordered.shape[1])
    means: Scores = ordered[:, cut : ordered.shape[1] - cut].mean(axis=1)
    return means


def stratified_bootstrap(
    scores: ArrayLike,
    estimate: Callable[[Scores], Scores] = _interquartile_means,
    *,
    repetitions: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> tuple[float, float]:
    """A percentile interval of an estimate over runs and tasks.

    Runs are drawn anew, with replacement, as many as there are, for each task by itself: each sample has all tasks.

    Args:
        scores: (runs, tasks) or (runs,).
        estimate: From samples (repetitions, runs * tasks) to (repetitions,); the interquartile mean.
        repetitions: Samples that are drawn.
        confidence: Share of the samples' estimates that lies in the interval.
        seed: Of the draws.

    Returns:
        The lower and the upper end.
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
    """What is said of some scores.

    Attributes:
        mean: Their mean.
        std: Their standard deviation, over all scores, with n in the denominator as in the paper's plots.
        iqm: Their interquartile mean.
        low: Lower end of its 95 % bootstrap interval.
        high: Upper end.
    """

    mean: float
    std: float
    iqm: float
    low: float
    high: float

    def to_dict(self) -> dict[str, float]:
        """For JSON."""
        return asdict(self)


def summarise(scores: ArrayLike) -> Summary:
    """All estimates of scores (runs, tasks) or (runs,)."""
    table = np.asarray(scores, dtype=np.float64)
    if not table.size:
        raise ValueError("there are no scores; evaluate one run or more")
    low, high = stratified_bootstrap(table)
    return Summary(float(table.mean()), float(table.std()), interquartile_mean(table), low, high)
