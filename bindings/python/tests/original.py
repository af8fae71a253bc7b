"""Plays actions from a file in the original, and writes everything that it returns to another. Runs in the original's Python.

Usage: original.py ID ACTIONS.npy OPTIONS OUT.pickle
"""

import json
import pickle
import sys

import gymnasium
import memory_gym  # noqa: F401
import numpy as np


class Start(tuple):
    """The first tile of an endless path, compared by its coordinates, as 1.0.3 does; 1.0.2 compares the object."""

    x = property(lambda self: self[0])
    y = property(lambda self: self[1])


def reset(env, id, **kwargs):
    observation, info = env.reset(**kwargs)
    if id == "Endless-MysteryPath-v0":
        env.unwrapped.start = Start((env.unwrapped.start.x, env.unwrapped.start.y))
    return observation, info


def main() -> None:
    id, actions, options, out = sys.argv[1:]
    env = gymnasium.make(id, render_mode="debug_rgb_array", disable_env_checker=True)
    options = json.loads(options)
    record = []
    observation, info = reset(env, id, seed=11, options=options)
    record.append((observation, None, None, None, info, env.unwrapped.render()))
    described = {
        "observation_space": repr(env.observation_space),
        "action_space": repr(env.action_space),
        "metadata": dict(env.unwrapped.metadata),
        "has_ground_truth_info": env.unwrapped.has_ground_truth_info,
        "ground_truth_space": repr(getattr(env.unwrapped, "ground_truth_space", None)),
        "max_episode_steps": env.unwrapped.max_episode_steps,
    }
    for action in np.load(actions):
        action = int(action[0]) if len(action) == 1 else action
        observation, reward, terminated, truncated, info = env.step(action)
        record.append((observation, reward, terminated, truncated, info, env.unwrapped.render()))
        if terminated or truncated:
            observation, info = reset(env, id, options=options)
            record.append((observation, None, None, None, info, env.unwrapped.render()))
    with open(out, "wb") as file:
        # Plain bytes, since the two Pythons have different versions of numpy.
        pickle.dump((described, [plain(entry) for entry in record]), file)


def plain(value):
    if isinstance(value, np.ndarray):
        return ("array", str(value.dtype), value.shape, value.tobytes())
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple):
        return tuple(plain(item) for item in value)
    return value


if __name__ == "__main__":
    main()
