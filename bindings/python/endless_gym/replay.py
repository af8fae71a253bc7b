"""Replays of episodes from their seeds, options and actions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from endless_gym.env import Env, Observation


class ReplayStep(NamedTuple):
    """One step of a replayed episode; the first item is the reset."""

    #: The observation: uint8 (84, 84, 3), or a dict for the ids with a vector observation.
    observation: Observation
    #: The reward; 0 for the reset.
    reward: float
    terminated: bool
    truncated: bool
    #: `ground_truth` if the original has it, and the final infos in the last step.
    info: dict[str, Any]
    #: What `render` returns in the given mode, uint8, indexed `[row][column][channel]`; `None` without a mode.
    frame: NDArray[np.uint8] | None


def replay(
    id: str,
    seed: int | bytes,
    options: Mapping[str, Any] | None,
    actions: Iterable[Any],
    *,
    render_mode: str | None = None,
) -> Iterator[ReplayStep]:
    """Play an episode again, exactly.

    Examples:
        >>> import endless_gym
        >>> actions = [[0, 0]] * 22
        >>> steps = list(endless_gym.replay("MortarMayhem-v0", seed=7, options={"command_count": [1]}, actions=actions))
        >>> len(steps), steps[-1].terminated, steps[-1].info["length"]
        (23, True, 22)

    Args:
        id: Environment id.
        seed: The seed with which the episode started. Or a snapshot, taken at the start of the episode or later, from which the
            replay continues. An episode that continues the generator of the previous one has no seed, so it needs a snapshot.
        options: The reset parameters of the episode; `None` for the defaults, and with a snapshot, which contains its own.
        actions: The actions in the order of the steps, each an element of the action space, up to the end of the episode.
        render_mode: As for `endless_gym.Env`; its pictures are `ReplayStep.frame`.

    Returns:
        An iterator that plays each step on request: the reset, then one item for each action.

    Raises:
        TypeError: The seed is neither an integer nor a snapshot.
        ValueError: The id, an option, an action, the snapshot or the render mode is not valid, options are given with a snapshot,
            or there are actions after the end of the episode.
    """
    is_snapshot = isinstance(seed, (bytes, bytearray))
    if is_snapshot and options:
        raise ValueError(f"options must be None with a snapshot, which contains its own, got {dict(options)}")
    env = Env(id, render_mode, dict(options or {}))
    observation, info = env.reset(seed=None if is_snapshot else seed)  # type: ignore[arg-type]
    if is_snapshot:
        observation, info = env.restore(bytes(seed))  # type: ignore[arg-type]
    return _steps(env, ReplayStep(observation, 0.0, False, False, info, None), actions)


def _steps(env: Env, start: ReplayStep, actions: Iterable[Any]) -> Iterator[ReplayStep]:
    try:
        yield start._replace(frame=env.render())
        has_ended = False
        for number, action in enumerate(actions):
            if has_ended:
                raise ValueError(
                    f"actions must not go beyond the end of the episode, which ended after {number} actions"
                )
            step = ReplayStep(*env.step(action), frame=env.render())
            has_ended = step.terminated or step.truncated
            yield step
    finally:
        env.close()
