"""Vector environments in this process and in an engine process have the same class and the same results."""

import contextlib
import gc
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import endless_gym

ID = "Endless-MortarMayhem-v0"
WHERE = [endless_gym.make_vec, endless_gym.serve]


@contextlib.contextmanager
def made(where, *args, **kwargs) -> Iterator[endless_gym.EndlessVectorEnv]:
    with where(*args, **kwargs) as envs:
        yield envs


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize("id", [ID, "MortarMayhemB-Grid-v0", "Endless-SearingSpotlights-v0"])
def test_vector_env_plays_as_sync_vector_env(where, mode: AutoresetMode, id: str) -> None:
    sync = SyncVectorEnv([lambda: endless_gym.Env(id) for _ in range(4)], autoreset_mode=mode)
    with made(where, id, 4, autoreset=mode) as envs:
        assert envs.metadata["autoreset_mode"] is mode
        assert envs.single_observation_space == sync.single_observation_space
        assert envs.action_space == sync.action_space
        envs.action_space.seed(1)
        compare(envs.reset(seed=5), sync.reset(seed=5))
        ends = 0
        for _ in range(300):
            actions = envs.action_space.sample()
            step, wanted = envs.step(actions), sync.step(actions)
            ends += int(step[2].sum())
            compare(step, wanted)
        assert ends > 0


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("elsewhere", WHERE)
def test_snapshots_continue_identically_in_process_and_served(where, elsewhere) -> None:
    with made(where, ID, 3, groups=2) as envs, made(elsewhere, ID, 3, groups=2, seed=8) as others:
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
        with pytest.raises(ValueError, match="not a snapshot"):
            others.restore({0: b"whatever"})
        for env in (3, -1):
            with pytest.raises(ValueError, match=f"env must be 0 to 2, got {env}"):
                others.snapshot(env)
            with pytest.raises(ValueError, match=f"env must be 0 to 2, got {env}"):
                others.restore({env: snapshots[0]})
        others.send(np.zeros((3, 2), np.int64), 1)
        with pytest.raises(RuntimeError, match="pending answer"):
            others.snapshot(0, group=1)
        with pytest.raises(RuntimeError, match="pending answer"):
            others.restore({0: snapshots[0]}, group=1)
        others.recv(1)
    with made(where, ID, 1) as envs, pytest.raises(RuntimeError, match="reset"):
        envs.snapshot(0)


def compare(given: object, wanted: object, path: str = "") -> None:
    if isinstance(wanted, dict):
        assert set(given) == set(wanted), path
        for key, value in wanted.items():
            compare(given[key], value, f"{path}.{key}")
    elif isinstance(wanted, tuple) or (isinstance(wanted, np.ndarray) and wanted.dtype == object):
        for number, (one, other) in enumerate(zip(given, wanted, strict=True)):
            compare(one, other, f"{path}[{number}]")
    else:
        np.testing.assert_array_equal(given, wanted, err_msg=path)


@pytest.mark.parametrize("where", WHERE)
def test_arrays_are_views_that_do_not_change(where) -> None:
    with made(where, ID, 3, seed=1) as envs:
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
def test_copies_are_the_users_own(where) -> None:
    with made(where, ID, 2, seed=1, copy=True) as envs:
        observation, info = envs.reset()
        # More steps than a served engine lends.
        held = [envs.step(np.zeros((2, 2), dtype=np.int64)) for _ in range(20)]
        with endless_gym.make_vec(ID, 2, seed=1) as twin:
            compare((observation, info), twin.reset())
            for step in held:
                for given, wanted in zip(step[:4], twin.step(np.zeros((2, 2), dtype=np.int64)), strict=False):
                    np.testing.assert_array_equal(given, wanted)
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
def test_groups_are_stepped_independently(where) -> None:
    with made(where, ID, 2, groups=2, seed=3) as envs, made(where, ID, 4, seed=3) as all_envs:
        whole, _ = all_envs.reset()
        for group in range(2):
            envs.send_reset(group)
        for group in (1, 0):
            observation, reward, _, _, info = envs.recv(group)
            assert info["group"] == group
            assert not reward.any()
            np.testing.assert_array_equal(observation, whole[2 * group : 2 * group + 2])
        with pytest.raises(RuntimeError, match="nothing was sent to group 1"):
            envs.recv(1)
        envs.send(np.zeros((2, 2), dtype=np.int64), 1)
        with pytest.raises(RuntimeError, match="pending answer"):
            envs.send(np.zeros((2, 2), dtype=np.int64), 1)
        assert envs.recv()[4]["group"] == 1
        with pytest.raises(ValueError, match="group must be 0 to 1, got 7"):
            envs.send(np.zeros((2, 2), dtype=np.int64), 7)


