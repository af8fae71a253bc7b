"""A copy of the frames that is kept up to date from changes equals the frames, in every format, in process and served."""

import gc
import itertools
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch

import endless_gym
from endless_gym import Frames, ObservationCopy

FORMATS = [
    None,
    Frames(grayscale=True),
    Frames(channels_first=True, row_major=True),
    Frames(grayscale=True, stack=3),
    Frames(channels_first=True, stack=2),
]
ARGUMENTS: dict[str, Any] = {"seed": 5, "changes": True, "options": {"agent_scale": 0.2}}


def frames_of(observation: Any) -> np.ndarray:
    frames: np.ndarray = observation["visual_observation"] if isinstance(observation, dict) else observation
    return frames


def check(envs: endless_gym.EndlessVectorEnv, steps: int = 80) -> float:
    """Plays with resets of some environments, and checks copies of every kind. Returns the share of bytes that were copied."""
    every, sometimes = ObservationCopy(envs), ObservationCopy(envs)
    moved = ObservationCopy(envs, device="cpu")
    generator = np.random.default_rng(3)
    envs.action_space.seed(2)
    observation, _ = envs.reset()
    copied = 0
    for step in range(steps):
        if step == 0:
            assert every.update(observation) == every.array.nbytes
        else:
            copied += every.update(observation)
        moved.update(observation)
        assert moved.tensor.data_ptr() != moved.array.ctypes.data
        copies = [every.array, every.tensor.numpy(), moved.array, moved.tensor.numpy()]
        if generator.random() < 0.5:
            sometimes.update(observation)
            copies.append(sometimes.array)
        for copy in copies:
            np.testing.assert_array_equal(copy, frames_of(observation))
        if generator.random() < 0.1:
            mask = generator.random(envs.num_envs) < 0.5
            observation, _ = envs.reset(seed=step, options={"reset_mask": mask})
        elif generator.random() < 0.1:
            observation, _ = envs.restore({0: envs.snapshot(1)})
        else:
            observation, *_ = envs.step(envs.action_space.sample())
    return copied / (steps - 1) / every.array.nbytes


@pytest.mark.parametrize("frames", FORMATS)
@pytest.mark.parametrize("id", ["MortarMayhemB-v0", "SearingSpotlights-v0"])
def test_copies_equal_the_frames(id: str, frames: Frames | None) -> None:
    with endless_gym.make_vec(id, 3, autoreset="same_step", frames=frames, **ARGUMENTS) as envs:
        share = check(envs)
        assert (frames is not None and frames.stack > 1) or share < 0.5, share


def test_copies_equal_the_frames_of_an_engine_process() -> None:
    with endless_gym.serve("MysteryPath-v0", 4, observation="rgb+features", **ARGUMENTS) as envs:
        assert 0 < check(envs) < 0.3


def test_without_changes_everything_is_copied() -> None:
    with endless_gym.make_vec("MysteryPath-v0", 2, seed=1) as envs:
        copy = ObservationCopy(envs)
        observation, _ = envs.reset()
        for _ in range(3):
            assert copy.update(observation) == copy.array.nbytes
            np.testing.assert_array_equal(copy.array, observation)
            observation, *_ = envs.step(envs.action_space.sample())


def test_writes_to_a_batch_and_to_a_copy_are_copied_over() -> None:
    with endless_gym.make_vec("MortarMayhem-Grid-v0", 2, **{**ARGUMENTS, "options": {}}) as envs:
        copy = ObservationCopy(envs)
        observation, _ = envs.reset()
        copy.update(observation)
        torch.from_dlpack(endless_gym.DLPackView(observation)).fill_(77)
        assert copy.update(observation) == copy.array.nbytes
        del observation
        gc.collect()
        observation, *_ = envs.step([0, 0])
        assert copy.update(observation) == copy.array.nbytes
        np.testing.assert_array_equal(copy.array, observation)
        copy.array[:] = 1
        copy.forget()
        copy.update(observation)
        np.testing.assert_array_equal(copy.array, observation)


def test_other_arrays_are_refused() -> None:
    with endless_gym.make_vec("MysteryPath-v0", 3, seed=1, changes=True) as envs:
        copy = ObservationCopy(envs)
        observation, _ = envs.reset()
        for other in (observation.copy(), observation[1:], observation[:, 1:], observation[::2], np.zeros(3)):
            with pytest.raises(TypeError, match="observation must be the array of a step of these environments"):
                copy.update(other)
        with (
            endless_gym.make_vec("MysteryPath-v0", 4) as larger,
            pytest.raises(TypeError, match="of these environments"),
        ):
            copy.update(larger.reset()[0])
    with (
        endless_gym.make_vec("MysteryPath-v0", 3, observation="features", changes=True) as blind,
        pytest.raises(ValueError, match="needs a batch with the section `observation`"),
    ):
        ObservationCopy(blind)


#: Prints for each batch the share that was copied, or -1 for one that it leaves out.
WATCHER = """
import sys
import endless_gym

with endless_gym.watch(sys.argv[1]) as batches:
    copy = endless_gym.ObservationCopy(batches)
    print("ready", flush=True)
    for number, batch in enumerate(batches):
        share = -1.0
        if number % 7 != 5:
            share = copy.update(batch.observation) / copy.array.nbytes
            assert (copy.array == batch.observation).all()
        print(share, flush=True)
        if number == 27:
            break
"""


def test_a_watch_that_misses_batches_copies_everything_once() -> None:
    with endless_gym.serve("MysteryPath-v0", 4, **ARGUMENTS) as envs:
        service = envs._backend._engine.service  # type: ignore[attr-defined]
        envs.reset()
        command = [sys.executable, "-c", WATCHER, service]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ) as watcher:
            assert watcher.stdout is not None
            assert watcher.stdout.readline() == "ready\n"
            shares = []
            for _ in range(28):
                # The next step comes when the watcher has read this one, so that it misses none by itself.
                envs.step(envs.action_space.sample())
                shares.append(float(watcher.stdout.readline()))
        assert watcher.returncode == 0
    following = [share for before, share in zip([-1.0, *shares], shares, strict=False) if before < 0 <= share]
    others = [share for before, share in itertools.pairwise(shares) if before >= 0 and share >= 0]
    assert following == [1.0] * 5 and len(others) == 19
    assert min(others) < 0.5
