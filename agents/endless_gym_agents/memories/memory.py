"""The interface of the agent's memory, and the memoryless agent.

A memory is a module between the encoder and the heads. It computes its outputs in two ways:

* Acting: one step of n environments at a time. `step` reads the state and returns the output together with an update;
  `update_state` writes the update into the state. The reset mask marks the environments that start an episode at this step;
  earlier steps must not influence their output.
* Learning: many steps at once, with gradients. `minibatches` divides a segment of T steps in N environments into minibatches, and
  `forward` computes the outputs of one minibatch.

With the same weights, both give the same outputs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

import torch
from torch import Tensor, nn


@dataclass
class Minibatch:
    """M steps of this rank's segment, in the order that `Memory.forward` expects, and the minibatch's steps on all ranks.

    Attributes:
        indices: Index t * n + i of each step in the flattened segment of this rank's n environments, int64 (M,), on the memory's
            device. A rank may have no steps in a minibatch.
        everywhere: Index t * N + e of each step on all ranks in the flattened segments of all N environments, int64, in any
            order.
    """

    indices: Tensor
    everywhere: Tensor


class MemoryState:
    """The state of n environments between two steps; that of `NoMemory` is empty."""

    def state_dict(self) -> dict[str, Any]:
        """The state as tensors and numbers by name, for a checkpoint."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned; tensors are moved to this state's device."""


StateT = TypeVar("StateT", bound=MemoryState)
UpdateT = TypeVar("UpdateT")
MinibatchT = TypeVar("MinibatchT", bound=Minibatch)


class Minibatches(Generic[MinibatchT]):
    """Minibatches that are made on demand, so that only one at a time occupies memory."""

    def __init__(self, parts: Sequence[Tensor], make: Callable[[Tensor], MinibatchT]) -> None:
        """Make the minibatches; minibatch i is `make(parts[i])`."""
        self._parts, self._make = parts, make

    def __len__(self) -> int:
        return len(self._parts)

    def __iter__(self) -> Iterator[MinibatchT]:
        return map(self._make, self._parts)


class Memory(nn.Module, ABC, Generic[StateT, UpdateT, MinibatchT]):
    """A memory module.

    Type parameters: `StateT` is the state between two steps, `UpdateT` is what `step` passes to `update_state`, `MinibatchT` is
    the minibatch that `forward` takes.
    """

    #: Size of the output vectors.
    width: int
    #: Fully connected layer between the encoder and the memory; None if there is none.
    embedding: nn.Sequential | None

    def embed(self, x: Tensor) -> Tensor:
        """Apply `embedding` to encoded observations, float (n, encoder's width), for `step` and `forward`."""
        return x if self.embedding is None else self.embedding(x)

    @abstractmethod
    def initial_state(self, num_envs: int) -> StateT:
        """The state of `num_envs` environments before their first step."""

    @abstractmethod
    def begin_segment(self, state: StateT, steps: int) -> None:
        """Prepare the state for recording a segment of `steps` steps."""

    def refresh(self, dtype: torch.dtype) -> None:
        """Prepare the weights for `step`, to compute in `dtype`; called before the first step and after the weights change."""

    @abstractmethod
    def step(self, x: Tensor, state: StateT, reset_mask: Tensor | None) -> tuple[Tensor, UpdateT]:
        """Compute the output of one step without changing the state.

        Args:
            x: Encoded and embedded observations, float (n, input width).
            state: State of the same n environments.
            reset_mask: Whether the observation is the first of an episode, bool (n,); None if none is, as at most steps.

        Returns:
            The output, float (n, width), and the update for `update_state`.
        """

    @abstractmethod
    def update_state(self, state: StateT, update: UpdateT) -> None:
        """Write the update that `step` returned into the state."""

    @abstractmethod
    def minibatches(
        self,
        states: Sequence[StateT],
        reset_mask: Tensor,
        num_minibatches: int,
        generator: torch.Generator,
        own: range | None = None,
        epochs: int = 1,
    ) -> Minibatches[MinibatchT]:
        """Shuffle a recorded segment and divide it into minibatches; every rank gets the same number.

        Args:
            states: The state of each group of environments after the segment, in the order of their columns in the segment.
            reset_mask: Whether each step is the first of an episode, bool (T, N), with the columns of all ranks.
            num_minibatches: Number of minibatches per epoch; there are fewer if the segment has fewer sequences.
            generator: Generator of the shuffle, on the CPU; in the same state on every rank.
            own: The columns of this rank's environments; `None` for all.
            epochs: How often the segment is shuffled and divided; the epochs' minibatches follow one another.
        """

    @abstractmethod
    def forward(self, x: Tensor, minibatch: MinibatchT) -> Tensor:
        """Compute the outputs of a minibatch, with gradients.

        Args:
            x: Encoded and embedded observations of the steps `minibatch.indices`, float (M, input width).
            minibatch: A minibatch that `minibatches` returned.

        Returns:
            The outputs, float (M, width).
        """


#: A memory of any kind. The settings choose the memory at run time, so its type parameters are not known statically.
AnyMemory: TypeAlias = Memory[Any, Any, Any]


def shuffled(items: int, num_parts: int, epochs: int, generator: torch.Generator) -> list[Tensor]:
    """Shuffle items and divide them into parts of equal size, for each epoch in turn.

    Args:
        items: Number of items.
        num_parts: Number of parts of an epoch; the sizes of parts differ by 1 if they do not divide the items.
        epochs: Number of epochs.
        generator: Generator of the shuffle, on the CPU.

    Returns:
        The indices of the items in each part, int64 on the CPU. No part is empty: with too few items there are fewer parts.
    """
    permutations = (torch.randperm(items, generator=generator) for _ in range(epochs))
    return [part for order in permutations for part in order.tensor_split(min(num_parts, items))]


def is_own(envs: Tensor, own: range) -> Tensor:
    """Whether environments belong to a rank, bool of the shape of `envs`."""
    return (envs >= own.start) & (envs < own.stop)


class NoMemory(Memory[MemoryState, None, Minibatch]):
    """The identity: the output is the encoding of the current observation."""

    def __init__(self, input_width: int, device: torch.device) -> None:
        """Make the memory for encoded observations of size `input_width`; `device` is the device of the minibatches."""
        super().__init__()
        self.width, self.embedding = input_width, None
        self.device = device

    def initial_state(self, num_envs: int) -> MemoryState:
        return MemoryState()

    def begin_segment(self, state: MemoryState, steps: int) -> None:
        pass

    def step(self, x: Tensor, state: MemoryState, reset_mask: Tensor | None) -> tuple[Tensor, None]:
        return x, None

    def update_state(self, state: MemoryState, update: None) -> None:
        pass

    def minibatches(
        self,
        states: Sequence[MemoryState],
        reset_mask: Tensor,
        num_minibatches: int,
        generator: torch.Generator,
        own: range | None = None,
        epochs: int = 1,
    ) -> Minibatches[Minibatch]:
        envs = reset_mask.shape[1]
        own = range(envs) if own is None else own

        def minibatch(everywhere: Tensor) -> Minibatch:
            indices = everywhere
            if len(own) < envs:
                here = everywhere[is_own(everywhere % envs, own)]
                indices = here // envs * len(own) + here % envs - own.start
            return Minibatch(indices.to(self.device), everywhere.to(self.device))

        return Minibatches(shuffled(reset_mask.numel(), num_minibatches, epochs, generator), minibatch)

    def forward(self, x: Tensor, minibatch: Minibatch) -> Tensor:
        return x
