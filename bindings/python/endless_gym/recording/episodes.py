"""Plays episodes, many at a time, each with its own seed and reset parameters."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym.create import make_vec
from endless_gym.recording.chunks import Chunks, GrowingArrays
from endless_gym.recording.players import Errors, Player
from endless_gym.specs import OBSERVATIONS, Frames, ObservationName, Spec


@dataclass(frozen=True)
class Plan:
    """What determines an episode, besides the policy.

    Attributes:
        number: Number of the episode in the data set.
        seed: Seed of the environment.
        options: Reset parameters.
        error_rate: Probability that a step takes a random action.
        max_steps: Steps after which the episode is truncated; `None` to play until it terminates.
    """

    number: int
    seed: int
    options: Mapping[str, Any]
    error_rate: float
    max_steps: int | None


@dataclass(frozen=True)
class Episode:
    """A played episode of T steps.

    Attributes:
        plan: The plan that was played.
        observations: T + 1 observations by their paths in the data set's file, such as `observations/_index_0`.
        arrays: `actions` int64, or float32 of a Box, `rewards` float64, `terminations` and `truncations` bool, with T rows.
        ground_truth: T + 1 rows of `info["ground_truth"]`, float64; `None` if the environment has none.
        length: T.
        total: The return.
        final: The other final infos; empty if the episode was truncated.
    """

    plan: Plan
    observations: dict[str, Chunks]
    arrays: dict[str, Chunks]
    ground_truth: Chunks | None
    length: int
    total: float
    final: dict[str, float | int]


class Stopped(Exception):
    """The recording was stopped."""


def play(
    spec: Spec,
    player: Player,
    plans: Sequence[Plan],
    *,
    observation: ObservationName,
    frames: Frames | None,
    action_seed: int,
    stop: threading.Event,
) -> list[Episode]:
    """Play these episodes, whose numbers are consecutive, at the same time. They do not depend on each other.

    Args:
        spec: The environment.
        player: The policy.
        plans: The episodes.
        observation: What is recorded: `rgb`, `features` or `rgb+features`.
        frames: Format of the frames, as for `make_vec`.
        action_seed: Seed of the random actions; each episode has its own stream.
        stop: Stops playing when set.

    Raises:
        Stopped: `stop` is set.
        ValueError: A reset parameter is unknown or out of its range.
    """
    num_envs = len(plans)
    rates = np.array([plan.error_rate for plan in plans])
    errors = Errors(spec, action_seed, range(plans[0].number, plans[0].number + num_envs), rates)
    actor = player.actor(num_envs, plans[0].number)
    shown = _union(observation, player.observation)
    # New environments for every episode, since some show traces of the previous episode, as in the original.
    with make_vec(
        spec.id,
        num_envs,
        1,
        seeds=[plan.seed for plan in plans],
        options=[plan.options for plan in plans],
        autoreset="disabled",
        observation=shown,
        frames=frames if OBSERVATIONS[shown][0] else None,
    ) as envs:
        observed, info = envs.reset()
        kinds = zip(("visual_observation", "features"), OBSERVATIONS[observation], strict=True)
        keys = [key for key, is_recorded in kinds if is_recorded]
        keys += ["vector_observation"] if spec.vector_observation else []
        single = "visual_observation" if shown == "rgb" else "features"

        def parts(given: Any) -> Mapping[str, NDArray[Any]]:
            return given if isinstance(given, Mapping) else {single: given}

        def recorded() -> Iterator[tuple[str, NDArray[Any]]]:
            return _leaves("observations", {key: now[key] for key in keys} if len(keys) > 1 else now[keys[0]])

        now = parts(observed)
        growing = {path: GrowingArrays(num_envs, part.shape[1:], part.dtype) for path, part in recorded()}
        active = np.ones(num_envs, dtype=np.bool_)
        start = np.ones(num_envs, dtype=np.bool_)
        limits = np.array([np.inf if plan.max_steps is None else plan.max_steps for plan in plans])
        truths, rewards = [_copied(info)], []
        actions: list[NDArray[Any]] = []
        episodes: list[Episode | None] = [None] * num_envs
        for path, part in recorded():
            growing[path].append(part, active)
        while active.any():
            if stop.is_set():
                raise Stopped
            # Errors replace actions of the player.
            previous = {"previous_action": actions[-1]} if actions else {}
            action = errors.apply(actor({**now, **previous}, start, active))
            observed, reward, terminated, truncated, info = envs.step(action)
            now = parts(observed)
            for path, part in recorded():
                growing[path].append(part, active)
            truths.append(_copied(info))
            actions.append(action)
            rewards.append(reward.copy())
            cut = (len(rewards) >= limits) & ~terminated
            for env in np.flatnonzero(active & (terminated | truncated | cut)).tolist():
                flags = bool(terminated[env]), bool(truncated[env] or cut[env])
                episodes[env] = _episode(spec, plans[env], env, growing, actions, rewards, truths, flags, info)
                active[env] = False
            start[:] = False
    return [episode for episode in episodes if episode is not None]


def _leaves(path: str, observation: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """The arrays of an observation by their paths in Minari's files."""
    if isinstance(observation, tuple):
        observation = {f"_index_{index}": part for index, part in enumerate(observation)}
    if not isinstance(observation, Mapping):
        yield path, observation
        return
    for name, part in observation.items():
        yield from _leaves(f"{path}/{name}", part)


def _copied(info: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """A copy of the ground truth. A view would keep the memory of its whole batch alive."""
    return info["ground_truth"].copy() if "ground_truth" in info else None


def _union(recorded: ObservationName, needed: ObservationName | None) -> ObservationName:
    """The kind of observation that contains both what is recorded and what the player needs."""
    contents = np.array(OBSERVATIONS[recorded]) | np.array(OBSERVATIONS[needed] if needed else (False, False))
    return next(name for name, given in OBSERVATIONS.items() if given == tuple(contents))


def _episode(
    spec: Spec,
    plan: Plan,
    env: int,
    growing: Mapping[str, GrowingArrays],
    actions: Sequence[NDArray[np.int64]],
    rewards: Sequence[NDArray[np.float64]],
    truths: Sequence[NDArray[np.float64] | None],
    flags: tuple[bool, bool],
    info: Mapping[str, Any],
) -> Episode:
    length = len(rewards)
    terminations, truncations = np.zeros((2, length), dtype=np.bool_)
    terminations[-1], truncations[-1] = flags
    earned = np.array([reward[env] for reward in rewards])
    truth = None if truths[0] is None else np.array([row[env] for row in truths if row is not None])
    final = {}
    if flags[0]:
        final = {name: (int if integer else float)(info[name][env]) for name, integer in spec.info}
    return Episode(
        plan=plan,
        observations={key: arrays.finish(env) for key, arrays in growing.items()},
        arrays={
            "actions": Chunks.of(np.array([action[env] for action in actions])),
            "rewards": Chunks.of(earned),
            "terminations": Chunks.of(terminations),
            "truncations": Chunks.of(truncations),
        },
        ground_truth=None if truth is None else Chunks.of(truth),
        length=length,
        # In the order of the steps, as the engine sums it.
        total=float(sum(earned.tolist())),
        final=final,
    )
