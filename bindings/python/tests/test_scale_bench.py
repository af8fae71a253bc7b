"""The model of `benches/scale.py`, and its program with one small measurement."""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from rich.console import Console

from endless_gym_agents.logs import read_progress
from endless_gym_agents.settings import PRESETS
from endless_gym_agents.train import parse

BENCHES = Path(__file__).parents[3] / "benches"
sys.path.insert(0, str(BENCHES))

import scale  # noqa: E402
from scale_model import (  # noqa: E402
    EXCHANGES,
    Cluster,
    Link,
    RankCosts,
    fitted_learning,
    fitted_link,
    predict,
    scaling,
)

RANKS = [1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024]
RANK = RankCosts(
    steps=4096,
    environment=0.05,
    inference=0.2,
    epoch=0.15,
    minibatch=0.01,
    other_rank=0.0,
    epochs=3,
    minibatches=4,
    sequences=400_000,
    gradient_bytes=1_000_000,
)


def test_one_rank_costs_what_was_measured() -> None:
    rank = replace(RANK, sequences=7, spread=0.3, other_rank=0.01)
    alone = predict(rank, Cluster(Link(1e-3, 1e6), Link(1e-3, 1e6)), 1)
    assert math.isclose(alone.total, 0.05 + 0.2 + 3 * (0.15 + 4 * 0.01), rel_tol=1e-12)
    assert math.isclose(alone.steps_per_second, 4096 / alone.total, rel_tol=1e-12)
    assert math.isclose(alone.efficiency, 1.0, rel_tol=1e-12)
    measured = {"environment": 0.05, "inference": 0.2, "learning": 0.57}
    for name, seconds in alone.seconds.items():
        assert math.isclose(seconds, measured.get(name, 0.0), rel_tol=1e-12, abs_tol=1e-12), name
    assert alone.limit == "learning"


def test_a_perfect_network_and_equal_ranks_scale_perfectly() -> None:
    # One sequence less or more in a minibatch is all that is left to wait for.
    for row in scaling(RANK, Cluster(), RANKS):
        assert row.seconds["all-reduce"] == 0.0
        assert row.seconds["slowest rank"] == 0.0
        assert 0.99 < row.efficiency <= 1.0 + 1e-12
        assert row.steps == row.ranks * 4096


def test_more_ranks_are_never_more_efficient() -> None:
    cluster = Cluster(Link(1e-5, 1e10), Link(1e-4, 1e9), ranks_per_machine=8)
    rank = replace(RANK, sequences=200, spread=0.1, other_rank=1e-4)
    rows = scaling(rank, cluster, RANKS)
    for fewer, more in pairwise(rows):
        assert more.efficiency < fewer.efficiency
        for name in ("other ranks' steps", "uneven minibatches", "slowest rank", "all-reduce"):
            assert more.seconds[name] > fewer.seconds[name], (name, more.ranks)


@pytest.mark.parametrize(
    "better",
    [
        {"cluster": Cluster(Link(1e-4, 1e9), Link(1e-5, 1e9))},
        {"cluster": Cluster(Link(1e-4, 1e9), Link(1e-4, 1e10))},
        {"rank": replace(RANK, sequences=200, spread=0.05)},
        {"rank": replace(RANK, sequences=2000, spread=0.1)},
        {"rank": replace(RANK, sequences=200, spread=0.1, gradient_bytes=100_000)},
    ],
)
def test_better_parameters_are_faster(better: dict[str, Cluster | RankCosts]) -> None:
    worse = {"rank": replace(RANK, sequences=200, spread=0.1), "cluster": Cluster(Link(1e-4, 1e9), Link(1e-4, 1e9))}
    for ranks in (16, 256):
        assert predict(**(worse | better), ranks=ranks).total < predict(**worse, ranks=ranks).total


def test_a_ring_sends_what_the_formula_says() -> None:
    link = Link(latency=1e-3, bandwidth=1e6)
    assert math.isclose(link.all_reduce(4, 500_000), 2 * 3 * 1e-3 + 2 * 3 / 4 * 0.5)
    assert link.all_reduce(1, 500_000) == 0.0
    rank = replace(RANK, steps=1000)
    reduced = predict(rank, Cluster(between=link), 4).seconds["all-reduce"]
    assert math.isclose(reduced, 12 * (6e-3 + 1.5) + EXCHANGES * 3e-3 + 3 * (1e-3 + 9e-3))
    # Between machines only if there are several, and then the slowest link of the ring limits it.
    assert predict(rank, Cluster(between=link, ranks_per_machine=4), 4).seconds["all-reduce"] == 0.0
    assert Cluster(Link(1e-3, 1e9), Link(1e-4, 1e6), ranks_per_machine=4).link(5) == Link(1e-3, 1e6)
    assert Cluster(Link(1e-3, 1e5), Link(1e-4, 1e6)).link(5) == Link(1e-4, 1e6)


