"""Plays like programs written for Gymnasium 0.29, such as CleanRL's ppo_trxl. Runs in the original's Python, and prints digests
of everything that the environments return.

Usage: older_gymnasium.py MODULE, where MODULE registers the original's ids
"""

import hashlib
import importlib
import json
import sys

import gymnasium as gym
import numpy as np

IDS = [
    "MortarMayhem-Grid-v0",
    "MortarMayhemB-v0",
    "Endless-MortarMayhem-v0",
    "MysteryPath-v0",
    "Endless-SearingSpotlights-v0",
]


def digest(value):
    """A digest that can be compared between processes."""
    if isinstance(value, dict):
        # "t" is the duration of an episode, and the original does not return "task_progress".
        return {key: digest(item) for key, item in value.items() if key not in ("t", "task_progress")}
    if isinstance(value, (list, tuple)) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [digest(item) for item in value]
    if isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
    # 0 and 0.0 are the same reward, and so are Python's and numpy's floats.
    return float(value) if isinstance(value, (int, float, np.number)) else repr(value)


def make(id, **kwargs):
    return gym.wrappers.RecordEpisodeStatistics(gym.make(id, render_mode="debug_rgb_array", **kwargs))


def play(id):
    envs = gym.vector.SyncVectorEnv([lambda: make(id) for _ in range(3)])
    envs.envs[0].reset()
    yield envs.envs[0].spec.max_episode_steps, envs.envs[0].max_episode_steps
    yield envs.reset(seed=5)
    random, ends = np.random.default_rng(0), 0
    highest = getattr(envs.single_action_space, "nvec", None)
    highest = np.full(3, envs.single_action_space.n) if highest is None else np.tile(highest, (3, 1))
    for _ in range(600):
        step = envs.step(random.integers(0, highest))
        yield step
        for info in step[4].get("final_info", []):
            ends += bool(info and "episode" in info)
    assert ends > 0, "no episode ended, or RecordEpisodeStatistics has not seen it"
    yield envs.call("render")
    envs.close()


def play_with_options():
    env = gym.make("MortarMayhem-Grid-v0", disable_env_checker=True)
    yield env.reset(seed=2, options={"arena_size": 3, "command_count": [4]})
    yield env.max_episode_steps
    for _ in range(30):
        yield env.step(1)


def main() -> None:
    importlib.import_module(sys.argv[1])
    record = {id: [digest(entry) for entry in play(id)] for id in IDS}
    record["options"] = [digest(entry) for entry in play_with_options()]
    print(json.dumps(record))


if __name__ == "__main__":
    main()
