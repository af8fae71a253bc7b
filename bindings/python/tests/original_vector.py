"""Plays the original in Gymnasium's own vector environment. Runs in the original's Python.

Usage: original_vector.py ID SEED ACTIONS.npy OPTIONS.json OUT.pickle

The output is a list of (checksums of the frames, rewards, ends), for the reset and for each step.
"""

import json
import pickle
import sys
import zlib

import gymnasium
import memory_gym  # noqa: F401
import numpy as np
from original import reset


class WithOptions(gymnasium.Wrapper):
    """Gives the reset parameters to every reset, also to those that start an episode after the end of another."""

    def __init__(self, env, id, options):
        super().__init__(env)
        self._id, self._options = id, options

    def reset(self, *, seed=None, options=None):
        del options
        return reset(self.env, self._id, seed=seed, options=self._options)


def main() -> None:
    id, seed, actions, options, out = sys.argv[1:]
    actions, options = np.load(actions), json.loads(options)
    make = lambda: WithOptions(gymnasium.make(id, disable_env_checker=True), id, options)  # noqa: E731
    envs = gymnasium.vector.SyncVectorEnv([make] * actions.shape[1])

    def checksums(observation):
        frames = observation["visual_observation"] if isinstance(observation, dict) else observation
        return [zlib.crc32(np.ascontiguousarray(frame).tobytes()) for frame in frames]

    record = [(checksums(envs.reset(seed=int(seed))[0]), None, None)]
    for action in actions:
        observation, reward, terminated, truncated, _ = envs.step(action)
        record.append((checksums(observation), reward.tolist(), (terminated | truncated).tolist()))
    with open(out, "wb") as file:
        pickle.dump(record, file)


if __name__ == "__main__":
    main()
