"""The model of `benches/dispatch_model.py`."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "benches"))

from dispatch_model import WORK, Costs, Step, env_time, one_queue, shares

#: Threads cost nothing.
FREE = Costs(line=0, next_line=0, lock=0, unpark=0, split=0, share=0, bandwidth=math.inf)
DIVISIONS = [one_queue, shares]

Division = Callable[[Costs, float, int, int], Step]


@pytest.mark.parametrize("divide", DIVISIONS)
def test_one_thread_does_nothing_else(divide: Division) -> None:
    step = divide(Costs(), 500, 4_096, 1)
    assert step.steps_per_second == pytest.approx(2e6)
    assert (step.serial, step.efficiency) == (0, 1)


@pytest.mark.parametrize("divide", DIVISIONS)
@pytest.mark.parametrize("threads", [2, 16, 64])
def test_free_threads_divide_the_time(divide: Division, threads: int) -> None:
    step = divide(FREE, 500, 16_384, threads)
    assert step.total == pytest.approx(16_384 * 500 / threads)
    assert step.serial_share == pytest.approx(0)


@pytest.mark.parametrize("divide", DIVISIONS)
@pytest.mark.parametrize("envs", [1_000, 4_099])
@pytest.mark.parametrize("threads", [2, 3, 64, 192])
def test_threads_take_at_least_their_share_of_the_work(divide: Division, envs: int, threads: int) -> None:
    step = divide(Costs(), 500, envs, threads)
    assert step.total >= envs * 500 / threads
    assert 0 < step.serial_share < 1
    dearer = divide(replace(Costs(), line=1_000), 500, envs, threads)
    assert dearer.total > step.total


def test_bandwidth_limits_many_threads() -> None:
    for name, (instructions, lines) in WORK.items():
        assert env_time(FREE, name, 192) == instructions / FREE.instructions_per_ns
        assert env_time(replace(FREE, bandwidth=1), name, 64) == 64 * lines * 128


def test_a_mutex_that_all_threads_take_limits_many_cheap_environments() -> None:
    assert one_queue(Costs(), 300, 16_384, 64).waiting > 10 * shares(Costs(), 300, 16_384, 64).waiting
