"""Compares our wrappers of POPGym with those of the package `popgym`, over our environments. Runs in the original's Python."""

from __future__ import annotations

from typing import Any

import popgym.wrappers
from original_states import checksum

import endless_gym
import endless_gym.popgym


def same(one: Any, other: Any) -> bool:
    """Whether two observations have the same types and numbers."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    return checksum(one) == checksum(other)


def chains(of: Any, id: str) -> list[Any]:
    """Functions that wrap an environment in wrappers of this module."""
    found: list[Any] = [
        lambda env: of.Antialias(of.PreviousAction(env)),
        lambda env: of.Flatten(of.Antialias(of.PreviousAction(env))),
        lambda env: of.Flatten(of.Antialias(env)),
        lambda env: of.Flatten(env),
        *[lambda env, level=level: of.Markovian(env, level) for level in range(4)],
    ]
    if "Pendulum" not in id:
        found.append(of.DiscreteAction)
    return found


def compare(env: Any, wanted: Any) -> None:
    """Plays both, and asserts that they return the same."""
    assert (env.observation_space, env.action_space) == (wanted.observation_space, wanted.action_space)
    (given, info), (expected, expected_info) = env.reset(seed=3), wanted.reset(seed=3)
    env.action_space.seed(1)
    for _ in range(20):
        assert same(given, expected) and info.keys() == expected_info.keys()
        assert "state" not in info or same(info["state"], expected_info["state"])
        action = env.action_space.sample()
        given, _, terminated, truncated, info = env.step(action)
        expected, _, _, _, expected_info = wanted.step(action)
        if terminated or truncated:
            break


for id in endless_gym.all_specs():
    if id.startswith("popgym-") and "Easy" in id:
        pairs = zip(chains(endless_gym.popgym, id), chains(popgym.wrappers, id), strict=True)
        for number, (ours, theirs) in enumerate(pairs):
            try:
                compare(ours(endless_gym.Env(id)), theirs(endless_gym.Env(id)))
            except Exception as error:
                raise AssertionError(f"{id}, chain {number}") from error
