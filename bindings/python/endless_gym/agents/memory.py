"""What all memories have in common, and the agent without one.

A memory is a module between encoder and heads. It meets the same steps twice:

* While the agent acts, one step of `n` environments at a time: `step` reads a `State`, which `remember` then brings up to date.
  `first` tells which environments have just started an episode; nothing from before may reach them.
* While it learns, many steps at once, with gradients: `plan` divides a segment of T steps in N environments into minibatches, and
  `forward` computes the outputs of one of them.

Both give the same outputs for the same weights.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


@dataclass
class Plan:
    """One minibatch.

    Attributes:
        steps: Which steps of the segment it has, in the order in which `forward` takes them: t * N + n, int64 (M,).
    """

    steps: Tensor


class State(ABC):
    """What a memory keeps of n environments between two steps."""

    @abstractmethod
    def tensors(self) -> dict[str, Any]:
        """All of it, for a checkpoint."""

    @abstractmethod
    def load(self, tensors: dict[str, Any]) -> None:
        """The reverse of `tensors`."""


class Memory(nn.Module, ABC):
    """A module that remembers; see the module's text."""

    #: Size of the output vectors.
    width: int

    @abstractmethod
    def initial_state(self, num_envs: int) -> State:
        """The state of environments that have seen nothing."""

    @abstractmethod
    def begin_segment(self, state: State, steps: int) -> None:
        """Prepare for recording `steps` steps to learn from; weights may have changed since the last one."""

    @abstractmethod
    def step(self, x: Tensor, state: State, first: Tensor) -> tuple[Tensor, Any]:
        """One step: what is remembered of it is only kept with `remember`.

        Args:
            x: Encoded observations, (n, input width).
            state: Of the same environments; it is not changed.
            first: Whether this is the first step of an episode, bool (n,).

        Returns:
            The output (n, width), and what `remember` takes.
        """

    @abstractmethod
    def remember(self, state: State, news: Any) -> None:
        """Bring the state up to date."""

    @abstractmethod
    def plan(
        self, states: Sequence[State], first: Tensor, minibatches: int, generator: torch.Generator
    ) -> Sequence[Plan]:
        """Divide a recorded segment, at random.

        Args:
            states: One for each group of environments, after the segment.
            first: Which steps are the first of an episode, bool (T, N) on the CPU.
            minibatches: How many.
            generator: Of the random division, on the CPU.
        """

    @abstractmethod
    def forward(self, x: Tensor, plan: Any) -> Tensor:
        """The outputs of a minibatch.

        Args:
            x: The encoded observations of `plan.steps`, (M, input width).
            plan: From `plan`.

        Returns:
            (M, width)
        """


def shares(sizes: Sequence[int], minibatches: int, generator: torch.Generator) -> list[Tensor]:
    """Shuffle items and divide them into `minibatches` of about the same total size.

    Returns:
        The items' numbers in each minibatch; none is empty, so that there are fewer if there are too few items.
    """
    order = torch.randperm(len(sizes), generator=generator)
    # An item belongs to the share in which its middle lies, along the shuffled row of all.
    size = torch.tensor(sizes, dtype=torch.float64)[order]
    middle = size.cumsum(0) - size / 2
    share = (middle * minibatches / size.sum()).long()
    return [order[share == number] for number in range(minibatches) if bool((share == number).any())]


class NoState(State):
    """Nothing."""

    def tensors(self) -> dict[str, Any]:
        return {}

    def load(self, tensors: dict[str, Any]) -> None:
        del tensors


class NoMemory(Memory):
    """The current observation is all there is: its encoding is passed on as it is."""

    def __init__(self, input_width: int, device: torch.device) -> None:
        super().__init__()
        self.width = input_width
        self.device = device

    def initial_state(self, num_envs: int) -> NoState:
        del num_envs
        return NoState()

    def begin_segment(self, state: State, steps: int) -> None:
        del state, steps

    def step(self, x: Tensor, state: State, first: Tensor) -> tuple[Tensor, None]:
        del state, first
        return x, None

    def remember(self, state: State, news: Any) -> None:
        del state, news

    def plan(
        self, states: Sequence[State], first: Tensor, minibatches: int, generator: torch.Generator
    ) -> Sequence[Plan]:
        del states
        order = torch.randperm(first.numel(), generator=generator)
        return [Plan(steps.to(self.device)) for steps in order.chunk(minibatches)]

    def forward(self, x: Tensor, plan: Plan) -> Tensor:
        del plan
        return x
