"""Checks the arguments of `make_vec` and `serve`, so that both raise the same errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium

from endless_gym import _native
from endless_gym.arguments import integer, mappings, seeding
from endless_gym.specs import Frames, ObservationName, Spec, contents, json_text, spec

try:
    from gymnasium.vector import AutoresetMode as AutoresetMode
except ImportError as error:
    raise ImportError(
        f"vector environments need Gymnasium 1.1 or newer, and {gymnasium.__version__} is installed: "
        "pip install 'gymnasium>=1.1'; `gymnasium.make` works with this version"
    ) from error

Options = Mapping[str, Any]

#: Largest total number of environments of all engines of one trainer.
MAX_TOTAL_ENVS = 2**32 - 1

#: Arguments of other libraries' vector environments, and what `make_vec` and `serve` have instead.
INSTEAD = {
    "autoreset_mode": "the auto-reset mode is `autoreset`",
    "max_episode_steps": "the reset parameter `max_steps` limits the steps of an episode: options={'max_steps': 100}",
    "max_steps": "it is a reset parameter: options={'max_steps': 100}",
    "env_id": "the environment's id is `id`",
    "num_workers": "the number of threads is `num_threads`",
    "vectorization_mode": "all environments are stepped on the threads of `num_threads`; only `gymnasium.make_vec` has it",
}

#: The names of the auto-reset modes.
AutoresetName = Literal["next_step", "same_step", "disabled"]

#: The auto-reset modes by their names.
MODES = {name: AutoresetMode[name.upper()] for name in _native.AUTORESET_MODES}


@dataclass(frozen=True)
class Arguments:
    """The checked arguments that `make_vec` and `serve` share."""

    described: Spec
    num_threads: int
    autoreset: AutoresetMode
    frames: Frames | None
    #: The reset parameters of all environments, or of each one of all groups.
    options: dict[str, Any] | list[dict[str, Any]]
    #: The configuration of each group, which the engine has checked: the JSON object of its `PoolConfig`.
    pools: list[dict[str, Any]]


def checked_arguments(
    id: str,
    num_envs: int,
    num_threads: int | None,
    groups: int,
    seed: int | None,
    seeds: range | Sequence[int] | None,
    options: Options | Sequence[Options] | None,
    autoreset: AutoresetName | AutoresetMode,
    observation: ObservationName | None,
    frames: Frames | None,
    independent_episodes: bool,
    state: bool,
    first_env: int,
    total_envs: int | None,
) -> Arguments:
    """Check arguments of `make_vec`.

    Raises:
        TypeError: A number is not an integer.
        ValueError: An argument is out of its range.
    """
    described, mode = spec(id), autoreset_mode(autoreset)
    if state and not described.markov_state:
        raise ValueError(f"state must be False, since {described.id} does not tell its Markov state")
    num_envs = integer("num_envs", num_envs, 1, _native.MAX_ENVS)
    groups = integer("groups", groups, 1, _native.MAX_GROUPS)
    threads = integer("num_threads", num_threads or 0, 0, _native.MAX_THREADS)
    first_env = integer("first_env", first_env, 0, MAX_TOTAL_ENVS)
    end = first_env + groups * num_envs
    total_envs = end if total_envs is None else integer("total_envs", total_envs, end, MAX_TOTAL_ENVS)
    chosen: dict[str, Any] | list[dict[str, Any]]
    if options is None or isinstance(options, Mapping):
        chosen = dict(options or {})
    else:
        chosen = [given or {} for given in mappings("options", options, groups * num_envs)]
    source = seeding(seed, seeds, total_envs)
    frames, features = contents(described, observation, frames)
    pools = [
        {
            "id": described.id,
            "num_envs": num_envs,
            "options": chosen if isinstance(chosen, dict) else chosen[group * num_envs :][:num_envs],
            "autoreset": mode.name.lower(),
            "final_observation": True,
            "seeding": source,
            "independent_episodes": bool(independent_episodes),
            "frames": frames.configuration() if frames else None,
            "features": features,
            "state": bool(state),
            # Environments are numbered over all groups.
            "first_env": first_env + group * num_envs,
            "total_envs": total_envs,
        }
        for group in range(groups)
    ]
    for pool in pools:
        described.native.check_pool_config(json_text(pool))
    return Arguments(described, threads, mode, frames, chosen, pools)


def autoreset_mode(given: AutoresetName | AutoresetMode) -> AutoresetMode:
    """Gymnasium's auto-reset mode, from the mode or its name."""
    mode = given if isinstance(given, AutoresetMode) else MODES.get(given) if isinstance(given, str) else None
    if mode is None:
        raise ValueError(f"autoreset must be one of {', '.join(MODES)}, got {given!r}")
    return mode
