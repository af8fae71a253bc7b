"""Equal frames are encoded once, while acting and while learning, with the same results as encoding each of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from agents_helpers import changed, collecting, settings
from torch import Tensor, nn

from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.agent.encoders import FRAME
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.memories.memory import MemoryState
from endless_gym_agents.settings import Settings
from endless_gym_agents.training import repeats
from endless_gym_agents.training.ppo import minibatch_loss
from endless_gym_agents.training.repeats import EmbeddedFrames
from endless_gym_agents.training.rollout import Segment

ENVS, STEPS = 4, 12


def small(agent: str = "gru", observation: str = "rgb", **ppo: float) -> Settings:
    environment = {"num_envs": ENVS, "groups": 2, "num_threads": 1, "observation": observation}
    given = settings(agent, env="MysteryPath-Grid-v0", threads=1, environment=environment)
    return changed(given, ppo={"steps": STEPS, "minibatches": 2, **ppo})


def collected(given: Settings, segments: int = 1) -> tuple[Agent, Segment, list[MemoryState], int]:
    """The last of some segments, and the number of frames that were encoded for it."""
    with collecting(given) as collector:
        agent = collector.agent
        for _ in range(segments):
            with encoded_frames(agent) as counts:
                segment, _ = collector.collect(Clock())
        return agent, segment, [memory.state for memory in collector.memories], sum(counts)


@contextmanager
def encoded_frames(agent: Agent) -> Iterator[list[int]]:
    """The number of frames in each call of the encoder."""
    counts: list[int] = []

    def count(_: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        counts.append(len(inputs[0]))

    assert agent.encoder.frames is not None
    hook = agent.encoder.frames.register_forward_pre_hook(count)
    yield counts
    hook.remove()


def first_occurrences(frames: Tensor) -> list[int]:
    seen: dict[bytes, int] = {}
    return [seen.setdefault(frame.numpy().tobytes(), index) for index, frame in enumerate(frames)]


def frames_of(numbers: list[int]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.uint8).view(-1, 1, 1, 1).expand(-1, 2, 3, 1).contiguous()


def embeddings(frames: Tensor) -> Tensor:
    return frames.flatten(1).float() + 0.5


def test_frames_with_equal_hashes_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only frames that equal the first frame with their hash are recognised."""
    monkeypatch.setattr(repeats, "hash", lambda _: 0, raising=False)
    frames = frames_of([5, 6, 5, 5, 7, 6, 5, 8])
    embedded, asked = EmbeddedFrames(frames), []

    def embed(new: Tensor) -> Tensor:
        asked.append(new[:, 0, 0, 0].tolist())
        return embeddings(new)

    for start in range(0, 8, 2):
        torch.testing.assert_close(
            embedded.embed(range(start, start + 2), embed), embeddings(frames)[start : start + 2]
        )
    assert asked == [[5, 6], [7, 6], [8]]
    assert embedded.first.tolist() == [0, 1, 0, 0, 4, 5, 0, 7]


@pytest.mark.parametrize("agent", ["none", "gru", "lstm", "trxl"])
def test_segment_equals_one_whose_frames_are_all_encoded(agent: str) -> None:
    made, segment, states, encoded = collected(small(agent), segments=2)
    flat = segment.flat()
    frames = flat.observation[FRAME]
    expected = first_occurrences(frames)
    assert flat.first_occurrence is not None
    assert flat.first_occurrence.tolist() == expected
    different = len(set(expected))
    assert 1 < different < len(frames) / 2
    # One more for each environment: the value after the last step.
    assert encoded == different + ENVS
    # Acting equals learning with each frame encoded separately.
    for minibatch in made.memory.minibatches(states, segment.reset_mask, 2, torch.Generator().manual_seed(0)):
        with torch.no_grad():
            output = made({FRAME: frames[minibatch.indices]}, minibatch)
        actions = flat.action[minibatch.indices]
        torch.testing.assert_close(output.value, flat.value[minibatch.indices], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(output.log_prob(actions), flat.log_prob[minibatch.indices], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("agent", ["gru", "none", "lstm", "trxl"])
def test_losses_and_gradients_equal_those_of_encoding_each_frame(agent: str) -> None:
    given = small(agent, reconstruction_coefficient=0.1)
    made, segment, states, _ = collected(given)
    flat, returns = segment.flat(), torch.randn(STEPS * ENVS)
    plain = replace(flat, first_occurrence=None)
    for minibatch in made.memory.minibatches(states, segment.reset_mask, 2, torch.Generator().manual_seed(0)):
        found = []
        for part in (flat, plain):
            made.zero_grad()
            with encoded_frames(made) as counts:
                loss, parts = minibatch_loss(made, part, minibatch, returns, returns, given.ppo, 0.01)
            loss.backward()
            found.append((sum(counts), parts, {name: p.grad for name, p in made.named_parameters()}))
        (few, parts, gradients), (all_, plain_parts, plain_gradients) = found
        assert few == len(set(first_occurrences(flat.observation[FRAME][minibatch.indices])))
        assert few < all_ == len(minibatch.indices)
        for name, value in plain_parts.items():
            torch.testing.assert_close(parts[name], value, rtol=1e-5, atol=1e-5)
        for name, gradient in plain_gradients.items():
            if gradient is not None:
                torch.testing.assert_close(gradients[name], gradient, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("given", [small(observation="features"), small("stack")])
def test_other_observations_are_encoded_one_by_one(given: Settings) -> None:
    """Features and stacked frames."""
    with collecting(given) as collector:
        segment, _ = collector.collect(Clock())
    assert segment.first_occurrence is None
    observation, rows = segment.flat().distinct(torch.tensor([5, 3]))
    assert rows is None
    for key, part in observation.items():
        assert torch.equal(part, segment.flat().observation[key][[5, 3]])
