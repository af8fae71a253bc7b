"""A trained agent."""

import dataclasses
import sys
from pathlib import Path

import torch

import endless_gym
from endless_gym_agents import load
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.settings import PRESETS, Settings
from endless_gym_agents.training.train import train


def main(folder: str) -> None:
    settings: Settings = dataclasses.replace(PRESETS["quick"], env="MortarMayhem-Grid-v0", run=folder)
    run: Path = train(settings)
    agent = load(run).agent
    results: list[dict[str, float]] = evaluate(agent, seeds=range(200_000, 200_005), repetitions=1)
    print(f"{mean(results):.3f}")
    with endless_gym.make_vec("MortarMayhem-Grid-v0", 4, observation="features", autoreset="same_step") as envs:
        observation, _ = envs.reset(seed=0)
        memory = agent.initial_memory(envs.num_envs)
        output = agent.act({"features": endless_gym.torch_view(observation)}, memory, torch.Generator())
        observation, _, done, _, _ = envs.step(output.action[:, 0].numpy())
        memory.reset(done)


if __name__ == "__main__":
    main(sys.argv[1])
