"""What the paper reports of an episode: its task progress where the task is finite; commands, tiles or coins where it has no end.

A task progress lies between 0 and 1. The infos of an episode's end do not always tell it:

* Mortar Mayhem: the share of the commands that were carried out. The infos count a last command that failed, the reward does not.
* Mystery Path: the share of the path's tiles that were reached, from the reward and the length of the path.
* Searing Spotlights: half for the coins, half for leaving by the exit.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from endless_gym.specs import Spec

TASK_PROGRESS = "task_progress"

#: The paper's metric of each environment, and how a plot calls it.
METRICS = {
    "Endless-MortarMayhem-v0": ("commands_completed", "Commands"),
    "Endless-MysteryPath-v0": ("tiles_visited", "Tiles"),
    "Endless-SearingSpotlights-v0": ("coins_collected", "Coins"),
}

#: Side of a tile of Mystery Path in the ground-truth view, in pixels, and the colours of the path's tiles and of its goal.
_TILE = 48
_PATH, _GOAL = (255, 255, 255), (0, 255, 0)


def metric(env: str) -> tuple[str, str]:
    """The name of an environment's metric in the results, and its label."""
    return METRICS.get(env, (TASK_PROGRESS, "Task progress"))


def is_finite(env: str) -> bool:
    """Whether the environment's task has an end, and so a task progress."""
    return env not in METRICS


def path_length(view: NDArray[np.uint8]) -> int:
    """Tiles of a path that there are to reach, its goal counted and its origin not.

    Args:
        view: Mystery Path's ground-truth view at the start of an episode, uint8 (336, 336, 3).
    """
    centres = view[_TILE // 2 :: _TILE, _TILE // 2 :: _TILE]
    return int(sum((centres == colour).all(-1).sum() for colour in (_PATH, _GOAL)))


def needs_path_length(env: str) -> bool:
    """Whether `task_progress` wants to know the path's length."""
    return env.startswith("MysteryPath")


def task_progress(spec: Spec, options: Mapping[str, Any], final: Mapping[str, float], path: int = 0) -> float | None:
    """How much of its task an episode has done, from 0 to 1.

    Args:
        spec: Of the environment.
        options: The reset parameters that differ from the defaults.
        final: The episode's final infos, with `reward`.
        path: What `path_length` says, for Mystery Path.

    Returns:
        None for an environment without an end.
    """
    parameters = {**spec.reset_parameters, **options}
    if not is_finite(spec.id):
        return None
    if spec.id.startswith("MortarMayhem"):
        return _commands(parameters, final)
    if spec.id.startswith("MysteryPath"):
        return _tiles(parameters, final, path)
    return _coins(parameters, final)


def _commands(parameters: Mapping[str, Any], final: Mapping[str, float]) -> float:
    """Mortar Mayhem. `commands_completed` is a share, and counts the last command even if it failed; the reward tells.

    Where the number of commands is drawn from several that follow each other, an episode of the larger one that failed at its
    last command looks like a whole one of the smaller, and counts as that.
    """
    share, reward = final["commands_completed"], parameters["reward_command_success"]
    tells = reward > 0 and not parameters["reward_command_failure"] and not parameters["reward_episode_success"]
    if share < 1 or not tells:
        return share
    done = round(final["reward"] / reward)
    counts = {int(count) for count in parameters["command_count"]}
    # All were carried out, or all but the last one of a longer sequence.
    return 1.0 if done in counts else done / (done + 1)


def _tiles(parameters: Mapping[str, Any], final: Mapping[str, float], path: int) -> float:
    """Mystery Path. Each tile is rewarded once, the goal in its own way; without a reward for tiles, success counts."""
    tile, success = parameters["reward_path_progress"], final["success"]
    if tile <= 0 or parameters["reward_fall_off"] or parameters["reward_step"] or not path:
        return success
    tiles = (final["reward"] - success * parameters["reward_goal"]) / tile + success
    return float(tiles / path)


def _coins(parameters: Mapping[str, Any], final: Mapping[str, float]) -> float:
    """Searing Spotlights. With several numbers of coins to choose from, the share is of the largest."""
    coins = max(int(count) for count in parameters["num_coins"])
    share = min(1.0, final["coins_collected"] / coins) if coins else 1.0
    return (share + final["success"]) / 2 if parameters["use_exit"] else share
