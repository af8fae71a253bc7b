"""`endless-record`: record episodes of a trained agent as a Minari data set.

```console
endless-record runs/mine --episodes 1000                    # the last checkpoint of a run
endless-record runs/mine --episodes 1000 --error-rates 0 0.1
```
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from endless_gym.recording import command as recording
from endless_gym.recording.players import Actor
from endless_gym.specs import ObservationName, spec
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import command
from endless_gym_agents.environments import wrappers
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import choose_device


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
        observed = wrappers.Observed(agent.settings, num_envs)
        wrapped = wrappers.wrap(agent.settings, observed)
        state = np.random.SeedSequence([self._action_seed, first_episode]).generate_state(1, np.uint64)
        generator = torch.Generator(agent.device).manual_seed(int(state[0] >> 1))

        def act(
            observation: Mapping[str, Any], episode_start: NDArray[np.bool_], active: NDArray[np.bool_]
        ) -> NDArray[np.int64]:
            memory.reset(episode_start)
            seen: Any = observation
            if wrapped is not observed:
                observed.observation, previous = observation["features"], observation.get("previous_action")
                seen = (wrapped.reset() if previous is None else wrapped.step(previous))[0]
            action = agent.act(seen, memory, generator, self._greedy).action
            return self._spec.batched_actions(action.cpu().numpy())

        return act


def execute(given: Namespace) -> None:
    """Record the episodes, and print what was recorded."""
    agent = checkpoint.load(given.checkpoint, choose_device(given.device)).agent
    settings = agent.settings
    if own := settings.environment.own_wrappers:
        raise ValueError(
            "a data set contains the environment's own observations and rewards; got an agent that was trained with "
            f"--environment.wrapper {' '.join(own)}"
        )
    player = AgentPlayer(agent, given.action_seed, given.greedy)
    options = settings.options()
    recording.write(given, settings.env, policy=player, options=options, observation=player.observation)


def main() -> int:
    """Entry point of the command `endless-record`; returns the exit status."""
    parser = recording.parser("endless-record", command.description(__doc__), "endless-gym/ID/agent-v0")
    add = parser.add_argument
    add("checkpoint", type=Path, help="a checkpoint file, or the folder of a run for its last checkpoint")
    add("--greedy", action="store_true", help="take the most likely actions instead of sampling")
    add("--device", default="cpu", help="`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available [default: cpu]")
    given = parser.parse_args()
    return recording.run("endless-record", lambda: execute(given))


if __name__ == "__main__":
    sys.exit(main())
