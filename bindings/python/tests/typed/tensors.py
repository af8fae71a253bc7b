"""Observations as tensors."""

import torch

import endless_gym

with endless_gym.make_vec("MysteryPath-v0", 4) as envs:
    observation, info = envs.reset(seed=0)
    tensor: torch.Tensor = endless_gym.torch_view(observation)
    capsule = endless_gym.DLPackView(observation).__dlpack__(max_version=(1, 0))
    mean: float = float(tensor.float().mean())
