"""Arguments that cannot be: exceptions that name the argument, what was given and what is allowed, and never a panic."""

import numpy as np
import pytest

import endless_gym
from endless_gym import _native

ID = "MortarMayhem-v0"
WHERE = [endless_gym.make_vec, endless_gym.serve]


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
        if not isinstance(given, int):
            for call in (
                lambda connection: connection.receive(0, given),
                lambda connection: connection.snapshot(0, 0, given),
                lambda connection: connection.restore(0, 0, b"", given),
                lambda connection: connection.reconnect(given),
            ):
                with pytest.raises(ValueError, match=match):
                    call(envs._backend._connection)


def test_a_timeout_may_be_long() -> None:
    with endless_gym.serve(ID, timeout=1e300) as envs:
        envs.reset()
        envs.step([[0, 0]])
        envs.reconnect(timeout=1e300)
        envs.reset()
    with pytest.raises(TypeError, match="timeout must be a number of seconds, got 'soon'"):
        endless_gym.connect("nobody", timeout="soon")


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("given", [-1, 2**64])
@pytest.mark.parametrize("name", ["num_envs", "num_threads", "groups", "seed"])
def test_integers_out_of_range(where, name: str, given: int) -> None:
    with pytest.raises(ValueError, match=rf"^{name} must be [01] to \d+, got {given}$"):
        where(ID, **{name: given})


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("name", ["num_envs", "num_threads", "groups", "seed"])
def test_numbers_that_are_no_integers(where, name: str) -> None:
    with pytest.raises(TypeError, match=rf"^{name} must be an integer, got 1.5$"):
        where(ID, **{name: 1.5})


@pytest.mark.parametrize("where", WHERE)
def test_seeds_out_of_range(where) -> None:
    for seeds in ([-1], [2**64], range(-1, 3), range(0, 2**64 + 1)):
        with pytest.raises(ValueError, match=r"seeds must be 0 to \d+, got "):
            where(ID, seeds=seeds)
    with pytest.raises(ValueError, match=r"^seeds must be a range with step 1, got range\(0, 9, 2\)$"):
        where(ID, seeds=range(0, 9, 2))
    with pytest.raises(TypeError, match="seeds must be an integer, got 'a'"):
        where(ID, seeds=["a"])
    for stack in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"^stack must be 0 to \d+, got {stack}$"):
            where(ID, frames=endless_gym.Frames(stack=stack))


@pytest.mark.parametrize("where", WHERE)
def test_counts_whose_product_overflows(where) -> None:
    with pytest.raises(ValueError, match=rf"^num_envs must be 1 to \d+, got {2**63}$"):
        where(ID, 2**63, groups=4)
    with pytest.raises(ValueError, match=r"^groups must be 1 to 64, got 65$"):
        where(ID, 1, groups=65)


def test_one_environment() -> None:
    env = endless_gym.Env(ID)
    for seed in (-1, 2**64):
        with pytest.raises(ValueError, match=rf"^seed must be 0 to \d+, got {seed}$"):
            env.reset(seed=seed)
    env.reset(seed=2**64 - 1)
    for action in ([2**63 - 1, 0], [-(2**63), 0], [], [[0, 0, 0]]):
        with pytest.raises(ValueError, match="action"):
            env.step(action)
    for action in (None, "ab", [[]], [None, 0], [2**64, 0.5], object()):
        with pytest.raises(TypeError, match="actions must be integers"):
            env.step(action)
    for snapshot in (b"", b"\0" * 100, b"\xff" * 100_000):
        with pytest.raises(ValueError, match="snapshot"):
            env.restore(snapshot)


def test_a_view_of_no_environment() -> None:
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
            _native.ended_episodes(*arguments, 0.0)


def test_flags_may_be_any_byte() -> None:
    raw = np.array([0, 1, 2, 255, 0, 128], np.uint8)
    infos = np.arange(12.0).reshape(6, 2)
    ends = _native.ended_episodes(
        raw.view(np.bool_), np.arange(6.0), np.arange(6, dtype=np.int32), infos, [True, False], 7.0
    )
    ended, returns, lengths, times, (first, second) = ends
    np.testing.assert_array_equal(ended.view(np.uint8), [0, 1, 1, 1, 0, 1])
    np.testing.assert_array_equal(returns, [0, 1, 2, 3, 0, 5])
    np.testing.assert_array_equal(lengths, [0, 1, 2, 3, 0, 5])
    np.testing.assert_array_equal(times, [0, 7, 7, 7, 0, 7])
    np.testing.assert_array_equal(first, [0, 2, 4, 6, 0, 10])
    np.testing.assert_array_equal(second, [0, 3, 5, 7, 0, 11])
    assert (
        _native.ended_episodes(raw[:1].view(np.bool_), np.ones(1), np.ones(1, np.int32), infos[:1], [True] * 2, 0)
        is None
    )
    # A part of another array, with strides.
    parts = raw[::2].view(np.bool_), np.arange(6.0)[::2], np.arange(6, dtype=np.int32)[::2], infos[::2]
    np.testing.assert_array_equal(_native.ended_episodes(*parts, [True, False], 7.0)[1], [0, 2, 0])
