"""Small agents, and segments that they have played, for the agents' tests."""

from dataclasses import replace
from typing import Any

import torch

from endless_gym.agents.agent import Agent, AgentMemory
from endless_gym.agents.settings import PRESETS, Model, Recurrence, Settings, Transformer

FEATURES = {"features": (6,)}
BRANCHES = (3, 2)


def settings(agent: str, **changes: Any) -> Settings:
    """Tiny networks; `changes` replace whole fields."""
    small = {
        "recurrence": Recurrence(hidden_size=16, sequence_length=8),
        "transformer": Transformer(layers=2, width=16, heads=2, window=6, sequence_length=8, positions=64),
        "model": Model(vector_width=12, head_width=10),
    }
    return replace(PRESETS["quick"], agent=agent, **(small | changes))


def transformer(**changes: Any) -> dict[str, Transformer]:
    return {"transformer": replace(settings("trxl").transformer, **changes)}


def make(agent: str, shapes: dict[str, tuple[int, ...]] = FEATURES, **changes: Any) -> Agent:
    torch.manual_seed(3)
    made = Agent(settings(agent, **changes), shapes, BRANCHES)
    # Weights as after some training: biases and the policy's last layer are not near zero any more.
    for parameter in made.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return made


def observations(steps: int, envs: int) -> torch.Tensor:
    return torch.randn(steps, envs, 6, generator=torch.Generator().manual_seed(5))


def ends(steps: int, envs: int) -> torch.Tensor:
    """Where episodes end, bool (steps, envs): in environment 0 never, in the others at different times."""
    done = torch.rand(steps, envs, generator=torch.Generator().manual_seed(6)) < 0.15
    done[:, 0] = False
    return done


def play(
    agent: Agent, memory: AgentMemory, observed: torch.Tensor, done: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Act on given observations (T, N, 6) as one segment.

    Returns:
        Which steps start an episode (T, N), actions (T, N, 2), their log-probabilities (T, N, 2), and values (T, N).
    """
    agent.memory.begin_segment(memory.state, observed.shape[0])
    rows = []
    generator = torch.Generator().manual_seed(7)
    for observation, end in zip(observed, done, strict=True):
        first = memory.first
        acted = agent.act({"features": observation}, memory, generator)
        rows.append((first, acted.action, acted.log_prob, acted.value))
        memory.forget(end)
    # A segment ends with a look at what comes next, which must leave it as it is.
    agent.estimate({"features": observed[-1]}, memory)
    first, action, log_prob, value = (torch.stack(column) for column in zip(*rows, strict=True))
    return first, action, log_prob, value
