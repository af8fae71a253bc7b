"""The policies that choose the actions of recorded episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from endless_gym.experts import Experts
from endless_gym.specs import ObservationName, Spec

#: Chooses actions. The arguments are the observations of n environments by key, after the first step with the actions that were
#: played as `previous_action`; whether each is the first of an episode, bool (n,); and whether each environment needs an action,
#: bool (n,). Returns actions in the shape of a vector environment.
Actor: TypeAlias = Callable[[Mapping[str, Any], NDArray[np.bool_], NDArray[np.bool_]], NDArray[Any]]


class Player(Protocol):
    """A policy that can play many episodes at a time."""

    @property
    def name(self) -> str:
        """The name of the algorithm in the data set."""

    @property
    def observation(self) -> ObservationName | None:
        """The observation that it needs, `rgb`, `features` or `rgb+features`; `None` if it needs none."""

    def actor(self, num_envs: int, first_episode: int) -> Actor:
        """The policy of `num_envs` environments, which play consecutive episodes from number `first_episode` on."""


class ExpertPlayer:
    """The scripted experts."""

    name = "scripted expert"
    observation: ObservationName | None = "features"

    def __init__(self, spec: Spec) -> None:
        """Make the player for that environment id."""
        self._spec = spec

    def actor(self, num_envs: int, first_episode: int) -> Actor:
        del first_episode
        return Experts(self._spec.id, num_envs).act


class RandomPlayer:
    """No policy: each step takes a random action, as with an error rate of 1."""

    name = "random play"
    observation: ObservationName | None = None

    def __init__(self, spec: Spec) -> None:
        """Make the player for that environment id."""
        self._spec = spec

    def actor(self, num_envs: int, first_episode: int) -> Actor:
        del first_episode
        # An error replaces every one of these.
        nothing = self._spec.batched_actions(self._spec.random_actions(np.random.default_rng(0), num_envs))
        return lambda observation, episode_start, active: nothing


class Errors:
    """Random actions that replace some of a policy's, with a generator for each episode."""

    #: Steps whose random numbers are drawn together.
    STEPS = 256

    def __init__(self, spec: Spec, seed: int, episodes: range, rates: NDArray[np.float64]) -> None:
        """Errors of the episodes with these numbers, at these rates; both of the same length."""
        self._spec = spec
        sequences = (np.random.SeedSequence(seed, spawn_key=(episode,)) for episode in episodes)
        self._generators = [np.random.default_rng(sequence) for sequence in sequences]
        self._rates = rates
        self._step = 0
        self._wrong = np.zeros((len(episodes), self.STEPS), dtype=np.bool_)
        self._actions = np.empty(0, dtype=np.int64)

    def apply(self, actions: NDArray[Any]) -> NDArray[Any]:
        """The actions of the next step, in the shape of a vector environment."""
        if not self._rates.any():
            return actions
        place = self._step % self.STEPS
        if place == 0:
            for env, generator in enumerate(self._generators):
                self._wrong[env] = generator.random(self.STEPS) < self._rates[env]
            drawn = [self._spec.random_actions(generator, self.STEPS) for generator in self._generators]
            self._actions = np.stack(drawn)
        self._step += 1
        wrong = self._wrong[:, place]
        replaced = self._spec.batched_actions(self._actions[:, place])
        return np.where(wrong if actions.ndim == 1 else wrong[:, None], replaced, actions)
