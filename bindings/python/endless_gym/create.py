"""Makes vector environments in this process (`make_vec`), or connects to those of a running engine (`connect`)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from endless_gym import _native
from endless_gym.arguments import named
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.display.rendering import TEXT_MODES, VECTOR_MODES, View, checked_view
from endless_gym.episodes import EpisodeOptions, TrackedVectorEnv, validate_episode_options
from endless_gym.interop import PageLocks, cuda_to_pin, page_locked_bytes
from endless_gym.requests.configuration import INSTEAD, MODES, AutoresetMode, AutoresetName, Options, checked_arguments
from endless_gym.requests.results import Results
from endless_gym.specs import Frames, ObservationName, described_spec, json_text
from endless_gym.vector import EndlessVectorEnv


@named(instead=INSTEAD)
def make_vec(
    id: str,
    num_envs: int = 1,
    num_threads: int | None = None,
    *,
    seed: int | None = None,
    seeds: range | Sequence[int] | None = None,
    options: Options | Sequence[Options] | None = None,
    autoreset: AutoresetName | AutoresetMode = "next_step",
    observation: ObservationName | None = None,
    frames: Frames | None = None,
    groups: int = 1,
    copy: bool = False,
    pin_memory: bool = False,
    independent_episodes: bool = False,
    state: bool = False,
    first_env: int = 0,
    total_envs: int | None = None,
    render_mode: str | None = None,
    view: View | None = None,
    episode_options: EpisodeOptions | None = None,
    episode_info: bool = False,
) -> EndlessVectorEnv:
    """Create environments in this process.

    Examples:
        >>> import endless_gym
        >>> envs = endless_gym.make_vec("MysteryPath-Grid-v0", num_envs=4, seed=0)
        >>> observation, info = envs.reset()
        >>> observation.shape, observation.dtype, envs.action_space
        ((4, 84, 84, 3), dtype('uint8'), MultiDiscrete([4 4 4 4]))

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Environments in each group.
        num_threads: Threads that step environments; `None` or 0 for one per core.
        seed: Environment `i`, numbered over all groups, is seeded with `seed + i` at its first reset; later episodes continue its
            generator. `None` takes entropy from the operating system.
        seeds: Seeds of the individual episodes. From a `range`, with any step, seeds are drawn at random; `seed` seeds the draws,
            and the paper trains with `range(100_000)`. A list is used in order and repeated.
        options: Reset parameters by the original's names: one mapping for all environments, or a sequence with one for each
            environment of all groups.
        autoreset: Gymnasium's auto-reset mode: `next_step`, `same_step` or `disabled`.
        observation: `rgb` for frames, `features` for a vector that describes what the frame shows, without drawing it, or
            `rgb+features` for a dict of both. `None` for frames, or features in environments without frames.
        frames: Format of the frames: grayscale, channels first, row-major, stacked. `None` for the original's format.
        groups: Groups of environments for `send` and `recv`, 1 to 64.
        copy: Return writable copies instead of read-only views.
        pin_memory: Step into memory that PyTorch page-locks, so that copies to a CUDA device are asynchronous. Without CUDA, this
            warns and does nothing.
        independent_episodes: Start every episode as in a new environment, so that it depends only on its seed and its reset
            parameters, and draw a seed for each episode without one. By default, as in the original, the first frames of an
            episode of Endless-MortarMayhem show the last episode's character, an episode of Searing Spotlights may start with the
            last one's background, and an episode without a seed continues the generator of the previous one.
        state: Add `info["state"]`, the hidden Markov state, float32 (n, k), in environments that tell it: those of POPGym.
            `endless_gym.popgym.Markovian` makes it a part of observations.
        first_env: Number of the first environment, for seeds, if the environments of one trainer are divided among several calls,
            for example one for each rank of a data-parallel run: environment `i` is numbered `first_env + i`.
        total_envs: Total number of environments of all these calls; `None` for `first_env` plus those of this call.
        render_mode: What `render` returns: `rgb_array` for frames, or the pictures of environments without frames;
            `debug_rgb_array` for ground-truth views; and, without frames, also `ansi` for texts of what the agents see.
        view: What `rgb_array` shows: `agent` for frames, the default, or `ground_truth` for ground-truth views.
        episode_options: Chooses the options of each episode, see `endless_gym.episodes.EpisodeOptions`. It is called between
            steps, before the step in which the episode may begin; with same-step auto-reset, that is one episode ahead.
        episode_info: Whether `info` contains the seed and the options of each running episode.

    Raises:
        TypeError: A number is not an integer, or `episode_options` cannot be called.
        ValueError: An argument is out of its range, or both `copy` and `pin_memory` are given.
    """
    given = checked_arguments(
        id,
        num_envs,
        num_threads,
        groups,
        seed,
        seeds,
        options,
        autoreset,
        observation,
        frames,
        independent_episodes,
        state,
        first_env,
        total_envs,
    )
    allocate = None if cuda_to_pin(pin_memory, copy) is None else page_locked_bytes()
    pools = given.described.native.Pools([json_text(config) for config in given.pools], given.num_threads, allocate)
    layout = json.loads(pools.layout())
    return _environments(
        pools,
        Results(given.described, layout, given.pools[0]["num_envs"], given.frames, given.autoreset, copy),
        episode_options,
        episode_info,
        options=[given.options] if isinstance(given.options, dict) else given.options,
        render_mode=render_mode,
        view=view,
        first_env=first_env,
    )


def connect(
    service: str,
    *,
    timeout: float = 30.0,
    copy: bool = False,
    pin_memory: bool = False,
    render_mode: str | None = None,
    view: View | None = None,
    episode_options: EpisodeOptions | None = None,
    episode_info: bool = False,
    engine: Any = None,
) -> EndlessVectorEnv:
    """Connect to a running engine, started by `endless serve --service NAME` or by `serve`.

    Args:
        service: The engine's name.
        timeout: Seconds to wait for the engine to start, and for each of its answers.
        copy: Return writable copies instead of read-only views of shared memory.
        pin_memory: Page-lock the shared memory until the environments are closed or reconnected, so that copies to a CUDA device
            are asynchronous. This takes one of the engine's `batches_held`. Without CUDA, this warns and does nothing.
        render_mode: As for `make_vec`.
        view: As for `make_vec`.
        episode_options: As for `make_vec`. It is called in this process; options that differ from the environment's last ones
            are sent to the engine before the next step.
        episode_info: As for `make_vec`. Each step in which episodes begin requests the information from the engine, which takes
            one of its `batches_held`.
        engine: Used by `serve`.

    Raises:
        ConnectionError: There is no such engine, or it already has a trainer.
        ValueError: The timeout is negative or not finite, there is no such render mode or view, both `copy` and `pin_memory` are
            given, or the engine lends only the batch that `pin_memory` holds.
    """
    timeout = checked_timeout(timeout)
    checked_view(render_mode, view, VECTOR_MODES | TEXT_MODES)
    cuda = cuda_to_pin(pin_memory, copy)
    connection = _native.Connection(service, timeout)
    specification = json.loads(connection.specification())
    if cuda is not None and specification["batches_held"] == 1:
        raise ValueError("pin_memory holds one batch, and the engine lends 1; start it with 2 or more batches held")
    return _environments(
        connection,
        specified_results(specification, copy),
        episode_options,
        episode_info,
        options=specification["options"],
        # An earlier trainer or a checkpoint may have changed them.
        knows_options=False,
        render_mode=render_mode,
        view=view,
        first_env=specification["first_env"],
        engine=engine,
        locks=None if cuda is None else PageLocks(cuda),
    )


def specified_results(specification: Mapping[str, Any], copy: bool) -> Results:
    """The results of an engine's batches, from its specification."""
    described, frames = described_spec(specification["environment"]), Frames.from_specification(specification["frames"])
    mode = MODES[specification["autoreset"]]
    return Results(described, specification["batch"], specification["num_envs"], frames, mode, copy)


def _environments(
    backend: _native.Backend,
    results: Results,
    episode_options: EpisodeOptions | None,
    episode_info: bool,
    **arguments: Any,
) -> EndlessVectorEnv:
    if validate_episode_options(episode_options) is None and not episode_info:
        return EndlessVectorEnv(backend, results, **arguments)
    return TrackedVectorEnv(backend, results, episode_options=episode_options, episode_info=episode_info, **arguments)
