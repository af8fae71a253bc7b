"""Statistical estimates against values computed by hand."""

import numpy as np
import pytest

from endless_gym_agents.evaluation.statistics import interquartile_mean, stratified_bootstrap, summarise


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),  # of 3, 4, 5, 6
        ([100, 0, 1, 2, 3], 2.0),  # one score is discarded at each end
        ([1, 2, 6], 3.0),  # too few scores to discard any
        ([[0, 10], [0, 10]], 5.0),  # over runs and tasks
    ],
)
def test_interquartile_mean_is_the_mean_of_the_middle_half(scores: list[float], expected: float) -> None:
    assert interquartile_mean(scores) == expected


def test_bootstrap_of_three_runs() -> None:
    """Of the 27 samples of 0, 3 and 9 with replacement, 1, 4, 23 and 26 have a sum of at most 0, 3, 18 and 21."""
    assert stratified_bootstrap([0, 3, 9], confidence=0.8) == (1.0, 7.0)


def test_bootstrap_is_stratified_by_task() -> None:
    """Without variance between the runs of each task, the interval is a point."""
    assert stratified_bootstrap([[0, 10], [0, 10], [0, 10], [0, 10]]) == (5.0, 5.0)

    # If whole runs were drawn, 0 and 2 would always average to 1.
    assert stratified_bootstrap([[0, 2], [2, 0]]) == (0.0, 2.0)


def test_bootstrap_is_of_the_interquartile_mean() -> None:
    """In 5 % of the samples, three or more of four draws are the 1. The interquartile mean is then 1; the mean is mostly less."""
    assert stratified_bootstrap([0, 0, 0, 1]) == (0.0, 1.0)


def test_bootstrap_is_reproducible() -> None:
    scores = np.random.default_rng(1).normal(size=(5, 3))
    assert stratified_bootstrap(scores, seed=1) == stratified_bootstrap(scores, seed=1)
    assert stratified_bootstrap(scores, seed=1) != stratified_bootstrap(scores, seed=2)


def test_bootstrap_interval_has_its_nominal_coverage() -> None:
    samples = np.random.default_rng(0).normal(size=(200, 40))
    covered = [low < 0 < high for low, high in (stratified_bootstrap(sample, repetitions=300) for sample in samples)]
    assert 0.87 < np.mean(covered) < 0.99


def test_summary() -> None:
    summary = summarise([0, 1, 2, 3, 100])
    assert summary.mean == pytest.approx(21.2)
    assert summary.std == pytest.approx(1553.36**0.5)
    assert (summary.iqm, summary.low < 2.0 < summary.high) == (2.0, True)
    episodes = summarise([1.0] * 47 + [0.0] * 3, of_runs=False)
    assert episodes.iqm is None and episodes.low < 0.94 == pytest.approx(episodes.mean) and 0.94 < episodes.high <= 1
    with pytest.raises(ValueError, match="at least one number"):
        summarise([])
