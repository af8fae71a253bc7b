"""Environments for Endless Gym; importing this package registers them."""

import endless_gym

from t_maze import _native

endless_gym.register_envs(_native)
