"""`send`, `recv` and the calls that are refused between them behave the same in this process and in an engine process."""

import contextlib
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from support import WHERE, same

import endless_gym

ID = "MortarMayhem-v0"
GROUPS = 2
NUM_ENVS = 3
ACTIONS = np.ones((NUM_ENVS, 2), np.int64)


@contextlib.contextmanager
def both() -> Iterator[list[endless_gym.EndlessVectorEnv]]:
    """The same environments in this process and in an engine process."""
    with (
        endless_gym.make_vec(ID, NUM_ENVS, groups=GROUPS, seed=4) as inside,
        endless_gym.serve(ID, NUM_ENVS, groups=GROUPS, seed=4) as outside,
    ):
        yield [inside, outside]


def outcome(call: Callable[..., object], *arguments: object) -> object:
    """The result of a call, or the type and message of its exception."""
    try:
        returned = call(*arguments)
    except Exception as error:
        return type(error), str(error)
    return (
        [part.tolist() for part in returned[:4] if isinstance(part, np.ndarray)]
        if isinstance(returned, tuple)
        else None
    )


@pytest.mark.parametrize("where", WHERE)
def test_actions_are_copied(where) -> None:
    with (
        where(ID, NUM_ENVS, groups=GROUPS, seed=4) as envs,
        endless_gym.make_vec(ID, NUM_ENVS, groups=GROUPS, seed=4) as twin,
    ):
        envs.reset()
        twin.reset()
        buffer = np.zeros((NUM_ENVS, 2), np.int64)
        for step in range(40):
            for group in range(GROUPS):
                buffer[:] = (step + group) % 3
                envs.send(buffer, group)
            buffer[:] = -1
            for group in range(GROUPS):
                twin.send(np.full((NUM_ENVS, 2), (step + group) % 3), group)
                same(envs.recv(group)[:4], twin.recv(group)[:4])


def test_a_pending_answer_is_an_error_in_every_call() -> None:
    calls: dict[str, Callable[[endless_gym.EndlessVectorEnv, bytes], object]] = {
        "send": lambda envs, _: envs.send(ACTIONS),
        "send too few": lambda envs, _: envs.send(ACTIONS[1:]),
        "send out of range": lambda envs, _: envs.send(ACTIONS * 7),
        "send floats": lambda envs, _: envs.send(ACTIONS * 0.5),
        "step": lambda envs, _: envs.step(ACTIONS),
        "step too few": lambda envs, _: envs.step(ACTIONS[1:]),
        "step out of range": lambda envs, _: envs.step(ACTIONS * 7),
        "reset": lambda envs, _: envs.reset(),
        "reset a group": lambda envs, _: envs.reset(group=0),
        "reset by mask": lambda envs, _: envs.reset(options={"reset_mask": [True] * NUM_ENVS}, group=0),
        "send_reset": lambda envs, _: envs.send_reset(0),
        "snapshot": lambda envs, _: envs.snapshot(0),
        "restore": lambda envs, snapshot: envs.restore({0: snapshot}),
        "restore none": lambda envs, _: envs.restore({}),
    }
    sends: list[Callable[[endless_gym.EndlessVectorEnv], object]] = [
        lambda envs: envs.send(ACTIONS),
        lambda envs: envs.send_reset(0, seed=3),
    ]
    with both() as places:
        snapshots = []
        for envs in places:
            envs.reset(seed=1)
            snapshots.append(envs.snapshot(0))
        for send in sends:
            for envs in places:
                send(envs)
            for name, call in calls.items():
                inside, outside = (outcome(call, *pair) for pair in zip(places, snapshots, strict=True))
                assert inside == outside, name
                if " " not in name or name.startswith(("reset", "restore")):
                    assert inside[0] is RuntimeError, name
                    assert inside[1] == ("group 0 has a pending answer; call `recv` before the next request"), name
            # No refused call has replaced the pending message, and the other group still answers.
            for envs in places:
                envs.send(ACTIONS, 1)
            inside, outside = (outcome(envs.recv, 0) for envs in places)
            assert inside == outside
            assert outcome(places[0].recv) == outcome(places[1].recv)


def test_mistakes_have_the_same_messages() -> None:
    calls: dict[str, Callable[[endless_gym.EndlessVectorEnv], object]] = {
        "recv": lambda envs: envs.recv(),
        "recv of a group": lambda envs: envs.recv(1),
        "recv of no group": lambda envs: envs.recv(2),
        "recv of a negative group": lambda envs: envs.recv(-1),
        "send to no group": lambda envs: envs.send(ACTIONS, 2),
        "send to a negative group": lambda envs: envs.send(ACTIONS, -1),
        "send to a name": lambda envs: envs.send(ACTIONS, "0"),
        "send_reset of no group": lambda envs: envs.send_reset(2),
        "reset of no group": lambda envs: envs.reset(group=2),
        "snapshot of no group": lambda envs: envs.snapshot(0, 2),
        "restore in no group": lambda envs: envs.restore({}, 2),
        "step": lambda envs: envs.step(ACTIONS),
        "step out of range": lambda envs: envs.step(ACTIONS * 7),
        "send out of range": lambda envs: envs.send(ACTIONS * 7),
        "send before a reset": lambda envs: envs.send(ACTIONS),
        "recv before a reset": lambda envs: envs.recv(),
        "recv again": lambda envs: envs.recv(),
        "snapshot before a reset": lambda envs: envs.snapshot(0),
        "mask before a reset": lambda envs: envs.reset(options={"reset_mask": [False] * NUM_ENVS}, group=0),
        "restore before a reset": lambda envs: envs.restore({}),
        "unknown option": lambda envs: envs.reset(options={"arena_sise": 1}),
        "option out of range": lambda envs: envs.reset(options={"arena_size": 99}),
        "reset": lambda envs: envs.reset(seed=2**63),
        "no snapshot": lambda envs: envs.restore({0: b"whatever"}),
        "snapshot of no environment": lambda envs: envs.snapshot(3),
        "restore of no environment": lambda envs: envs.restore({-1: b""}),
    }
    with both() as places:
        for name, call in calls.items():
            inside, outside = (outcome(call, envs) for envs in places)
            assert inside == outside, name
            assert (inside is None or isinstance(inside, list)) == (name in ("reset", "send before a reset")), name
    for envs in places:
        assert outcome(envs.recv) == (RuntimeError, "the environments are closed")
