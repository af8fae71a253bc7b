"""Invalid arguments raise exceptions that name the argument, what was given and what is allowed, and never panic."""

import re

import numpy as np
import pytest
from support import WHERE, same

import endless_gym
from endless_gym import _native

ID = "MortarMayhem-v0"


@pytest.mark.parametrize("given", [-1, -1e-300, float("nan"), float("inf"), -float("inf"), 10**400])
def test_timeouts_must_be_finite_and_not_negative(given: float) -> None:
    match = r"^timeout must be finite and not negative, got "
    with pytest.raises(ValueError, match=match):
        endless_gym.serve(ID, timeout=given)
    with pytest.raises(ValueError, match=match):
        endless_gym.connect("nobody", timeout=given)
    if not isinstance(given, int):
        with pytest.raises(ValueError, match=match):
            _native.Connection("nobody", given)
    with endless_gym.serve(ID) as envs:
        envs.reset()
        with pytest.raises(ValueError, match=match):
            envs.reconnect(timeout=given)


def test_a_timeout_is_a_number_of_seconds() -> None:
    with endless_gym.serve(ID, timeout=1e300) as envs:
        envs.reset()
    with pytest.raises(TypeError, match="timeout must be a number of seconds, got 'soon'"):
        endless_gym.connect("nobody", timeout="soon")
    with pytest.raises(ConnectionError, match="nobody"):
        endless_gym.connect("nobody", timeout=0)
    with pytest.raises(ValueError, match="letters"):
        endless_gym.connect("a/b", timeout=0)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("name", ["num_envs", "num_threads", "groups", "seed"])
def test_numbers_are_integers_in_their_range(where, name: str) -> None:
    for given in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"^{name} must be [01] to \d+, got {given}$"):
            where(ID, **{name: given})
    with pytest.raises(TypeError, match=rf"^{name} must be an integer, got 1.5$"):
        where(ID, **{name: 1.5})


@pytest.mark.parametrize("where", WHERE)
def test_seeds_out_of_range_are_refused(where) -> None:
    for seeds in ([-1], [2**64], range(-1, 3), range(0, 2**64 + 1)):
        with pytest.raises(ValueError, match=r"seeds must be 0 to \d+, got "):
            where(ID, seeds=seeds)
    for seeds in ([], range(3, 3), range(0, 9, -1)):
        with pytest.raises(ValueError, match=r"^seeds must have at least one seed, got "):
            where(ID, seeds=seeds)
    with pytest.raises(TypeError, match="seeds must be an integer, got 'a'"):
        where(ID, seeds=["a"])
    for stack in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"^stack must be 0 to \d+, got {stack}$"):
            where(ID, frames=endless_gym.Frames(stack=stack))


def test_single_environment_checks_seeds_actions_and_snapshots() -> None:
    env = endless_gym.Env(ID)
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"^seed must be 0 to \d+, got {seed}$"):
            env.reset(seed=seed)
    env.reset(seed=2**64 - 1)
    for action in ([0, 3], [-1, 0], [2**40, 0], [2**63 - 1, 0], [-(2**63), 0], [], [[]], [0], [0, 0, 0], [[0, 0, 0]]):
        with pytest.raises(ValueError, match=r"action|\[3, 3\]"):
            env.step(action)
    for action in (None, "ab", [None, 0], [2**64, 0.5], object()):
        with pytest.raises(TypeError, match="actions must be integers"):
            env.step(action)
    for snapshot in (b"", b"\0" * 100, b"\xff" * 100_000):
        with pytest.raises(ValueError, match="snapshot"):
            env.restore(snapshot)


GRID = "MortarMayhem-Grid-v0"


