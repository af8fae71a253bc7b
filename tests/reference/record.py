"""Records the episodes of this folder in the original.

    python record.py OUT                                      # all of them, to compare them with those of this folder
    python record.py OUT --salt more --only MysteryPath-v0    # others: the salt varies seeds and actions

Writes OUT/traces, OUT/views and OUT/frames in the format that README.md describes. Recordings with options that the
installed version of memory-gym lacks are skipped, and listed on standard error.
"""

import argparse
import gzip
import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy
from original import Original
from policies import POLICIES

Options = dict[str, Any]

#: Sets of options besides the defaults.
VARIANTS: dict[str, list[Options]] = {
    "MortarMayhem-v0": [
        {
            "arena_size": 6,
            "allowed_commands": 5,
            "command_count": [2, 3, 4],
            "command_show_duration": [1, 2],
            "command_show_delay": [0, 2],
            "explosion_duration": [2, 4],
            "explosion_delay": [9, 12],
            "reward_episode_success": 1.0,
            "reward_command_failure": -0.5,
        },
        {"arena_size": 3, "agent_scale": 0.2, "agent_speed": 2.0, "visual_feedback": False, "allowed_commands": 4},
        {"arena_size": 2, "agent_scale": 0.35, "agent_speed": 4.5, "command_count": [1]},
    ],
    "MortarMayhem-Grid-v0": [
        {"arena_size": 6, "allowed_commands": 9, "command_count": [3, 5], "visual_feedback": False},
        {"arena_size": 4, "explosion_duration": [1, 3], "explosion_delay": [4, 8], "command_show_delay": [0]},
    ],
    "MortarMayhemB-v0": [{"arena_size": 4, "command_count": [5, 20], "allowed_commands": 9, "agent_speed": 2.5}],
    "MortarMayhemB-Grid-v0": [{"arena_size": 6, "command_count": [1, 20], "allowed_commands": 9}],
    "Endless-MortarMayhem-v0": [
        {
            "initial_command_count": 3,
            "allowed_commands": 5,
            "command_show_duration": [1, 4],
            "command_show_delay": [0, 1],
            "explosion_duration": [3],
            "explosion_delay": [12, 18],
            "reward_new_command_success": 0.5,
            "max_steps": 300,
        },
        {"agent_speed": 4.0, "agent_scale": 0.3, "visual_feedback": False, "reward_command_failure": -1.0},
    ],
    "MysteryPath-v0": [
        {
            "show_origin": True,
            "show_goal": True,
            "cardinal_origin_choice": [0, 3],
            "max_steps": 200,
            "reward_fall_off": -0.1,
            "reward_step": -0.01,
        },
        {"agent_scale": 0.35, "agent_speed": 4.25, "visual_feedback": False, "cardinal_origin_choice": [2]},
    ],
    "MysteryPath-Grid-v0": [
        {"show_origin": True, "show_goal": True, "reward_path_progress": 0.1, "cardinal_origin_choice": [1]},
        {"visual_feedback": False, "max_steps": 50, "reward_fall_off": -0.5},
    ],
    "Endless-MysteryPath-v0": [
        {
            "show_past_path": False,
            "show_background": True,
            "show_stamina": True,
            "stamina_level": 30,
            "reward_path_progress_dense": 0.05,
            "reward_step": -0.001,
        },
        {
            "camera_offset_scale": 2.5,
            "agent_speed": 4.0,
            "visual_feedback": False,
            "show_origin": True,
            "max_steps": 150,
        },
        {"camera_offset_scale": 0.0, "show_background": True, "agent_scale": 0.2},
    ],
    "SearingSpotlights-v0": [
        {
            "agent_visible": True,
            "coins_visible": True,
            "exit_visible": True,
            "num_coins": [3, 5],
            "agent_health": 20,
            "light_dim_off_duration": 0,
        },
        {
            "initial_spawns": 8,
            "num_spawns": 10,
            "spawn_interval_decay": 0.5,
            "spot_min_radius": 5,
            "spot_max_radius": 25,
            "spot_min_speed": 0.01,
            "spot_max_speed": 0.05,
            "light_threshold": 180,
            "light_dim_off_duration": 20,
            "spot_damage": 0.5,
        },
        {"black_background": True, "num_coins": [2], "show_last_action": False, "sample_agent_position": False},
        {
            "hide_chessboard": True,
            "visual_feedback": False,
            "show_last_positive_reward": False,
            "exit_scale": 1.0,
            "coin_scale": 0.8,
            "agent_scale": 0.4,
            "agent_speed": 5.0,
            "reward_inside_spotlight": -0.05,
            "reward_outside_spotlight": 0.01,
            "reward_death": -1.0,
            "reward_max_steps": -0.3,
            "max_steps": 80,
        },
    ],
    "Endless-SearingSpotlights-v0": [
        {
            "agent_visible": True,
            "coins_visible": True,
            "agent_health": 50,
            "steps_per_coin": 60,
            "light_dim_off_duration": 0,
        },
        {
            "initial_spawns": 10,
            "spawn_interval": 7,
            "spot_min_radius": 5,
            "spot_max_radius": 25,
            "spot_min_speed": 0.01,
            "spot_max_speed": 0.05,
            "light_threshold": 180,
            "light_dim_off_duration": 20,
            "max_steps": 120,
        },
        {"black_background": True, "coin_show_duration": 20, "sample_agent_position": False},
        {
            "hide_chessboard": True,
            "visual_feedback": False,
            "show_last_positive_reward": False,
            "coin_scale": 0.8,
            "agent_scale": 0.4,
            "reward_inside_spotlight": -0.05,
            "reward_outside_spotlight": 0.01,
            "reward_death": -1.0,
        },
        {"coin_enabled": False, "agent_health": 30, "max_steps": 150},
    ],
}