@pytest.mark.parametrize("where", WHERE)
def test_seeds_count_the_environments_of_all_groups(where) -> None:
    with made(where, ID, 2, groups=2) as envs, endless_gym.make_vec(ID, 4) as all_envs:
        whole, _ = all_envs.reset(seed=7)
        assert (whole[:2] != whole[2:]).any()
        for group in range(2):
            envs.send_reset(group, seed=7)
            np.testing.assert_array_equal(envs.recv(group)[0], whole[2 * group : 2 * group + 2])
        np.testing.assert_array_equal(envs.reset(seed=7)[0], whole[:2])
        np.testing.assert_array_equal(envs.reset(seed=7, group=1)[0], whole[2:])
        everything = {"reset_mask": np.ones(2, dtype=bool)}
        np.testing.assert_array_equal(envs.reset(seed=7, group=1, options=everything)[0], whole[2:])


def test_timeouts_are_checked() -> None:
    for timeout in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="timeout must be finite and not negative, got"):
            endless_gym.connect("nobody", timeout=timeout)
    with endless_gym.serve(ID, 1) as served, pytest.raises(ConnectionError, match="already has a trainer"):
        # So long a timeout overflows the clock; the engine is there, so that nothing waits.
        endless_gym.connect(served._engine.service, timeout=1e19)


@pytest.mark.parametrize("where", WHERE)
def test_reset_takes_options_and_a_mask(where) -> None:
    with made(where, "MortarMayhem-v0", 3, autoreset="disabled") as envs:
        usual, _ = envs.reset(seed=1)
        small, _ = envs.reset(seed=1, options={"arena_size": 2})
        assert (usual != small).any()
        assert (envs.reset(seed=1)[0] == usual).all()
        envs.step(np.ones((3, 2), dtype=np.int64))
        mask = np.array([False, True, False])
        envs.reset(options={"reset_mask": mask})
        mixed, _ = envs.reset(seed=[7, None, None], options={"reset_mask": ~mask})
        np.testing.assert_array_equal(mixed[0], envs.reset(seed=7)[0][0])
        with pytest.raises(ValueError, match="reset_mask"):
            envs.reset(options={"reset_mask": [1, 0]})
        with pytest.raises(ValueError, match="arena_sise"):
            envs.reset(options={"arena_sise": 1})


@pytest.mark.parametrize("where", WHERE)
def test_environments_may_have_options_of_their_own(where) -> None:
    each = [{"arena_size": size} for size in (2, 3, 4, 5)]
    with made(where, "MortarMayhem-v0", 2, groups=2, seed=1, options=each) as envs:
        for group in range(2):
            observation, _ = envs.reset(group=group)
            for env in range(2):
                number = 2 * group + env
                alone = endless_gym.Env("MortarMayhem-v0", options=each[number])
                np.testing.assert_array_equal(observation[env], alone.reset(seed=1 + number)[0])
    with pytest.raises(ValueError, match=r"one mapping for each of 2 environments, got 3"):
        where("MortarMayhem-v0", 2, options=each[:3])


@pytest.mark.parametrize("where", WHERE)
def test_options_of_single_environments_are_kept_at_reset(where) -> None:
    each = [{"arena_size": 2}, {"arena_size": 5}]
    with made(where, "MortarMayhem-v0", 2, seed=1, options=each) as envs:
        first, _ = envs.reset(seed=1)
        changed, _ = envs.reset(seed=1, options={"arena_size": 3})
        assert (changed != first).any()
        for options in (None, {"reset_mask": np.ones(2, dtype=bool)}):
            np.testing.assert_array_equal(envs.reset(seed=1, options=options)[0], first)
    with made(where, "MortarMayhem-v0", 1, seed=1, options=each[:1]) as envs:
        first, _ = envs.reset(seed=1)
        changed, _ = envs.reset(seed=1, options=each[1])
        assert (changed != first).any()
        np.testing.assert_array_equal(envs.reset(seed=1)[0], first)


