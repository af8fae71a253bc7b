"""Checks shared by the adapters to other libraries."""

from __future__ import annotations

from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorWrapper

from endless_gym.vector import EndlessVectorEnv


def check_adaptable(envs: EndlessVectorEnv | VectorWrapper, autoreset: AutoresetMode, library: str) -> EndlessVectorEnv:
    """Check that a library can use vector environments, and return them without their wrappers.

    Args:
        envs: The vector environments.
        autoreset: The auto-reset mode that the library requires.
        library: Its name, for messages.

    Raises:
        TypeError: They are not `EndlessVectorEnv`s.
        ValueError: The environments have another auto-reset mode, more than one group, or tuples as observations.
    """
    own = envs.unwrapped
    if not isinstance(own, EndlessVectorEnv):
        raise TypeError(f"envs must be made by make_vec, serve or connect, got {envs!r}")
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not autoreset:
        raise ValueError(f'autoreset must be "{autoreset.name.lower()}" for {library}, got "{mode.name.lower()}"')
    if own.num_groups != 1:
        raise ValueError(f"groups must be 1 for {library}, got {own.num_groups}")
    if isinstance(envs.single_observation_space, spaces.Tuple):
        raise ValueError(
            f"observations must not be tuples for {library}, got {envs.single_observation_space}; flatten them with "
            "endless_gym.popgym.PreviousAction(envs, flatten=True)"
        )
    return own