class Refusing:
    """An object that does not become an array, as a tensor on a GPU or one with gradients."""

    def __init__(self, reason: BaseException) -> None:
        self.reason = reason

    def __array__(self, *arguments: object, **more: object) -> np.ndarray:
        raise self.reason


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize(
    ("id", "shape", "meaning"),
    [(ID, (3, 2), "an integer for each branch of each environment"), (GRID, (3,), "an integer for each environment")],
)
def test_actions_have_the_shape_of_the_action_space(where, id: str, shape: tuple[int, ...], meaning: str) -> None:
    right = np.arange(np.prod(shape), dtype=np.int64).reshape(shape) % 3
    transposed = np.ascontiguousarray(right.T) if right.ndim == 2 else right[:, None]
    with where(id, 3, seed=1) as envs, endless_gym.make_vec(id, 3, seed=1) as twin:
        envs.reset()
        twin.reset()
        assert envs.action_space.shape == shape
        wrong = [transposed, right.ravel()[:-1], right[None], right.tolist()[:-1], np.zeros((0,), np.int64), 1, []]
        wrong += [right.ravel(), right.reshape(2, 3)] if right.ndim == 2 else [right[:, None].tolist(), right[None, :]]
        for actions in wrong:
            for call in (envs.step, envs.send):
                given = f"actions must have the shape {shape}, {meaning}, got the shape {np.shape(actions)}"
                with pytest.raises(ValueError, match=f"^{re.escape(given)}$"):
                    call(actions)
        ragged = [[0, 0], [0], [0, 0]]
        with pytest.raises(ValueError, match="got a list of items with different shapes") as shapes:
            envs.step(ragged)
        assert "inhomogeneous" in str(shapes.value.__cause__)
        for reason in (TypeError("can't convert cuda:0"), RuntimeError("requires grad"), NotImplementedError("meta")):
            for actions in (Refusing(reason), [Refusing(reason)] * 3):
                with pytest.raises(TypeError, match=rf"{reason}; pass `actions\.detach\(\)\.cpu\(\)`") as raised:
                    envs.step(actions)
                assert raised.value.__cause__ is reason
        with pytest.raises(KeyboardInterrupt):
            envs.step(Refusing(KeyboardInterrupt()))
        flat = bytes(right.ravel().tolist())
        for actions in (flat, bytearray(flat), right * 0.5, right.astype(bool), right.astype(str), None):
            with pytest.raises(TypeError, match=r"^actions must be integers, got "):
                envs.step(actions)
        # All valid actions are played, and none of the invalid ones were.
        layouts = [right, right.tolist(), np.asfortranarray(right), np.repeat(right, 2, 0)[::2]]
        for actions in layouts + [
            right.astype(dtype) for dtype in ("int8", "uint8", "int16", "int32", "uint64", ">i4")
        ]:
            same(envs.step(actions)[:4], twin.step(right)[:4])


def test_one_action_has_the_shape_of_the_action_space() -> None:
    env, grid = endless_gym.Env(ID), endless_gym.Env(GRID)
    env.reset(seed=1)
    grid.reset(seed=1)
    for action in (0, np.int8(1), np.array(1)):
        grid.step(action)
    for action in ([0, 1], (0, 1), np.array([0, 1], np.uint8)):
        env.step(action)
    for wrong, one in ((grid, [0]), (grid, np.array([0])), (env, 0), (env, [[0, 0]]), (env, np.zeros((2, 1), int))):
        with pytest.raises(ValueError, match=r"^actions must have the shape \("):
            wrong.step(one)
    for wrong, one in ((grid, b"0"), (grid, 0.0), (env, b"ab"), (env, bytearray(2))):
        with pytest.raises(TypeError, match=r"^actions must be integers"):
            wrong.step(one)


@pytest.mark.parametrize("where", WHERE)
def test_arguments_of_other_types_are_refused(where) -> None:
    for arguments, match in (
        ({"id": 3}, "^id must be a string, got 3$"),
        ({"options": 5}, "^options must be a mapping, or a sequence of mappings, got 5$"),
        ({"options": "arena_size=2"}, "^options must be a mapping, or a sequence of mappings, got 'arena_size=2'$"),
        ({"options": [5]}, "^options must be a mapping, got 5$"),
        ({"frames": "grey"}, "^frames must be endless_gym.Frames or None, got 'grey'$"),
    ):
        with pytest.raises(TypeError, match=match):
            where(**({"id": ID} | arguments))
    for name in ("autoreset", "observation"):
        with pytest.raises(ValueError, match=rf"^{name} must be one of .*, got \["):
            where(ID, **{name: []})
    for make in (lambda: endless_gym.Env(ID, options=5), lambda: endless_gym.Env(ID).reset(options=5)):
        with pytest.raises(TypeError, match=r"^options must be a mapping, got 5$"):
            make()


def test_batches_held_are_checked() -> None:
    for given in (0, 17):
        with pytest.raises(ValueError, match=f"^batches_held must be 1 to 16, got {given}$"):
            endless_gym.serve(ID, batches_held=given)


def test_view_of_an_unknown_environment_is_refused() -> None:
    with endless_gym.make_vec(ID, 2) as envs:
        envs.reset()
        for env in (-1, 2, 2**64):
            with pytest.raises(ValueError, match=f"^env must be 0 to 1, got {env}$"):
                envs.ground_truth_view(env)


def test_the_native_module_checks_shapes() -> None:
    flags, numbers, lengths = np.ones(3, np.bool_), np.zeros(3), np.zeros(3, np.int32)
    infos = np.zeros((3, 2))
    for arguments in (
        (flags, numbers[1:], lengths, infos, [True, False]),
        (flags, numbers, lengths[1:], infos, [True, False]),
        (flags, numbers, lengths, infos[1:], [True, False]),
        (flags, numbers, lengths, infos, [True]),
    ):
        with pytest.raises(ValueError, match="same number of"):
            _native.ended_episodes(*arguments)


