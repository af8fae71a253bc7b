"""Vector environments in this process and in an engine process have the same class and the same results."""

import copy
import gc
import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from support import WHERE, same

import endless_gym

ID = "Endless-MortarMayhem-v0"


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("elsewhere", WHERE)
def test_snapshots_continue_identically_in_process_and_served(where, elsewhere) -> None:
    with where(ID, 3, groups=2) as envs, elsewhere(ID, 3, groups=2, seed=8) as others:
        envs.reset(seed=1)
        others.reset()
        for _ in range(20):
            envs.send(np.ones((3, 2), np.int64), 1)
            last = envs.recv(1)[0].copy()
        snapshots = {2 - env: envs.snapshot(env, group=1) for env in range(3)}
        shown, info = others.restore(snapshots, group=1)
        np.testing.assert_array_equal(shown, last[::-1])
        assert info.keys() == others.reset(group=0)[1].keys()
        for step in range(60):
            envs.send(np.full((3, 2), step % 3), 1)
            others.send(np.full((3, 2), step % 3), 1)
            one, other = envs.recv(1), others.recv(1)
            np.testing.assert_array_equal(one[0], other[0][::-1])
            np.testing.assert_array_equal(one[1], other[1][::-1])


@pytest.mark.parametrize("where", WHERE)
def test_arrays_are_views_that_do_not_change(where) -> None:
    with where(ID, 3, seed=1) as envs:
        first, _ = envs.reset()
        kept = first.copy()
        for _ in range(4):
            envs.step(np.ones((3, 2), dtype=np.int64))
        np.testing.assert_array_equal(first, kept)
        assert not first.flags.writeable
        assert not first.flags.owndata
        with pytest.raises(ValueError, match="read-only"):
            first[0] = 0
    np.testing.assert_array_equal(first, kept)


@pytest.mark.parametrize("where", WHERE)
def test_copies_are_writable_and_independent(where) -> None:
    with where(ID, 2, seed=1, copy=True) as envs:
        observation, info = envs.reset()
        # More steps than a served engine lends.
        held = [envs.step(np.zeros((2, 2), dtype=np.int64)) for _ in range(20)]
        with endless_gym.make_vec(ID, 2, seed=1) as twin:
            same((observation, info), twin.reset())
            for step in held:
                same(step[:4], twin.step(np.zeros((2, 2), dtype=np.int64))[:4])
        for *arrays, last in [(observation, info), *held]:
            for array in (*arrays, last["ground_truth"], last["_ground_truth"]):
                assert array.flags.owndata
                array[:] = 0
        assert envs.step(np.zeros((2, 2), dtype=np.int64))[4]["_ground_truth"].all()


def test_buffers_in_this_process_are_reused() -> None:
    envs = endless_gym.make_vec(ID, 2, seed=1)
    envs.reset()
    places = {envs.step(np.zeros((2, 2), dtype=np.int64))[0].ctypes.data for _ in range(20)}
    assert len(places) <= 2


def test_holding_too_many_batches_raises_and_says_what_to_do() -> None:
    with endless_gym.serve(ID, 2, batches_held=3) as envs:
        envs.reset()
        held = []
        with pytest.raises(endless_gym.TooManyBatchesHeld, match="copy"):
            for _ in range(5):
                held.append(envs.step(np.zeros((2, 2), dtype=np.int64)))
        held.clear()
        gc.collect()
        envs.recv(0)
        envs.step(np.zeros((2, 2), dtype=np.int64))


@pytest.mark.parametrize("where", WHERE)
def test_pickle_and_copy_are_refused_with_what_to_do_instead(where) -> None:
    with where(ID, 2) as envs:
        for copied in (pickle.dumps, copy.copy, copy.deepcopy):
            with pytest.raises(
                TypeError, match="vector environments cannot be pickled or copied; make them in the process"
            ):
                copied(envs)


def test_free_threaded_builds_are_refused_at_import() -> None:
    code = "import sys; sys.version = '3.14.0 free-threading build (main)'; import endless_gym"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "\nImportError: endless_gym does not support free-threaded builds of CPython; use one with" in done.stderr


def test_gymnasiums_make_vec_returns_this_class() -> None:
    envs = gymnasium.make_vec(f"EndlessGym/{ID}", num_envs=8, seed=1, num_threads=1)
    assert isinstance(envs, endless_gym.EndlessVectorEnv)
    observation, _ = envs.reset()
    np.testing.assert_array_equal(observation, endless_gym.make_vec(ID, 8, seed=1).reset()[0])


def transposed(axes: tuple[int, ...]):
    """A wrapper that changes the order of a frame's axes."""

    def wrap(env: gymnasium.Env) -> gymnasium.Env:
        shape = tuple(env.observation_space.shape[axis] for axis in axes)
        space = gymnasium.spaces.Box(0, 255, shape, np.uint8)
        return gymnasium.wrappers.TransformObservation(env, lambda frame: frame.transpose(axes), space)

    return wrap


def stacked(number: int):
    return lambda env: gymnasium.wrappers.FrameStackObservation(env, number)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    ("frames", "wrappers"),
    [
        (endless_gym.Frames(grayscale=True), [gymnasium.wrappers.GrayscaleObservation]),
        (endless_gym.Frames(grayscale=True, stack=4), [gymnasium.wrappers.GrayscaleObservation, stacked(4)]),
        (endless_gym.Frames(channels_first=True), [transposed((2, 0, 1))]),
        (endless_gym.Frames(row_major=True), [transposed((1, 0, 2))]),
        (endless_gym.Frames(channels_first=True, row_major=True, stack=2), [transposed((2, 1, 0)), stacked(2)]),
    ],
)
def test_frames_equal_those_of_gymnasiums_wrappers(where, mode: AutoresetMode, frames, wrappers) -> None:
    def wrapped() -> gymnasium.Env:
        env: gymnasium.Env = endless_gym.Env("Endless-SearingSpotlights-v0")
        for wrapper in wrappers:
            env = wrapper(env)
        return env

    sync = SyncVectorEnv([wrapped] * 3, autoreset_mode=mode)
    with where("Endless-SearingSpotlights-v0", 3, autoreset=mode, frames=frames) as envs:
        assert envs.single_observation_space == sync.single_observation_space
        envs.action_space.seed(1)
        same(envs.reset(seed=5)[0], sync.reset(seed=5)[0])
        ends = 0
        for _ in range(150):
            actions = envs.action_space.sample()
            step, wanted = envs.step(actions), sync.step(actions)
            same(step[:4], wanted[:4])
            if "final_obs" in wanted[4]:
                same(step[4]["final_obs"], wanted[4]["final_obs"])
            ends += int(step[2].sum())
        assert ends > 0
