"""`endless-record`: record episodes of a trained agent as a Minari data set.

```console
endless-record runs/mine --episodes 1000                    # the last checkpoint of a run
endless-record runs/mine --episodes 1000 --error-rates 0 0.1
```
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from endless_gym.recording import command as recording
from endless_gym.recording import record
from endless_gym.recording.players import Actor
from endless_gym.specs import ObservationName, spec
from endless_gym_agents import checkpoint, command, ranges
from endless_gym_agents.agent import Agent
from endless_gym_agents.ranges import Natural, Positive, Range
from endless_gym_agents.train import choose_device


@dataclass(frozen=True)
class RecordArguments:
    """Arguments of `endless-record`."""

    checkpoint: tyro.conf.Positional[Path]
    """a checkpoint file, or the folder of a run for its last checkpoint"""
    episodes: Positive = 1000
    """number of episodes"""
    error_rates: Annotated[tuple[float, ...], Range(0, 1)] = (0.0,)
    """probability that a step takes a random action instead of the agent's; episodes cycle through several values"""
    seed: Natural = 0
    """episode i has the seed SEED + i"""
    action_seed: Natural = 0
    """seed of the action sampling and of the random actions"""
    greedy: bool = False
    """take the most likely actions instead of sampling"""
    max_steps: Annotated[int | None, Range(1)] = None
    """truncate episodes after this number of steps; by default after 1000 in environments without a step limit"""
    name: str | None = None
    """id of the data set; by default endless-gym/ID/agent-v0"""
    root: Path | None = None
    """folder of the data sets; by default MINARI_DATASETS_PATH, or ~/.minari/datasets"""
    overwrite: bool = False
    """replace an existing data set with that id"""
    author: str | None = None
    """author in the metadata"""
    threads: Natural = 0
    """threads that play; 0 for one per core"""
    json: bool = False
    """print JSON instead of text"""
    device: str = "cpu"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available, else the CPU"""


class AgentPlayer:
    """A trained agent. The action seed and the episodes played at the same time determine its actions."""

    def __init__(self, agent: Agent, action_seed: int = 0, greedy: bool = False) -> None:
        """Make the player.

        Args:
            agent: The agent.
            action_seed: Seed of the action sampling.
            greedy: Take the most likely actions instead of sampling.
        """
        self._agent, self._action_seed, self._greedy = agent, action_seed, greedy
        self._spec = spec(agent.settings.env)
        #: The name of the algorithm in a data set.
        self.name = f"PPO, agent {agent.settings.agent_name}"
        #: The observation that the agent needs.
        self.observation: ObservationName | None = agent.settings.environment.observation

    def actor(self, num_envs: int, first_episode: int) -> Actor:
        """The agent acting in `num_envs` environments, with a new memory and generator."""
        agent, memory = self._agent, self._agent.initial_memory(num_envs)
        state = np.random.SeedSequence([self._action_seed, first_episode]).generate_state(1, np.uint64)
        generator = torch.Generator(agent.device).manual_seed(int(state[0] >> 1))

        def act(
            observation: Mapping[str, NDArray[Any]], episode_start: NDArray[np.bool_], active: NDArray[np.bool_]
        ) -> NDArray[np.int64]:
            memory.reset(episode_start)
            action = agent.act(observation, memory, generator, self._greedy).action
            return self._spec.batched_actions(action.cpu().numpy())

        return act


def execute(arguments: RecordArguments) -> None:
    """Record the episodes, and print what was recorded."""
    ranges.check(arguments)
    agent = checkpoint.load(arguments.checkpoint, choose_device(arguments.device)).agent
    settings = agent.settings
    if settings.environment.wrapper:
        raise ValueError(
            "a data set contains the environment's own observations and rewards; got an agent that was trained with "
            f"--environment.wrapper {' '.join(settings.environment.wrapper)}"
        )
    with recording.progress(arguments.episodes) as bar:
        recorded = record(
            settings.env,
            arguments.episodes,
            policy=AgentPlayer(agent, arguments.action_seed, arguments.greedy),
            error_rates=arguments.error_rates,
            seed=arguments.seed,
            action_seed=arguments.action_seed,
            options=settings.options(),
            max_steps=arguments.max_steps,
            observation=settings.environment.observation,
            dataset=arguments.name,
            root=arguments.root,
            overwrite=arguments.overwrite,
            author=arguments.author,
            num_threads=arguments.threads,
            progress=bar,
        )
    recording.show(recorded, arguments.json)


def main() -> int:
    """Entry point of the command `endless-record`; returns the exit status."""
    arguments = command.parse(RecordArguments, "endless-record", __doc__)
    return recording.run("endless-record", lambda: execute(arguments))


if __name__ == "__main__":
    sys.exit(main())
