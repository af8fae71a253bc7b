"""Environments in an engine process: one that the script starts, and a running one."""

import endless_gym

envs: endless_gym.EndlessVectorEnv
with endless_gym.serve("MysteryPath-v0", num_envs=4, groups=2, autoreset="disabled", timeout=60.0) as envs:
    observation, info = envs.reset()
    envs.step(envs.action_space.sample())

try:
    with endless_gym.connect("endless", timeout=0.1, copy=True) as envs:
        observation, info = envs.adopt()
except endless_gym.EngineLost as lost:
    message: str = str(lost)
except (ConnectionError, endless_gym.TooManyBatchesHeld):
    engines: list[str] = endless_gym.running_engines()
