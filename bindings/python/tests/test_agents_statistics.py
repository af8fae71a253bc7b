"""Estimates of a few runs, against values computed by hand."""

import numpy as np
import pytest

from endless_gym.agents.statistics import interquartile_mean, stratified_bootstrap, summarise


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),  # of 3, 4, 5, 6
        ([100, 0, 1, 2, 3], 2.0),  # one is left out at each end
        ([1, 2, 6], 3.0),  # too few to leave any out
        ([[0, 10], [0, 10]], 5.0),  # tasks and runs alike
    ],
)
def test_interquartile_mean(scores: list[float], expected: float) -> None:
    assert interquartile_mean(scores) == expected


def test_bootstrap_of_three_runs() -> None:
    """Three of 0, 3, 9 with replacement: 27 samples. Their sums are at most 0 in 1, 3 in 4, 18 in 23, 21 in 26 of them."""
    assert stratified_bootstrap([0, 3, 9], confidence=0.8) == (1.0, 7.0)


def test_bootstrap_draws_each_task_s_runs_by_themselves() -> None:
    """Tasks of different difficulty, runs without any spread: there is nothing to be unsure of."""
    assert stratified_bootstrap([[0, 10], [0, 10], [0, 10], [0, 10]]) == (5.0, 5.0)

    # The tasks favour different runs: drawn together, 0 and 2 would always make up for each other.
    assert stratified_bootstrap([[0, 2], [2, 0]]) == (0.0, 2.0)


def test_bootstrap_is_of_the_interquartile_mean() -> None:
    """Three or more of four draws are the one success, 5 in 100 times; the middle half is then 1, the mean at most 3/4."""
    assert stratified_bootstrap([0, 0, 0, 1]) == (0.0, 1.0)


def test_bootstrap_follows_from_its_seed() -> None:
    scores = np.random.default_rng(1).normal(size=(5, 3))
    assert stratified_bootstrap(scores, seed=1) == stratified_bootstrap(scores, seed=1)
    assert stratified_bootstrap(scores, seed=1) != stratified_bootstrap(scores, seed=2)


def test_bootstrap_covers_the_truth_as_often_as_it_says() -> None:
    samples = np.random.default_rng(0).normal(size=(200, 40))
    covered = [low < 0 < high for low, high in (stratified_bootstrap(sample, repetitions=300) for sample in samples)]
    assert 0.87 < np.mean(covered) < 0.99


def test_summary() -> None:
    summary = summarise([0, 1, 2, 3, 100])
    assert summary.mean == pytest.approx(21.2)
    assert summary.std == pytest.approx(1553.36**0.5)
    assert (summary.iqm, summary.low < 2.0 < summary.high) == (2.0, True)
    with pytest.raises(ValueError, match="no scores"):
        summarise([])
