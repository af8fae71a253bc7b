"""Acting with tensors that stay where they are, as CUDA graphs need it.

A graph repeats operations on the same addresses with the same numbers. So what a step reads and writes has to be in tensors that
outlive the step, and what differs between steps, the number of the step in its segment, has to be a number on the device.

`FixedMemory` computes what `Memory.step` and `Memory.update_state` compute, in this way. Its tensors are those of the memory's
state, and what the state keeps on the host goes on as well: at the end of each step, the state is as `Memory.update_state` leaves
it. So a step of either kind can follow a step of the other.
"""

from __future__ import annotations

from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from endless_gym_agents.acting import refill
from endless_gym_agents.memory import AnyMemory, MemoryState
from endless_gym_agents.recurrent import RecurrentMemory, RecurrentState
from endless_gym_agents.transformer import TransformerMemory, TransformerState, TransformerUpdate, fused
from endless_gym_agents.transformer_cache import RingCache

MemoryT = TypeVar("MemoryT", bound=AnyMemory)
StateT = TypeVar("StateT", bound=MemoryState)


class FixedMemory(Generic[MemoryT, StateT]):
    """A memory and its state of n environments during segments of constant length. This class is for a memory without state."""

    def __init__(self, memory: MemoryT, state: StateT, steps: int) -> None:
        """Allocate the tensors.

        Args:
            memory: The memory.
            state: The state of the environments, after `Memory.begin_segment`.
            steps: Steps of a segment.
        """
        self.memory, self.state, self.steps = memory, state, steps

    def load(self) -> None:
        """Move the state into the fixed tensors; called after each `Memory.begin_segment`."""

    def step(self, x: Tensor, reset_mask: Tensor, step: Tensor) -> tuple[Tensor, Any]:
        """As `Memory.step`; `step` is the number of the step in its segment, int64 (1,). On the device only."""
        del step
        return self.memory.step(x, self.state, reset_mask)

    def update(self, update: Any, step: Tensor) -> None:
        """As `Memory.update_state`, as far as it concerns the device; arguments as for `step`."""

    def advance(self) -> None:
        """What `Memory.update_state` does on the host; called before each `update`, or its repetition."""


class FixedRecurrent(FixedMemory[RecurrentMemory, RecurrentState]):
    """GRU and LSTM."""

    def __init__(self, memory: RecurrentMemory, state: RecurrentState, steps: int) -> None:
        super().__init__(memory, state, steps)
        self._hidden = torch.empty_like(state.hidden)

    def load(self) -> None:
        if self.state.hidden is not self._hidden:
            self._hidden.copy_(self.state.hidden)
            self.state.hidden = self._hidden

    def update(self, update: Tensor, step: Tensor) -> None:
        del step
        self._hidden.copy_(update)

    def advance(self) -> None:
        self.memory.store(self.state, copy=True)


class FixedTransformer(FixedMemory[TransformerMemory, TransformerState]):
    """Transformer-XL and GTrXL.

    In step t of a segment, the current slot of the KV cache is `(window - 1 + t) % window`, and the column of the newest token
    `window - 1 + t`.
    """

    def __init__(self, memory: TransformerMemory, state: TransformerState, steps: int) -> None:
        super().__init__(memory, state, steps)
        self._inputs, self._position = torch.zeros_like(state.inputs), torch.zeros_like(state.position)
        self._next_position = torch.empty_like(state.next_position)
        self._cache: RingCache | None = None
        self._blocks, self._fusion = memory.acting_blocks, memory.acting_fusion
        self._slots = torch.arange(memory.past + 1, device=memory.device)

    def load(self) -> None:
        state, past = self.state, self.memory.past
        if state.inputs is not self._inputs:
            self._inputs[:, :, :past].copy_(state.inputs[:, :, :past])
            self._position[:, :past].copy_(state.position[:, :past])
            state.inputs, state.position = self._inputs, self._position
        if state.next_position is not self._next_position:
            self._next_position.copy_(state.next_position)
            state.next_position = self._next_position
        for block, newer in zip(self._blocks, self.memory.acting_blocks, strict=True):
            block.copy_(newer)
        if self._fusion is not None and self.memory.acting_fusion is not None:
            refill(self._fusion, self.memory.acting_fusion)
        cache = self.memory.cache(state)
        if self._cache is None:
            self._cache = cache
        elif cache is not self._cache:
            self._cache.copy_(cache)
        state.cache = self._cache

    def step(self, x: Tensor, reset_mask: Tensor, step: Tensor) -> tuple[Tensor, TransformerUpdate]:
        memory, cache = self.memory, self._cache
        assert cache is not None
        position = self._next_position.masked_fill(reset_mask, 0)
        if self._fusion is not None:
            # The newest column; this step's is the next one.
            previous = self._inputs[-1].index_select(1, step + (memory.past - 1)).squeeze(1)
            x = fused(x, previous, reset_mask, self._fusion)
        chosen = self._slots + (cache.slots - self._slot(step))
        ages = memory.ages.index_select(0, chosen)
        distances = None
        if cache.distances is not None:
            distances = [encoded.index_select(1, chosen) for encoded in cache.distances]
        slots = cache.keys_and_values(0, cache.slots)
        return memory.step_with(self._blocks, x, position, reset_mask.unsqueeze(-1), ages, slots, distances)

    def update(self, update: TransformerUpdate, step: Tensor) -> None:
        assert self._cache is not None
        column, inputs = step + self.memory.past, torch.stack(update.inputs).float()
        self._inputs.index_copy_(2, column, inputs.unsqueeze(2))
        self._position.index_copy_(1, column, update.position.unsqueeze(1))
        self._next_position.copy_(update.position + 1)
        self._cache.append_at(self._slot(step), self.memory.encoded(inputs, update.position))

    def advance(self) -> None:
        assert self._cache is not None
        self._cache.advance()
        self.state.fill += 1

    def _slot(self, step: Tensor) -> Tensor:
        """The current slot of the KV cache, int64 (1,)."""
        return (step + self.memory.past) % (self.memory.past + 1)


def fixed_memory(memory: AnyMemory, state: MemoryState, steps: int) -> FixedMemory[Any, Any]:
    """The `FixedMemory` of a memory of any kind; arguments as there."""
    if isinstance(memory, RecurrentMemory) and isinstance(state, RecurrentState):
        return FixedRecurrent(memory, state, steps)
    if isinstance(memory, TransformerMemory) and isinstance(state, TransformerState):
        return FixedTransformer(memory, state, steps)
    return FixedMemory(memory, state, steps)