def test_a_link_is_found_from_what_it_costs() -> None:
    link = Link(latency=1e-4, bandwidth=2e9)
    for ranks in (2, 4):
        found = fitted_link(ranks, link.all_reduce(ranks, 0), link.all_reduce(ranks, 10_000_000), 10_000_000)
        assert math.isclose(found.latency, link.latency)
        assert math.isclose(found.bandwidth, link.bandwidth)
    assert fitted_link(2, 1e-3, 0.9e-3, 1000).bandwidth == math.inf


def test_the_cost_of_a_minibatch_is_found_from_two_epochs() -> None:
    epoch, minibatch = fitted_learning(0.15 + 4 * 0.01, 0.15 + 8 * 0.01, 4, 2)
    assert math.isclose(epoch, 0.15)
    assert math.isclose(minibatch, 0.01)
    # Noise may make the larger number of minibatches the faster one, and no cost is negative.
    assert fitted_learning(0.2, 0.19, 4, 2) == (0.2, 0.0)
    assert fitted_learning(0.2, 0.5, 4, 2) == (0.0, 0.05)


def test_ranks_that_share_cores_compute_longer() -> None:
    own, shared = (Cluster(ranks_per_machine=4, cores=cores) for cores in (4, 2))
    rank = replace(RANK, other_rank=0.01)
    one, two = predict(rank, own, 4), predict(rank, shared, 4)
    assert one.seconds["shared cores"] == 0.0
    assert math.isclose(two.total, 2 * one.total)
    # Those of another machine share nothing with them.
    assert predict(rank, Cluster(ranks_per_machine=2, cores=2), 4).seconds["shared cores"] == 0.0


def test_waiting_is_that_of_the_slowest_rank() -> None:
    rank = replace(RANK, epoch=0.0, minibatch=0.0, spread=0.1)
    waited = predict(rank, Cluster(), 16, updates=4000).seconds["slowest rank"] / 0.25
    # The largest of 16 draws of a log-normal distribution with this spread.
    expected = np.random.default_rng(5).lognormal(-0.005, math.sqrt(math.log1p(0.01)), (100_000, 16)).max(1).mean() - 1
    assert abs(waited - expected) < 0.01
    assert predict(rank, Cluster(), 16, seed=1).total == predict(rank, Cluster(), 16, seed=1).total
    assert predict(rank, Cluster(), 16, seed=1).total != predict(rank, Cluster(), 16, seed=2).total


def test_uneven_minibatches_are_those_of_a_shuffle() -> None:
    rank = replace(RANK, environment=0.0, inference=0.0, minibatch=0.0, sequences=20)
    uneven = predict(rank, Cluster(), 8, updates=500).seconds["uneven minibatches"] / (3 * 0.15)
    generator = np.random.default_rng(5)
    owner = np.repeat(np.arange(8), 20)
    largest = [
        max(np.bincount(part, minlength=8)) / 20
        for _ in range(2000)
        for part in generator.permutation(owner).reshape(4, -1)
    ]
    assert abs(uneven - (4 * np.mean(largest) - 1)) < 0.01


def checked(monkeypatch: pytest.MonkeyPatch, cores: list[int], unconnected: float) -> dict[str, Any]:
    """What `--check` finds if runs of torchrun make these steps per second."""
    measured = {1: 10_000.0, 2: 15_000.0, 4: 14_000.0}
    monkeypatch.setattr(scale, "train_ranks", lambda ranks, *_: measured[ranks])
    monkeypatch.setattr(scale, "unconnected_runs", lambda number, *_: {2: unconnected}[number])
    given = argparse.Namespace(updates=1, seed=0)
    return scale.check(RANK, Link(1e-4, 1e9), cores, [], PRESETS["quick"], given)


def printed(found: dict[str, Any], cores: int) -> str:
    console = Console(width=200)
    with console.capture() as capture:
        scale.print_check(console, found, cores, 1)
    return capture.get()


