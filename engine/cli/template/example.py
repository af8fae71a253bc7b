"""Play the environment in this process: one alone, then many in lockstep."""

import endless_gym
import gymnasium

with gymnasium.make("t_maze:EndlessGym/TMaze-v0", options={"length": 3}) as env:
    observation, info = env.reset(seed=0)
    for action in (2, 2, 2, 0):
        observation, reward, terminated, truncated, info = env.step(action)
    print(f"frame {observation.shape}, turned left: reward {reward}, {info}")

with endless_gym.make_vec("t_maze:TMaze-v0", num_envs=64, observation="features") as envs:
    envs.reset(seed=0)
    episodes = 0
    for _ in range(500):
        observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        episodes += (terminated | truncated).sum()
    print(f"{episodes} episodes of random actions, features {observation.shape}")
