"""Training runs whose engine process is killed have the same results, or save a checkpoint, or raise an error."""

import os
import random
import re
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents_helpers import GRID, assert_equal_runs, changed, progress, small

import endless_gym_agents.training.train as train_module
from endless_gym import EngineLost, make_vec, serve
from endless_gym_agents.environments.groups import Environments
from endless_gym_agents.environments.recovery import MAX_RESTARTS, RecoverableEngine
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import train

UPDATES = 4


def kill(engine: RecoverableEngine) -> None:
    """Kill the engine process, if there is one."""
    process = engine._envs._engine if engine.failure is None else None
    if process is not None:
        os.kill(process.pid, signal.SIGKILL)


def kill_before(monkeypatch: pytest.MonkeyPatch, place: str, calls: set[int]) -> None:
    """Kill the engine process before these calls of a method of the environments, or of `learn`; calls count from 0."""
    engines: list[RecoverableEngine] = []
    started = RecoverableEngine.__init__
    owner, name = (train_module, place) if place == "learn" else (Environments, place)
    called, number = getattr(owner, name), 0

    def start(self: RecoverableEngine, *args: Any) -> None:
        engines.append(self)
        started(self, *args)

    def call(*args: Any) -> Any:
        nonlocal number
        if number in calls:
            kill(engines[-1])
        number += 1
        return called(*args)

    monkeypatch.setattr(RecoverableEngine, "__init__", start)
    monkeypatch.setattr(owner, name, call)


#: Each update has 32 calls of `send` and `receive`, 16 for each of two groups.
PLACES = [
    ("send", 1),
    ("receive", 1),
    ("send", 32 * UPDATES),
    ("receive", 32 * UPDATES),
    ("mark", UPDATES),
    ("learn", UPDATES),
    ("snapshots", 2),
]


@pytest.mark.parametrize(("place", "number"), PLACES)
def test_a_run_whose_engine_is_killed_equals_an_undisturbed_run(
    place: str,
    number: int,
    undisturbed: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    at = random.Random(f"{place} {number}").randrange(number)
    kill_before(monkeypatch, place, {at})
    run = train(small("gru", tmp_path / "run", UPDATES, engine="process"))
    assert_equal_runs(run, undisturbed)
    output = capsys.readouterr().out
    assert output.count(f"the engine process has ended; restart 1 of {MAX_RESTARTS}") == 1, at
    assert re.search(r"a new engine process continues the update, after \d+ steps that were played again", output)


def test_restarts_are_counted_per_update(undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kill_before(monkeypatch, "receive", {3, 17, 40, 41, 60, 90, 127})
    assert_equal_runs(train(small("gru", tmp_path / "run", UPDATES, engine="process")), undisturbed)


WRAPPER = """
from gymnasium.vector import VectorRewardWrapper

class Growing(VectorRewardWrapper):
    calls = 0

    def rewards(self, rewards):
        self.calls += 1
        return rewards + 0.001 * self.calls

    def state_dict(self):
        return {"calls": self.calls}

    def load_state_dict(self, state):
        self.calls = state["calls"]
"""


def test_a_wrapper_does_not_notice_that_the_engine_was_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "growing.py").write_text(WRAPPER)
    wrapper = {"wrapper": (f"{tmp_path}/growing.py:Growing",)}
    one, two = (changed(small("gru", tmp_path / name, 2, engine="process"), environment=wrapper) for name in "ab")
    undisturbed = train(one)
    kill_before(monkeypatch, "receive", {37})
    assert_equal_runs(train(two), undisturbed)
    assert "a new engine process continues the update, after " in capsys.readouterr().out


@pytest.mark.parametrize("policy", ["restart", "save"])
def test_run_saves_a_checkpoint_when_the_engine_is_given_up(
    policy: str, undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # The engine fails from the second update on, after which no regular checkpoint is due.
    given = replace(
        small("gru", tmp_path / "run", UPDATES, engine="process"), on_engine_failure=policy, checkpoint_interval=100
    )
    with monkeypatch.context() as patch:
        kill_before(patch, "receive", set(range(40, 1000)))
        reason = "the engine process has ended"
        if policy == "restart":
            reason += f" after {MAX_RESTARTS} restarts without a completed update"
        with pytest.raises(
            EngineLost,
            match=f"^{reason}; the checkpoint is of update 2; continue with: endless-train --resume {given.run}$",
        ):
            train(given)
    assert f"{reason}; the update is completed in this process" in capsys.readouterr().out
    assert checkpoint.load(given.run).update == 2
    assert len(progress(Path(given.run))) == 2
    train(replace(given, resume=given.run))
    assert_equal_runs(Path(given.run), undisturbed)


def test_policy_fail_raises_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = replace(small("gru", tmp_path / "run", UPDATES, engine="process"), on_engine_failure="fail")
    with monkeypatch.context() as patch:
        kill_before(patch, "receive", {100})
        with pytest.raises(EngineLost, match="has ended"):
            train(given)
    assert checkpoint.load(given.run).update == 2


def test_a_resumed_run_recovers(undisturbed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = train(small("gru", tmp_path / "run", 2, engine="process"))
    with monkeypatch.context() as patch:
        # After the restoration of the checkpoint, before the first mark.
        kill_before(patch, "mark", {0})
        train(replace(small("gru", tmp_path, UPDATES, engine="process"), resume=str(run)))
    assert_equal_runs(run, undisturbed)


def test_an_engine_that_does_not_answer_is_replaced() -> None:
    """A stopped process is alive, and only SIGKILL ends it."""
    arguments = {"num_envs": 2, "groups": 2, "seed": 1, "autoreset": "same_step"}
    serving = partial(serve, GRID, timeout=5.0, **arguments)
    engine = RecoverableEngine("restart", serving, partial(make_vec, GRID, **arguments))
    lines: list[str] = []
    engine.report = lines.append
    first = engine._envs
    with first, make_vec(GRID, **arguments) as twin:
        for group in range(2):
            np.testing.assert_array_equal(engine.reset(group=group)[0], twin.reset(group=group)[0])
        for step in range(40):
            for envs in (engine, twin):
                for group in range(2):
                    envs.send(np.full(2, (step + group) % 4), group)
            if step == 20:
                os.kill(first._engine.pid, signal.SIGSTOP)
            for group in range(2):
                for given, wanted in zip(engine.recv(group)[:4], twin.recv(group)[:4], strict=True):
                    np.testing.assert_array_equal(given, wanted)
        engine.close()
    assert lines[0] == f"the engine process does not answer; restart 1 of {MAX_RESTARTS}"
