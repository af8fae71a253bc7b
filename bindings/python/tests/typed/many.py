"""Environments in this process, made by each of the two functions."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from numpy.typing import NDArray

import endless_gym

with endless_gym.make_vec(
    "MysteryPath-Grid-v0",
    num_envs=8,
    seeds=range(100),
    options={"max_steps": 20},
    autoreset="same_step",
    observation="rgb+features",
    frames=endless_gym.Frames(grayscale=True),
    independent_episodes=True,
) as envs:
    observation, info = envs.reset(seed=[1, 2, 3, 4, 5, 6, 7, None])
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    observation, reward, terminated, truncated, info = envs.step(np.zeros(8, dtype=np.int64))
    ended: int = int(terminated.sum())
    saved: bytes = envs.snapshot(0)
    envs.restore({1: saved})

with endless_gym.make_vec("MysteryPath-v0", 2, groups=2, autoreset=AutoresetMode.DISABLED) as envs:
    envs.send_reset(0, seed=np.arange(2))
    envs.recv(0)
    envs.send([[0, 1], [2, 0]], group=0)
    observation, reward, terminated, truncated, info = envs.recv()

vector: VectorEnv[Any, Any, Any] = gymnasium.make_vec("EndlessGym/MysteryPath-v0", num_envs=2, observation="features")
vector.close()
