"""Environments of POPGym as those of the package `popgym`, whose wrappers require its class; needs that package."""

from __future__ import annotations

from typing import Any

import gymnasium
from popgym.core.env import POPGymEnv

from endless_gym.env import Env

#: Families in which, as POPGym says, the best policy needs the previous action.
_NEEDS_ACTION = ("MultiarmedBandit", "Battleship", "Concentration", "MineSweeper", "Labyrinth")


class PopgymEnv(Env, POPGymEnv):
    """An `Env` that is a `popgym.core.env.POPGymEnv`. The hidden Markov state is not available."""

    @property
    def obs_requires_prev_action(self) -> bool:
        """Whether the best policy needs the previous action."""
        return any(family in self._spec.id for family in _NEEDS_ACTION)

    @property
    def state_space(self) -> gymnasium.Space[Any]:
        """Not available."""
        raise NotImplementedError(
            f"{self._spec.id} has no hidden state here; the environment of the package popgym has it"
        )

    def get_state(self) -> Any:
        """Not available."""
        return self.state_space