def test_features_come_alone_or_beside_frames() -> None:
    envs = endless_gym.make_vec(ID, 2, seed=1, observation="features")
    observation, _ = envs.reset()
    assert observation.dtype == np.float32
    assert envs.observation_space.contains(observation)
    both, _ = endless_gym.make_vec(ID, 2, seed=1, observation="rgb+features").reset()
    np.testing.assert_array_equal(both["features"], observation)
    assert both["visual_observation"].shape == (2, 84, 84, 3)


def test_gymnasiums_make_vec_returns_this_class() -> None:
    envs = gymnasium.make_vec(f"EndlessGym/{ID}", num_envs=8, seed=1, num_threads=1)
    assert isinstance(envs, endless_gym.EndlessVectorEnv)
    observation, _ = envs.reset()
    np.testing.assert_array_equal(observation, endless_gym.make_vec(ID, 8, seed=1).reset()[0])
    wrapped = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    with endless_gym.make_vec(ID, 8, seed=1) as plain:
        compare(wrapped.reset(seed=2), plain.reset(seed=2))
        actions = envs.action_space.sample()
        compare(wrapped.step(actions), plain.step(actions))


def test_seed_lists_are_used_in_order_and_ranges_drawn_from() -> None:
    one = endless_gym.make_vec(ID, 2, seeds=[3, 4, 5]).reset()[0]
    np.testing.assert_array_equal(one, endless_gym.make_vec(ID, 2, seed=3).reset()[0])
    two = endless_gym.make_vec(ID, 64, seeds=range(2), seed=1).reset()[0]
    assert len({frame.tobytes() for frame in two}) == 2


def test_wrong_arguments_and_calls_raise() -> None:
    with pytest.raises(ValueError, match="MortarMayhem-v0"):
        endless_gym.make_vec("Mortar", 2)
    with pytest.raises(ValueError, match="pixels"):
        endless_gym.make_vec(ID, 2, observation="pixels")
    with pytest.raises(ValueError, match="never"):
        endless_gym.make_vec(ID, 2, autoreset="never")
    with pytest.raises(ValueError, match="1 to"):
        endless_gym.make_vec(ID, 0)
    envs = endless_gym.make_vec(ID, 2)
    with pytest.raises(RuntimeError, match="reset"):
        envs.step(np.zeros((2, 2), dtype=np.int64))
    envs.reset()
    with pytest.raises(ValueError, match=r"the shape \(2, 2\), .*, got the shape \(3, 2\)"):
        envs.step(np.zeros((3, 2), dtype=np.int64))
    envs.close()
    with pytest.raises(RuntimeError, match="closed"):
        envs.step(np.zeros((2, 2), dtype=np.int64))
    with pytest.raises(ValueError, match="arena_sise"):
        endless_gym.serve(ID, 2, options={"arena_sise": 1})
    with pytest.raises(ConnectionError, match="nobody"):
        endless_gym.connect("nobody", timeout=0)


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
def test_frames_are_as_gymnasiums_wrappers_make_them(where, mode: AutoresetMode, frames, wrappers) -> None:
    def wrapped() -> gymnasium.Env:
        env: gymnasium.Env = endless_gym.Env("Endless-SearingSpotlights-v0")
        for wrapper in wrappers:
            env = wrapper(env)
        return env

    sync = SyncVectorEnv([wrapped] * 3, autoreset_mode=mode)
    with made(where, "Endless-SearingSpotlights-v0", 3, autoreset=mode, frames=frames) as envs:
        assert envs.single_observation_space == sync.single_observation_space
        envs.action_space.seed(1)
        compare(envs.reset(seed=5)[0], sync.reset(seed=5)[0])
        ends = 0
        for _ in range(150):
            actions = envs.action_space.sample()
            step, wanted = envs.step(actions), sync.step(actions)
            compare(step[:4], wanted[:4])
            if "final_obs" in wanted[4]:
                compare(step[4]["final_obs"], wanted[4]["final_obs"])
            ends += int(step[2].sum())
        assert ends > 0


@pytest.mark.parametrize("where", WHERE)
def test_impossible_frames_are_refused(where) -> None:
    with pytest.raises(ValueError, match="has no frames"):
        where(ID, 2, observation="features", frames=endless_gym.Frames(stack=2))
    with pytest.raises(ValueError, match="frame stack must be 1 to 64, got 65"):
        where(ID, 2, frames=endless_gym.Frames(stack=65))
