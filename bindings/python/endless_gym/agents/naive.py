"""The paper's naive baselines, which change what the agent observes instead of giving it a memory.

An observer turns the environments' observation into the agent's: as it is, with the last grey frames stacked, or with
the number of the step in the episode, encoded. What it keeps between two steps it keeps as the memories do; see
`memory`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from endless_gym.agents.encoders import FRAME, Observation, Shapes
from endless_gym.agents.settings import Settings

#: Entries of the encoded step, and steps that are told apart.
POSITION_WIDTH, POSITIONS = 16, 512
POSITION = "position"


@dataclass
class ObserverState:
    """What an observer keeps: tensors of n environments by name."""

    kept: dict[str, Tensor] = field(default_factory=dict)


class Observer(ABC):
    """See the module's text."""

    #: Shapes of the agent's observation.
    shapes: Shapes

    @abstractmethod
    def initial_state(self, num_envs: int) -> ObserverState:
        """The state of environments that have shown nothing."""

    @abstractmethod
    def observe(self, observation: Observation, state: ObserverState, first: Tensor) -> tuple[Observation, Any]:
        """The agent's observation, and what `remember` takes; `first` tells where an episode starts, bool (n,)."""

    def remember(self, state: ObserverState, news: dict[str, Tensor]) -> None:
        """Bring the state up to date."""
        state.kept = news


class AsItIs(Observer):
    """The environments' own observation."""

    def __init__(self, shapes: Shapes) -> None:
        self.shapes = shapes

    def initial_state(self, num_envs: int) -> ObserverState:
        del num_envs
        return ObserverState()

    def observe(self, observation: Observation, state: ObserverState, first: Tensor) -> tuple[Observation, Any]:
        del state, first
        return observation, {}


class Stacked(Observer):
    """The last `count` observations, the newest last; frames are grey. An episode's first observation fills the stack."""

    def __init__(self, shapes: Shapes, count: int, device: torch.device) -> None:
        self.count, self.device = count, device
        self.single = {key: (*shape[:-1], 1) if key == FRAME else shape for key, shape in shapes.items()}
        self.shapes = {key: (*shape[:-1], shape[-1] * count) for key, shape in self.single.items()}

    def initial_state(self, num_envs: int) -> ObserverState:
        return ObserverState(
            {
                key: torch.zeros(
                    (num_envs, *shape), dtype=torch.uint8 if key == FRAME else torch.float32, device=self.device
                )
                for key, shape in self.shapes.items()
            }
        )

    def observe(self, observation: Observation, state: ObserverState, first: Tensor) -> tuple[Observation, Any]:
        stacks = {}
        for key, now in observation.items():
            now = grey(now) if key == FRAME else now
            shifted = torch.cat([state.kept[key][..., self.single[key][-1] :], now], dim=-1)
            filled = now.repeat(*(1 for _ in now.shape[:-1]), self.count)
            stacks[key] = torch.where(first.view(-1, *(1 for _ in now.shape[1:])), filled, shifted)
        return stacks, stacks


class Positioned(Observer):
    """The observation, and the step's number in the episode as sines and cosines; they end with step 511."""

    def __init__(self, shapes: Shapes, device: torch.device) -> None:
        self.shapes = {**shapes, POSITION: (POSITION_WIDTH,)}
        self.device = device
        steps = torch.arange(POSITIONS, dtype=torch.float64).unsqueeze(1)
        angles = steps / 1e4 ** (torch.arange(0, POSITION_WIDTH, 2) / POSITION_WIDTH)
        # Sine and cosine of each frequency stand next to each other.
        self.table = torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1).float().to(device)

    def initial_state(self, num_envs: int) -> ObserverState:
        return ObserverState({"next": torch.zeros(num_envs, dtype=torch.long, device=self.device)})

    def observe(self, observation: Observation, state: ObserverState, first: Tensor) -> tuple[Observation, Any]:
        now = state.kept["next"].masked_fill(first, 0)
        encoded = self.table[now.clamp(max=POSITIONS - 1)]
        return {**observation, POSITION: encoded}, {"next": now + 1}


def grey(frames: Tensor) -> Tensor:
    """Luminance of frames uint8 (..., 3) as uint8 (..., 1), in whole numbers: 0.299 red, 0.587 green, 0.114 blue."""
    red, green, blue = frames.int().unbind(-1)
    return ((4899 * red + 9617 * green + 1868 * blue + 8192) >> 14).to(torch.uint8).unsqueeze(-1)


def make_observer(settings: Settings, shapes: Shapes, device: torch.device) -> Observer:
    """The observer of the agent that the settings name."""
    if settings.agent == "stack":
        return Stacked(shapes, settings.model.stack, device)
    if settings.agent == "position":
        return Positioned(shapes, device)
    return AsItIs(shapes)
