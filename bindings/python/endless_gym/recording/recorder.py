"""`record`: plays episodes on several threads, and writes them as a Minari data set."""

from __future__ import annotations

import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

from endless_gym import _native
from endless_gym.arguments import MAX_U64, integer, mapping
from endless_gym.create import make_vec
from endless_gym.recording.episodes import Episode, Plan, play
from endless_gym.recording.players import ExpertPlayer, Player, RandomPlayer
from endless_gym.specs import Frames, ObservationName, Spec, contents, spec

#: Steps after which episodes are truncated in environments without a step limit, which an expert may play forever.
DEFAULT_MAX_STEPS = 1000

#: Episodes that a thread plays at the same time. It is fixed, so that an agent's actions do not depend on the number of threads.
EPISODES_AT_A_TIME = 32


@dataclass(frozen=True)
class Recording:
    """What `record` wrote.

    Attributes:
        dataset: Id of the data set, for `minari.load_dataset`.
        path: Its folder.
        episodes: Number of episodes.
        steps: Number of steps of all episodes.
        mean_return: Mean of the episodes' sums of rewards.
        mean_length: Mean of their lengths.
        megabytes: Size of its files in MB.
        seconds: Duration of the recording.
    """

    dataset: str
    path: Path
    episodes: int
    steps: int
    mean_return: float
    mean_length: float
    megabytes: float
    seconds: float


