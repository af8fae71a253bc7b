"""Observers that watch a trainer: `endless_gym.watch`."""

import gc
import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

import endless_gym

ID = "Endless-MortarMayhem-v0"
NUM_ENVS = 4

# A trainer in a separate process. It plays one step per line of its standard input.
TRAINER = f"""
import sys, endless_gym
envs = endless_gym.serve({ID!r}, {NUM_ENVS}, groups=int(sys.argv[1]), seed=0)
envs.action_space.seed(0)
envs.reset(seed=0)
print(envs._engine.service, flush=True)
for line in sys.stdin:
    for group in range(envs.num_groups):
        envs.send(envs.action_space.sample(), group)
        envs.recv(group)
    print("played", flush=True)
envs.close()
"""


class Trainer:
    """A trainer's process."""

    def __init__(self, groups: int) -> None:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.process = subprocess.Popen([sys.executable, "-c", TRAINER, str(groups)], **pipes)
        self.service = self.process.stdout.readline().strip()
        assert self.service

    def step(self) -> None:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline() == "played\n"


@pytest.fixture
def trainer(request: pytest.FixtureRequest) -> Iterator[Trainer]:
    started = Trainer(groups=getattr(request, "param", 1))
    yield started
    if started.process.poll() is None:
        started.process.communicate(timeout=60)
    gc.collect()
    assert started.process.returncode == 0


def test_watched_batches_equal_those_of_the_trainer(trainer: Trainer) -> None:
    with endless_gym.make_vec(ID, NUM_ENVS, seed=0) as envs, endless_gym.watch(trainer.service) as batches:
        assert (batches.id, batches.num_envs, batches.num_groups) == (ID, NUM_ENVS, 1)
        assert batches.observation_space == envs.observation_space
        envs.action_space.seed(0)
        envs.reset(seed=0)
        ends = 0
        for step in range(2, 62):
            trainer.step()
            batch = next(batches)
            observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
            # The first batch was that of the reset.
            assert (batch.step, batch.group, batch.missed) == (step, 0, 0)
            np.testing.assert_array_equal(batch.observation, observation)
            np.testing.assert_array_equal(batch.reward, reward)
            np.testing.assert_array_equal(batch.terminated, terminated)
            np.testing.assert_array_equal(batch.truncated, truncated)
            assert batch.info.keys() == info.keys()
            np.testing.assert_array_equal(batch.info["ground_truth"], info["ground_truth"])
            if terminated.any():
                ends += 1
                np.testing.assert_array_equal(batch.info["reward"], info["reward"])
        assert ends, "no episode ended"
        with pytest.raises(ValueError, match="read-only"):
            batch.observation[0] = 0
    # Arrays outlive the watch.
    np.testing.assert_array_equal(batch.observation, observation)


def test_a_watch_goes_on_after_a_timeout_and_counts_what_it_misses(trainer: Trainer) -> None:
    with endless_gym.watch(trainer.service, timeout=0.2) as batches:
        with pytest.raises(TimeoutError):
            next(batches)
        trainer.step()
        assert next(batches).missed == 0
        for _ in range(5):
            trainer.step()
        batch = next(batches)
        assert (batch.step, batch.missed, batches.missed) == (7, 4, 4)
        trainer.step()
        batches.close()
        assert list(batches) == []


@pytest.mark.parametrize("trainer", [3], indirect=True)
def test_one_group_or_all_can_be_watched(trainer: Trainer) -> None:
    with endless_gym.watch(trainer.service) as batches, endless_gym.watch(trainer.service, group=1, copy=True) as one:
        for _ in range(3):
            trainer.step()
            watched = [next(batches) for _ in range(3)]
            assert sorted(batch.group for batch in watched) == [0, 1, 2]
            assert all(batch.missed == 0 for batch in watched)
            batch = next(one)
            assert (batch.group, batch.missed) == (1, 0)
            (same,) = [other for other in watched if other.group == 1]
            np.testing.assert_array_equal(batch.observation, same.observation)
            batch.observation[:] = 0
            del watched, same
    with pytest.raises(ValueError, match="group"):
        endless_gym.watch(trainer.service, group=3)


def test_a_watch_ends_with_its_engine(trainer: Trainer) -> None:
    with endless_gym.watch(trainer.service, timeout=None) as batches:
        trainer.step()
        steps = []
        for batch in batches:
            steps.append(batch.step)
            trainer.process.stdin.close()
            trainer.process.wait(60)
        assert steps == [2]
        assert list(batches) == []
    with pytest.raises(ConnectionError, match="no engine"):
        endless_gym.watch(trainer.service, timeout=0.1)


def test_a_forked_child_does_not_use_the_watch(trainer: Trainer) -> None:
    with endless_gym.watch(trainer.service) as batches:
        child = os.fork()
        if child == 0:
            try:
                next(batches)
            except RuntimeError as error:
                os._exit(0 if "forked" in str(error) else 2)
            os._exit(1)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        trainer.step()
        assert next(batches).step == 2
