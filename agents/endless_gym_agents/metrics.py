"""The metrics of the paper: task progress in finite environments; commands, tiles or coins in endless ones.

Task progress is 0 to 1. The final infos of an episode do not always contain it, so it is computed:

* Mortar Mayhem: fraction of the commands that were executed. The infos count a failed last command; the reward does not.
* Mystery Path: fraction of the path's tiles that were reached, from the reward and the length of the path.
* Searing Spotlights: half for the collected coins, half for leaving through the exit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from endless_gym.env import Env
from endless_gym.specs import Spec

#: Name of the task progress in the results of an episode.
TASK_PROGRESS = "task_progress"

#: Name and plot label of the metric of each endless environment.
METRICS = {
    "Endless-MortarMayhem-v0": ("commands_completed", "Commands"),
    "Endless-MysteryPath-v0": ("tiles_visited", "Tiles"),
    "Endless-SearingSpotlights-v0": ("coins_collected", "Coins"),
}


def metric(env: str) -> tuple[str, str]:
    """Name of an environment's metric in the results, and its plot label."""
    return METRICS.get(env, (TASK_PROGRESS, "Task progress") if has_progress(env) else ("reward", "Return"))


def has_progress(env: str) -> bool:
    """Whether the task progress is defined: in the finite environments of Memory Gym."""
    return env.startswith(("MortarMayhem", "MysteryPath", "SearingSpotlights"))


def is_finite(env: str) -> bool:
    """Whether the environment is not one of the endless ones, whose episodes get longer the better the agent is."""
    return env not in METRICS


def counts_failures(env: str) -> tuple[str, ...]:
    """Names of the final infos that count a failed last command as executed, as the original does."""
    return ("success", "commands_completed") if is_finite(env) and env.startswith("MortarMayhem") else ()


def path_length(env: str, options: Mapping[str, Any], seed: int) -> int:
    """Number of tiles of the path of Mystery Path, with its goal and without its origin; 0 in other environments.

    Args:
        env: Environment id.
        options: Reset parameters that differ from the defaults.
        seed: Seed of the episode.
    """
    if not env.startswith("MysteryPath"):
        return 0
    game = Env(env, options=dict(options), observation="features")
    game.reset(seed=seed)
    _, tiles = game.progress()["tiles"]
    return int(tiles or 0)


def task_progress(spec: Spec, options: Mapping[str, Any], final: Mapping[str, float], path: int = 0) -> float | None:
    """Task progress of an episode, 0 to 1.

    Args:
        spec: Specification of the environment.
        options: Reset parameters that differ from the defaults.
        final: Final infos of the episode, with `reward`.
        path: Length of the path, from `path_length`; only used in Mystery Path.

    Returns:
        The task progress; None in endless environments and in those of others.
    """
    parameters = {**spec.reset_parameters, **options}
    if not has_progress(spec.id):
        return None
    if spec.id.startswith("MortarMayhem"):
        return _commands(parameters, final)
    if spec.id.startswith("MysteryPath"):
        return _tiles(parameters, final, path)
    return _coins(parameters, final)


def _commands(parameters: Mapping[str, Any], final: Mapping[str, float]) -> float:
    """Mortar Mayhem. `commands_completed` is a fraction that counts a failed last command; the reward shows whether it failed.

    If `command_count` contains both n and n + 1, an episode with n + 1 commands that fails at the last one may be
    indistinguishable from a complete episode with n commands, and counts as complete. If failing at the last command has the
    reward of executing it, the last command counts as failed.
    """
    share, reward = final["commands_completed"], parameters["reward_command_success"]
    if share < 1:
        return share
    failure, bonus = parameters["reward_command_failure"], parameters["reward_episode_success"]
    counts = sorted({int(count) for count in parameters["command_count"]})

    def is_return(expected: float) -> bool:
        return math.isclose(final["reward"], expected, rel_tol=1e-6, abs_tol=1e-9)

    if not math.isclose(failure, reward + bonus) and any(is_return(count * reward + bonus) for count in counts):
        return 1.0
    # All commands but the last one; the fewest, if several numbers have that return.
    count = next((count for count in counts if is_return((count - 1) * reward + failure)), counts[0])
    return (count - 1) / count


def _tiles(parameters: Mapping[str, Any], final: Mapping[str, float], path: int) -> float:
    """Mystery Path. Each tile is rewarded once, and the goal has its own reward; without a tile reward, success is returned."""
    tile, success = parameters["reward_path_progress"], final["success"]
    if tile <= 0 or parameters["reward_fall_off"] or parameters["reward_step"] or not path:
        return success
    tiles = (final["reward"] - success * parameters["reward_goal"]) / tile + success
    return float(tiles / path)


def _coins(parameters: Mapping[str, Any], final: Mapping[str, float]) -> float:
    """Searing Spotlights. If `num_coins` has several values, the fraction refers to the largest."""
    coins = max(int(count) for count in parameters["num_coins"])
    share = min(1.0, final["coins_collected"] / coins) if coins else 1.0
    return (share + final["success"]) / 2 if parameters["use_exit"] else share
