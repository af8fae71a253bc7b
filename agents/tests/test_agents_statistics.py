"""Statistical estimates against values computed by hand."""

import numpy as np
import pytest

from endless_gym_agents.evaluation.statistics import (
    coverage,
    improvement,
    improvement_interval,
    interquartile_mean,
    interval,
    optimality_gaps,
    stratified_bootstrap,
    summarise,
    wilson,
)


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


@pytest.mark.parametrize("runs", [6, 8])
def test_bootstrap_has_the_quantiles_of_95_percent(runs: int) -> None:
    """Half of the runs are 1. Of six draws, none is 1 in 1.6 % of samples, and at most one in 10.9 %; of eight, 0.4 and 3.5."""
    interval = stratified_bootstrap([0, 1] * (runs // 2), lambda samples: samples.mean(1))
    assert interval == pytest.approx((1 / runs, 1 - 1 / runs))


def test_bootstrap_is_stratified_by_task() -> None:
    """Without variance between the runs of each task, the interval is a point."""
    assert stratified_bootstrap([[0, 10], [0, 10], [0, 10], [0, 10]]) == (5.0, 5.0)

    # If whole runs were drawn, 0 and 2 would always average to 1.
    assert stratified_bootstrap([[0, 2], [2, 0]]) == (0.0, 2.0)


def test_bootstrap_is_of_the_interquartile_mean() -> None:
    """In 5 % of the samples, three or more of four draws are the 1. The interquartile mean is then 1; the mean is mostly less."""
    assert stratified_bootstrap([0, 0, 0, 1]) == (0.0, 1.0)


def test_bootstrap_interval_has_its_nominal_coverage() -> None:
    samples = np.random.default_rng(0).normal(size=(200, 40))
    covered = [low < 0 < high for low, high in (stratified_bootstrap(sample, repetitions=300) for sample in samples)]
    assert 0.87 < np.mean(covered) < 0.99


def test_interval_of_one_task_is_about_students() -> None:
    """Of 1, 2, 3: the mean has the standard error 1 / sqrt(3), and two degrees of freedom the quantile 4.303."""
    low, high = interval([1, 2, 3])
    assert (low + high) / 2 == pytest.approx(2)
    assert (high - low) / 2 == pytest.approx(4.303 / 3**0.5, rel=0.03)
    assert interval([2.0]) == (2.0, 2.0)
    assert interval([[0, 10], [0, 10]]) == (5.0, 5.0)


def test_degrees_of_freedom_are_those_of_the_tasks_that_vary() -> None:
    """Of two tasks, one varies: two degrees of freedom and the quantile 4.303. Both as much: four, and 2.776."""
    for table, quantile in (([[1, 5], [2, 5], [3, 5]], 4.303 / 2), ([[1, 5], [2, 6], [3, 7]], 2.776 / 2**0.5)):
        low, high = interval(np.array(table) / 10, optimality_gaps)
        assert (high - low) / 2 == pytest.approx(quantile * 0.1 / 3**0.5, rel=0.03)


def test_optimality_gap_ignores_what_is_above_1() -> None:
    assert optimality_gaps(np.array([[0.5, 1.5, 1.0, 0.0]])) == pytest.approx([0.375])


def test_probability_of_improvement_by_hand() -> None:
    """Of the nine pairs of the first task, seven are better and one is equal; the second task is a tie."""
    assert improvement([[1, 0], [3, 0], [5, 0]], [[0, 0], [1, 0], [2, 0]]) == pytest.approx((7.5 / 9 + 0.5) / 2)


def test_probability_of_improvement_of_shifted_normals() -> None:
    """P(X > Y) is the normal distribution at the shift over sqrt(2)."""
    generator = np.random.default_rng(0)
    first, second = 1 + generator.normal(size=(1000, 2)), generator.normal(size=(1000, 2))
    assert improvement(first, second) == pytest.approx(0.7602, abs=0.02)
    covered = []
    for _ in range(500):
        p = improvement(1 + generator.normal(size=(3, 4)), generator.normal(size=(3, 4)))
        low, high = improvement_interval(p, 3, 3, 4)
        covered.append(low <= 0.7602 <= high)
    assert 0.94 < np.mean(covered) < 0.995


def test_interval_of_the_probability_of_improvement_is_the_test_of_mann_and_whitney() -> None:
    """Five runs each, all in order: the exact two-sided p is 2 / 252. Three each: 2 / 20, which is not significant."""
    assert improvement_interval(1.0, 5, 5, 1)[0] > 0.5
    assert improvement_interval(1.0, 3, 3, 1)[0] < 0.5
    low, high = improvement_interval(0.3, 4, 6, 2)
    assert (1 - high, 1 - low) == pytest.approx(improvement_interval(0.7, 4, 6, 2), abs=1e-3)


def test_wilsons_interval() -> None:
    """Of 2 in 10, a textbook's example: 0.057 to 0.510."""
    assert wilson(0.2, 10) == pytest.approx((0.0567, 0.5098), abs=1e-4)
    assert wilson(1.0, 18)[1] == 1.0 and wilson(0.0, 18)[0] == 0.0


@pytest.mark.parametrize(("runs", "tasks"), [(3, 6), (5, 1)])
def test_intervals_cover_with_few_runs(runs: int, tasks: int) -> None:
    for one in coverage(runs, tasks, 1000):
        assert 0.92 < one.iqm < 0.975 and 0.92 < one.gap < 0.975 and 0.93 < one.improvement < 0.98, one
        assert one.percentile < (0.9 if runs == 3 else 0.96)


def test_summary() -> None:
    summary = summarise([0, 1, 2, 3, 100])
    assert summary.mean == pytest.approx(21.2)
    assert summary.std == pytest.approx(1553.36**0.5)
    assert (summary.iqm, summary.low < 2.0 < summary.high) == (2.0, True)
    episodes = summarise([1.0] * 47 + [0.0] * 3, of_runs=False)
    assert episodes.iqm is None and episodes.low < 0.94 == pytest.approx(episodes.mean) and 0.94 < episodes.high <= 1
    with pytest.raises(ValueError, match="at least one number"):
        summarise([])