def test_any_nonzero_byte_of_a_flag_is_true() -> None:
    raw = np.array([0, 1, 2, 255, 0, 128], np.uint8)
    infos = np.arange(12.0).reshape(6, 2)
    ends = _native.ended_episodes(
        raw.view(np.bool_), np.arange(6.0), np.arange(6, dtype=np.int32), infos, [True, False]
    )
    ended, returns, lengths, (first, second) = ends
    np.testing.assert_array_equal(ended.view(np.uint8), [0, 1, 1, 1, 0, 1])
    np.testing.assert_array_equal(returns, [0, 1, 2, 3, 0, 5])
    np.testing.assert_array_equal(lengths, [0, 1, 2, 3, 0, 5])
    np.testing.assert_array_equal(first, [0, 2, 4, 6, 0, 10])
    np.testing.assert_array_equal(second, [0, 3, 5, 7, 0, 11])
    assert (
        _native.ended_episodes(raw[:1].view(np.bool_), np.ones(1), np.ones(1, np.int32), infos[:1], [True] * 2) is None
    )
    # A part of another array, with strides.
    parts = raw[::2].view(np.bool_), np.arange(6.0)[::2], np.arange(6, dtype=np.int32)[::2], infos[::2]
    np.testing.assert_array_equal(_native.ended_episodes(*parts, [True, False])[1], [0, 2, 0])


@pytest.mark.parametrize("where", WHERE)
def test_unknown_arguments_are_refused_with_the_name_that_is_meant(where) -> None:
    for name, value, hint in (
        ("autoreset_mode", "same_step", "the auto-reset mode is `autoreset`"),
        ("max_episode_steps", 10, "the reset parameter `max_steps` limits the steps of an episode"),
        ("num_env", 3, "did you mean `num_envs`?"),
        ("zzz", 3, "it has id, num_envs, num_threads, "),
    ):
        message = f"{where.__name__}() has no argument `{name}`; {hint}"
        with pytest.raises(TypeError, match=f"^{re.escape(message)}"):
            where("MortarMayhem-Grid-v0", **{name: value})


def test_an_engine_of_python_names_itself() -> None:
    for name in ("name", "service"):
        with pytest.raises(TypeError, match=rf"^serve\(\) has no argument `{name}`; the engine names itself"):
            endless_gym.serve("MortarMayhem-Grid-v0", **{name: "mine"})


@pytest.mark.parametrize("where", WHERE)
def test_seeds_that_do_not_fit_are_refused(where) -> None:
    largest = 2**64 - 1
    with where("MortarMayhem-Grid-v0", 2, groups=2) as envs:
        message = f"seed must be 0 to {largest - 3}, got {largest - 2}"
        with pytest.raises(ValueError, match=message):
            envs.reset(seed=largest - 2)
        with pytest.raises(ValueError, match=message):
            envs.reset(seed=largest - 2, options={"reset_mask": np.array([True, False])})
        with pytest.raises(ValueError, match=message):
            envs.send_reset(1, seed=largest - 2)
        with pytest.raises(ValueError, match=message):
            where("MortarMayhem-Grid-v0", 2, groups=2, seed=largest - 2)
        envs.reset(seed=largest - 3)
        assert [episode.seed for episode in envs.running_episodes(1)] == [largest - 1, largest]
        envs.reset(seed=[largest, 0])


def test_arguments_of_the_wrong_kind_are_named() -> None:
    with pytest.raises(TypeError, match=r"^seeds must be a range or a list of integers, one for each episode, got 7$"):
        endless_gym.make_vec("MortarMayhem-Grid-v0", seeds=7)  # type: ignore[arg-type]
    with endless_gym.make_vec("MortarMayhem-Grid-v0", 2, seed=1) as envs:
        envs.reset()
        with pytest.raises(TypeError, match=r"snapshots must be a mapping .* got bytes; pass {env: snapshot}"):
            envs.restore(envs.snapshot(0))  # type: ignore[arg-type]


def test_vector_environments_know_their_id_and_step_limits() -> None:
    options = [{"max_steps": 20}, {}]
    for where in (endless_gym.make_vec, endless_gym.serve):
        with where("Endless-MysteryPath-v0", 2, options=options) as envs:
            assert envs.spec is not None and envs.spec.id == "EndlessGym/Endless-MysteryPath-v0"
            assert repr(envs) == "EndlessVectorEnv(EndlessGym/Endless-MysteryPath-v0, num_envs=2)"
            envs.reset()
            assert envs.max_episode_steps == [20, -1]
