"""Checks shared by the adapters to other libraries."""

from __future__ import annotations

from gymnasium.vector import AutoresetMode

from endless_gym.vector import EndlessVectorEnv


def check_adaptable(envs: EndlessVectorEnv, autoreset: AutoresetMode, library: str) -> None:
    """Check that a library can use vector environments.

    Args:
        envs: The vector environments.
        autoreset: The auto-reset mode that the library requires.
        library: Its name, for messages.

    Raises:
        ValueError: The environments have another auto-reset mode, or more than one group.
    """
    mode = AutoresetMode(envs.metadata["autoreset_mode"])
    if mode is not autoreset:
        raise ValueError(f'autoreset must be "{autoreset.name.lower()}" for {library}, got "{mode.name.lower()}"')
    if envs.num_groups != 1:
        raise ValueError(f"groups must be 1 for {library}, got {envs.num_groups}")