#: Number of frames kept for each id, and the policy of the trace that they come from.
FRAMES = 40
FRAMES_OF = "mixed20"


class Kind(NamedTuple):
    """One folder of recordings."""

    folder: str
    salt: str
    episodes: int
    #: Maximum number of steps of an episode.
    steps: int
    #: Whether the ground-truth view is recorded, too.
    views: bool


TRACES = Kind("traces", salt="a", episodes=6, steps=700, views=False)
VIEWS = Kind("views", salt="render", episodes=2, steps=200, views=True)


class Plan(NamedTuple):
    """One environment object with its options and its player."""

    env_id: str
    number: int
    options: Options
    policy: str

    def __str__(self) -> str:
        return f"{self.env_id}.{self.number:02d}.{self.policy}"

    def kinds(self) -> list[Kind]:
        """The kinds of recordings made of it."""
        return [TRACES] if self.options or self.policy == "constant" else [TRACES, VIEWS]

    def record(self, kind: Kind) -> tuple[dict[str, Any], list[Any]]:
        """Play the episodes. Returns the trace and its frames."""
        original = Original(self.env_id, self.options)
        rng = Random(f"{self.env_id}|{self.policy}|{kind.salt}|{json.dumps(self.options, sort_keys=True)}")
        first_seed = zlib.crc32(kind.salt.encode()) % 90000 + 100 * self.number
        episodes: list[Any] = []
        frames: list[Any] = []
        for episode in range(kind.episodes):
            # Every second episode has no seed and continues the generator.
            seed = first_seed + episode if episode % 2 == 0 else None
            actions = (POLICIES[self.policy](original.env, rng) for _ in range(kind.steps))
            episodes.append(original.episode(seed, actions, kind.views, frames))
        return {"env": self.env_id, "options": self.options, "policy": self.policy, "episodes": episodes}, frames


def plans(env_id: str) -> Iterator[Plan]:
    """Every policy with the default options, then two policies with each other set of options."""
    with_defaults: list[tuple[Options, str]] = [({}, policy) for policy in POLICIES]
    others = [(options, policy) for options in VARIANTS[env_id] for policy in ("mixed02", "random")]
    for number, (options, policy) in enumerate(with_defaults + others):
        yield Plan(env_id, number, options, policy)


def write(path: Path, data: bytes) -> None:
    """Write a gzip file without a timestamp, so that equal recordings give equal files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(data, 9, mtime=0))


def main() -> None:
    """Record what the command line requests."""
    parser = argparse.ArgumentParser(description="Record episodes in the original environments.")
    parser.add_argument("out", type=Path, help="folder to write to")
    parser.add_argument("--salt", help="text that varies seeds and actions (default: that of the recordings)")
    parser.add_argument("--only", choices=VARIANTS, metavar="ID", help="one environment (default: all)")
    arguments = parser.parse_args()
    for env_id in [arguments.only] if arguments.only else VARIANTS:
        known = Original(env_id, {}).parameters
        for plan in plans(env_id):
            missing = plan.options.keys() - known
            if missing:
                print(f"{plan}: left out, this version has no {', '.join(missing)}", file=sys.stderr)
                continue
            for kind in plan.kinds():
                trace, frames = plan.record(kind._replace(salt=arguments.salt or kind.salt))
                text = json.dumps(trace, separators=(",", ":"))
                write(arguments.out / kind.folder / f"{plan}.json.gz", text.encode())
                if kind is TRACES and not plan.options and plan.policy == FRAMES_OF:
                    write(arguments.out / "frames" / f"{env_id}.gz", numpy.stack(frames[:FRAMES]).tobytes())
            print(plan, flush=True)


if __name__ == "__main__":
    main()
