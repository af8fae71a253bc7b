"""POPGym's observations as vectors for the agents, which `endless-train` uses where observations are integers."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from endless_gym.popgym import Markovian, Observability, PreviousAction


class Vectors(PreviousAction):
    """Observation, previous action and whether a step is the first of its episode, as POPGym's agents observe them, as float32
    vectors in which integers are one-hot.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any], **added: bool) -> None:
        super().__init__(envs, flatten=True, **added)
        entries = self.single_observation_space.shape or ()
        self.single_observation_space = spaces.Box(-np.inf, np.inf, entries, np.float32)
        self.observation_space = batch_space(self.single_observation_space, envs.num_envs)

    def state_dict(self) -> dict[str, Any]:
        """The previous actions, and the environments whose episode has ended, for a checkpoint."""
        return {"actions": self._actions, "ended": self._ended}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned."""
        self._actions, self._ended = state["actions"].copy(), state["ended"].copy()

    def _joined(self, observation: Any, actions: NDArray[Any], first: NDArray[np.int64]) -> Any:
        return super()._joined(observation, actions, first).astype(np.float32)


class OneHot(Vectors):
    """Observations in which integers are one-hot, as those of `endless learn` before it added the previous action."""

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(envs, previous_action=False, antialias=False)


class States(Vectors):
    """The hidden Markov state in place of the observation, as float32 vectors in which integers are one-hot: the fully observable
    twin of an environment that tells its state.
    """

    def __init__(self, envs: VectorEnv[Any, Any, Any]) -> None:
        super().__init__(Markovian(envs, Observability.FULL), previous_action=False, antialias=False)