def test_the_check_divides_the_loss_between_the_machine_and_communication(monkeypatch: pytest.MonkeyPatch) -> None:
    found = checked(monkeypatch, [0, 1], 18_750.0)
    assert (found["weak_scaling"], found["unconnected"], found["connected_share"]) == (1.5, 1.875, 0.8)
    assert [(row["ranks"], row["cores"], row["measured"]) for row in found["rows"]] == [
        (1, 1, 10_000.0),
        (2, 2, 15_000.0),
        (4, 2, 14_000.0),
    ]
    text = printed(found, 2)
    assert "two ranks with one core each make 1.50 times the steps of one (goal: 1.7)" in text
    assert "two unconnected runs: 1.88 times; two ranks make 80% of that: communication and waiting cost 20%" in text
    # Other processes may have disturbed the unconnected runs more.
    noisy = printed(checked(monkeypatch, [0, 1], 12_000.0), 2)
    assert "two unconnected runs: 1.20 times; two ranks make 125% of that: no cost of communication was found" in noisy


def test_without_a_core_for_each_of_two_ranks_weak_scaling_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    found = checked(monkeypatch, [0], 1.0)
    assert [found[name] for name in ("weak_scaling", "unconnected", "connected_share")] == [None] * 3
    text = printed(found, 1)
    assert "weak scaling: not measured, since two ranks need 2 cores, and there are 1" in text
    assert "unconnected" not in text


def test_the_report_has_only_numbers_of_json() -> None:
    link = fitted_link(2, 1e-3, 0.9e-3, 1000)
    report = scale.as_json({"link": asdict(link), "times": [1.5, math.nan, (-math.inf,)], 1: "inf", "none": None})
    assert report == {
        "link": {"latency": 0.0005, "bandwidth": None},
        "times": [1.5, None, [None]],
        1: "inf",
        "none": None,
    }
    json.dumps(report, allow_nan=False)


@pytest.mark.slow
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_unconnected_runs_train_at_once_on_cores_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = ["--environment.num-envs", "4", "--ppo.steps", "16", "--ppo.minibatches", "1", "--ppo.epochs", "1"]
    arguments = ["--preset", "quick", "--env", "MortarMayhem-Grid-v0", "--device", "cpu", "--threads", "1", *sizes]
    cores, seen = sorted(os.sched_getaffinity(0))[:2], {}

    def reading(run: Path) -> list[dict[str, Any]]:
        for child in psutil.Process().children():
            if "endless_gym_agents.train" in child.cmdline():
                seen[child.pid] = child.cpu_affinity()
        return read_progress(run)

    monkeypatch.setattr(scale, "read_progress", reading)
    assert scale.unconnected_runs(2, arguments, parse(arguments), cores, 2) > 0
    assert sorted(seen.values()) == [[core] for core in cores]
    assert not any(psutil.pid_exists(pid) for pid in seen)
    assert sorted(os.sched_getaffinity(0))[:2] == cores


@pytest.mark.slow
def test_an_unconnected_run_that_fails_is_an_error() -> None:
    arguments = ["--preset", "quick", "--threads", "1"]
    with pytest.raises(SystemExit, match=r"an unconnected run ended with status 1:\n(.|\n)*--ppo.epochs"):
        scale.unconnected_runs(1, [*arguments, "--ppo.epochs", "0"], parse(arguments), [0], 1)


@pytest.mark.slow
def test_the_program_measures_and_predicts(tmp_path: Path) -> None:
    small = ["--environment.num-envs", "4", "--ppo.steps", "32", "--ppo.minibatches", "2", "--ppo.epochs", "1"]
    program = [sys.executable, str(BENCHES / "scale.py"), "--json", str(tmp_path / "scale.json")]
    done = subprocess.run(
        [*program, "--updates", "1", "--agent", "trxl", "--", *small], capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "scale.json").read_text())
    rank = report["rank"]
    assert (rank["steps"], rank["sequences"], rank["minibatches"], rank["epochs"]) == (128, 4, 2, 1)
    assert all(rank[name] > 0 for name in ("environment", "inference", "environment_step"))
    # On so few steps, noise may leave nothing for one of the two.
    assert rank["epoch"] + rank["minibatch"] > 0
    assert [row["ranks"] for row in report["machines"]] == [row["ranks"] for row in report["gpu_machines"]] == RANKS
    (first, *_) = report["machines"]
    alone = rank["environment"] + rank["inference"] + rank["epoch"] + 2 * rank["minibatch"]
    assert math.isclose(first["steps_per_second"], 128 / alone)
    assert "1,024" in done.stdout
    assert "check" not in report


def test_the_program_refuses_more_cores_than_there_are() -> None:
    done = subprocess.run(
        [sys.executable, str(BENCHES / "scale.py"), "--cores", "100000"], capture_output=True, text=True, timeout=280
    )
    assert done.returncode == 2
    assert "--cores must be 1 to" in done.stderr
    assert "got 100000" in done.stderr
