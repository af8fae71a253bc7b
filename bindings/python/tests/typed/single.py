"""One environment."""

from typing import Any

import gymnasium

import endless_gym

env: gymnasium.Env[Any, Any] = gymnasium.make("EndlessGym/MortarMayhem-Grid-v0", independent_episodes=True)
observation, info = env.reset(seed=1)

direct = endless_gym.Env("Endless-MortarMayhem-v0", render_mode="rgb_array", options={"agent_speed": 2.0})
observation, info = direct.reset(seed=1, options={"allowed_commands": 5})
observation, reward, terminated, truncated, info = direct.step([0, 1])
total: float = 0.0
total += reward
snapshot: bytes = direct.snapshot()
direct.restore(snapshot)
names: list[str] = [choice.name for branch in endless_gym.spec("MysteryPath-v0").actions for choice in branch.choices]
direct.close()