def record(
    id: str,
    episodes: int = 1000,
    *,
    policy: str | Player = "expert",
    error_rates: float | Sequence[float] = 0.0,
    seed: int = 0,
    action_seed: int = 0,
    options: Mapping[str, Any] | Sequence[Mapping[str, Any]] | None = None,
    max_steps: int | None = None,
    observation: ObservationName | None = None,
    frames: Frames | None = None,
    dataset: str | None = None,
    root: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    author: str | None = None,
    description: str | None = None,
    num_threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> Recording:
    """Play episodes and write them as a Minari data set, which `minari.load_dataset` reads.

    An episode depends on its seed, its options and the policy alone, and on `action_seed` and its number if it has random
    actions; it depends neither on earlier episodes nor on the number of threads. Its metadata has `seed`, `options`,
    `error_rate`, `return` and, unless it was truncated, `final_info` with the original's final infos.

    Args:
        id: Environment id, such as `MortarMayhem-v0`.
        episodes: Number of episodes.
        policy: `expert` for the scripted expert, `random` for random actions, or a `Player`.
        error_rates: Probability, 0 to 1, that a step takes a random action instead of the policy's; episodes cycle through
            several.
        seed: Episode `i` has the seed `seed + i`.
        action_seed: Seed of the random actions, and of an agent's.
        options: Reset parameters by the original's names: one mapping, or several, through which episodes cycle.
        max_steps: Truncate episodes after this number of steps. `None`: after 1,000 if the environment has no step limit.
        observation: `rgb`, `features`, `rgb+features` or `None`, as for `make_vec`.
        frames: Format of the frames, as for `make_vec`.
        dataset: Id of the data set; `None` for `endless-gym/ID/expert-v0`, or with `random` in its place.
        root: Folder of the data sets; `None` for Minari's.
        overwrite: Replace an existing data set of that id, once the new one is complete.
        author: Author in the metadata.
        description: Text in the metadata.
        num_threads: Threads that play; `None` for one per core.
        progress: Called with the number of episodes written so far.

    Raises:
        FileExistsError: There is a data set of that id.
        ImportError: Minari is not installed.
        TypeError: A number is not an integer.
        ValueError: An argument is out of its range.
    """
    # Minari is optional.
    from endless_gym.recording.dataset import DatasetWriter

    described = spec(id)
    player = _player(described, policy)
    count = integer("episodes", episodes, 1, 2**31)
    first, action_seed = integer("seed", seed), integer("action_seed", action_seed)
    rates = _rates(error_rates, player)
    several = options if isinstance(options, Sequence) and not isinstance(options, str) else [options]
    each = [mapping("options", given) for given in several]
    if not each:
        raise ValueError("options must be a mapping or a sequence with at least one, got an empty sequence")
    # Reports wrong reset parameters before anything is written.
    make_vec(described.id, len(each), 1, options=each, observation="features").close()
    limits = [_limit(described, given, max_steps) for given in each]
    plans = [
        Plan(
            number,
            (first + number) & MAX_U64,
            each[number % len(each)],
            rates[number % len(rates)],
            limits[number % len(each)],
        )
        for number in range(count)
    ]
    observation = observation or described.default_observation
    frames, has_features = contents(described, observation, frames)
    threads = integer("num_threads", num_threads or _native.cores(), 1, _native.MAX_THREADS)
    # Minari's names have neither `?` nor `=`.
    name = dataset or f"endless-gym/{re.sub('[^a-zA-Z0-9_-]', '-', described.id)}/{_short(player)}-v0"
    start = time.perf_counter()
    total = 0.0
    writer = DatasetWriter(
        name,
        root,
        observation_space=described.observation_space(frames, has_features),
        action_space=described.action_space(),
        env_spec=_env_spec(described, each, observation),
        metadata=_metadata(described, player, rates, author, description),
        overwrite=overwrite,
    )

    def work(part: Sequence[Plan], stop: threading.Event) -> list[Episode]:
        return play(described, player, part, observation=observation, frames=frames, action_seed=action_seed, stop=stop)

    with writer, _waves(plans, threads, work) as waves:
        for played in waves:
            for episode in played:
                writer.add(episode)
                total += episode.total
            if progress is not None:
                progress(writer.episodes)
    size = sum(file.stat().st_size for file in writer.path.rglob("*") if file.is_file()) / 1e6
    return Recording(
        name, writer.path, count, writer.steps, total / count, writer.steps / count, size, time.perf_counter() - start
    )


@contextmanager
def _waves(
    plans: Sequence[Plan], threads: int, work: Callable[[Sequence[Plan], threading.Event], list[Episode]]
) -> Iterator[Iterator[list[Episode]]]:
    """Episodes in order; some are played in advance."""
    size = EPISODES_AT_A_TIME
    parts = iter([plans[at : at + size] for at in range(0, len(plans), size)])
    stop, pending = threading.Event(), deque[Future[list[Episode]]]()
    executor = ThreadPoolExecutor(threads, thread_name_prefix="record")

    def waves() -> Iterator[list[Episode]]:
        while True:
            while len(pending) <= threads and (part := next(parts, None)) is not None:
                pending.append(executor.submit(work, part, stop))
            if not pending:
                return
            yield pending.popleft().result()

    try:
        yield waves()
    finally:
        stop.set()
        executor.shutdown(cancel_futures=True)


def _player(described: Spec, policy: str | Player) -> Player:
    if not isinstance(policy, str):
        return policy
    if policy not in ("expert", "random"):
        raise ValueError(f"policy must be expert, random or a player, got {policy!r}")
    return ExpertPlayer(described) if policy == "expert" else RandomPlayer(described)


def _short(player: Player) -> str:
    return {ExpertPlayer: "expert", RandomPlayer: "random"}.get(type(player), "agent")


def _rates(given: float | Sequence[float], player: Player) -> list[float]:
    rates = [float(rate) for rate in given] if isinstance(given, Sequence) else [float(given)]
    if not rates or not all(0 <= rate <= 1 for rate in rates):
        raise ValueError(f"error_rates must be numbers from 0 to 1, at least one, got {given}")
    return [1.0] if isinstance(player, RandomPlayer) else rates


def _limit(described: Spec, options: Mapping[str, Any], max_steps: int | None) -> int | None:
    if max_steps is not None:
        return integer("max_steps", max_steps, 1)
    return DEFAULT_MAX_STEPS if described.max_episode_steps(options) < 0 else None


def _env_spec(
    described: Spec, options: Sequence[Mapping[str, Any]], observation: ObservationName
) -> gymnasium.envs.registration.EnvSpec:
    """The specification that recreates the environment, with frames in the original's format, since Minari stores it as JSON."""
    env_spec = described.registered()
    assert env_spec is not None
    # Episodes are recorded in new environments; this one starts each of its episodes like a new one.
    env_spec.kwargs["independent_episodes"] = True
    if len(options) == 1 and options[0]:
        env_spec.kwargs["options"] = dict(options[0])
    if observation != described.default_observation:
        env_spec.kwargs["observation"] = observation
    return env_spec


def _metadata(
    described: Spec, player: Player, rates: Sequence[float], author: str | None, description: str | None
) -> dict[str, Any]:
    metadata: dict[str, Any] = {
        "algorithm_name": player.name,
        "description": description or f"{described.id}: {described.summary} Played by: {player.name}.",
        "requirements": [f"endless-gym>={_native.__version__}"],
        "error_rates": list(rates),
        "endless_gym_version": _native.__version__,
    }
    return metadata | ({"author": {author}} if author else {})
