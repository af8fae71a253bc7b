"""Every weight gets a gradient. That weights change is not enough, since AdamW also decays weights without a gradient."""

from dataclasses import replace

import pytest
import torch
from agents_helpers import BRANCHES, ends, loss_of, make, observations, play, segment_of, settings
from test_agents_memory import KINDS, TRANSFORMERS, agent_of

from endless_gym_agents.agent import Agent, AgentMemory
from endless_gym_agents.encoders import FRAME
from endless_gym_agents.rollout import Segment

STEPS, ENVS = 12, 3


def without_gradient(agent: Agent, segment: Segment, memory: AgentMemory) -> list[str]:
    """Names of the weights whose gradient of the total loss is missing or entirely 0."""
    loss_of(agent, segment, memory.state, agent.settings.ppo, 0.01).backward()
    return [name for name, weight in agent.named_parameters() if weight.grad is None or not weight.grad.any()]


# The observation of the agents `stack` and `position` is transformed in `act`, before the network.
@pytest.mark.parametrize("name", [name for name in KINDS if name not in ("stack", "position")])
def test_every_weight_gets_a_gradient(name: str) -> None:
    agent = agent_of(name)
    memory, observed = agent.initial_memory(ENVS), observations(STEPS, ENVS)
    # In the second segment, the hidden states of recurrent layers are no longer zero.
    play(agent, memory, observed, ends(STEPS, ENVS))
    segment = segment_of(agent, memory, {"features": observed}, STEPS, ENVS)
    assert without_gradient(agent, segment, memory) == []


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_gradients_are_the_same_for_each_sequence_length(name: str) -> None:
    """Sequences of one step are computed by a different algorithm than longer ones."""
    agent = agent_of(name)
    memory, observed = agent.initial_memory(ENVS), observations(STEPS, ENVS)
    play(agent, memory, observed, ends(STEPS, ENVS))
    reset_mask, *_ = play(agent, memory, observed, ends(STEPS, ENVS))
    factor, gradients = torch.randn(STEPS * ENVS), []
    for length in (1, 4, STEPS):
        agent.memory.settings = replace(agent.memory.settings, sequence_length=length)
        (minibatch,) = agent.memory.minibatches([memory.state], reset_mask, 1, torch.Generator().manual_seed(0))
        agent.zero_grad()
        value = agent({"features": observed.flatten(0, 1)[minibatch.indices]}, minibatch).value
        (value * factor[minibatch.indices]).sum().backward()
        gradients.append({key: weight.grad for key, weight in agent.named_parameters() if weight.grad is not None})
    for other in gradients[1:]:
        torch.testing.assert_close(other, gradients[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("kind", ["gru", "trxl"])
def test_every_weight_of_an_agent_with_all_heads_gets_a_gradient(kind: str) -> None:
    ppo = {"reconstruction_coefficient": 0.1, "ground_truth_coefficient": 1.0}
    given = settings(kind, ppo=ppo, environment={"observation": "rgb"})
    torch.manual_seed(3)
    agent = Agent(given, {FRAME: (84, 84, 3), "vector_observation": (5,)}, BRANCHES, ground_truth=2)
    memory, draws = agent.initial_memory(ENVS), torch.Generator().manual_seed(4)
    frames = torch.randint(0, 256, (STEPS, ENVS, 84, 84, 3), dtype=torch.uint8, generator=draws)
    observation = {FRAME: frames, "vector_observation": torch.randn(STEPS, ENVS, 5, generator=draws)}
    segment = segment_of(agent, memory, observation, STEPS, ENVS)
    assert without_gradient(agent, segment, memory) == []


def test_a_weight_without_gradient_is_found() -> None:
    agent = make("trxl")
    agent.memory.blocks[0].fc.weight.requires_grad_(False)
    memory, observed = agent.initial_memory(ENVS), observations(STEPS, ENVS)
    segment = segment_of(agent, memory, {"features": observed}, STEPS, ENVS)
    assert without_gradient(agent, segment, memory) == ["memory.layers.0.fc.weight"]
