"""Recurrent memories, trained with truncated backpropagation through time.

For learning, a segment is cut after every `sequence_length` steps. A sequence starts from the state that was stored while acting
(there is no burn-in), and gradients stop at its start. A minibatch is a rectangle of L steps of S sequences. Episodes that start
inside a sequence are marked by a mask of resets, at which the layers discard the state; so all minibatches have the same shape.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.gated import GRU, LSTM
from endless_gym_agents.memories.layers import orthogonal
from endless_gym_agents.memories.memory import Memory, MemoryState, Minibatch, Minibatches, is_own, shuffled
from endless_gym_agents.memories.sequence_model import Cell, SequenceModel, Stack, State, restarted
from endless_gym_agents.settings import Recurrence


class RecurrentState(MemoryState):
    """The state, and the stored states from which the sequences of the current segment start.

    Attributes:
        tree: The state of n environments; see `SequenceModel`.
        stored: The states before steps 0, L, 2L, ... of the segment, for sequences of length L.
        time: Steps since the segment began.
        steps: Length of the segment in steps; 0 if no segment is recorded.
    """

    def __init__(self, tree: State) -> None:
        """Make a memory with the given state, outside a segment."""
        self.tree = tree
        self.stored: list[State] = []
        self.time = self.steps = 0

    def state_dict(self) -> dict[str, Any]:
        return dict(self.tree)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.tree = {name: state_dict[name].to(part.device) for name, part in self.tree.items()}


@dataclass
class RecurrentMinibatch(Minibatch):
    """S sequences of L steps, in the order step 0 of all sequences, step 1 of all sequences, and so on.

    Attributes:
        initial: State before the first step of each sequence, float32 (S, ...) each.
        resets: Whether each step is the first of an episode, bool (L, S).
    """

    initial: State
    resets: Tensor


class RecurrentMemory(Memory[RecurrentState, State, RecurrentMinibatch]):
    """An optional fully connected layer, followed by recurrent layers. The update that `step` returns is the next state."""

    def __init__(
        self,
        kind: str | type[nn.Module],
        input_width: int,
        settings: Recurrence,
        device: torch.device,
        options: dict[str, Any] | None = None,
    ) -> None:
        """Make the layers.

        Args:
            kind: `gru`, `lstm`, or a class of layers: one derived from `SequenceModel`, or one as `Cell` describes.
            input_width: Size of the encoded observations.
            settings: Number and size of the layers, and the length of a sequence.
            device: Device of the states.
            options: Further arguments of the class.

        Raises:
            ValueError: The class does not take these arguments, or the settings do not fit the layers.
        """
        super().__init__()
        self.settings, self.device = settings, device
        self.embedding = None
        if settings.embedding:
            self.embedding = nn.Sequential(orthogonal(nn.Linear(input_width, settings.hidden_size)), nn.ReLU())
        inputs = settings.hidden_size if settings.embedding else input_width
        # Files of agents have the names of these attributes.
        if isinstance(kind, str):
            sizes = inputs, settings.hidden_size, settings.layers
            self.recurrent: SequenceModel = LSTM(*sizes, settings.forget_bias) if kind == "lstm" else GRU(*sizes)
        else:
            self.cell = _layers(kind, inputs, settings, options or {})
        self.width = self.model.width
        if settings.residual and inputs != self.width:
            raise ValueError(
                f"--recurrence.residual needs inputs of the hidden size {self.width}, got an input width of {inputs}; "
                "add --recurrence.embedding"
            )
        for layer in self.modules():
            if isinstance(layer, SequenceModel):
                layer.native = settings.kernels == "auto"

    @property
    def model(self) -> SequenceModel:
        """The recurrent layers."""
        return self.recurrent if "recurrent" in self._modules else self.cell

    def initial_state(self, num_envs: int) -> RecurrentState:
        shapes = self.model.state_shapes.items()
        return RecurrentState({name: torch.zeros(num_envs, *shape, device=self.device) for name, shape in shapes})

    def begin_segment(self, state: RecurrentState, steps: int) -> None:
        state.stored, state.time, state.steps = [], 0, steps

    def step(self, x: Tensor, state: RecurrentState, reset_mask: Tensor | None) -> tuple[Tensor, State]:
        x = x.float()
        with self._float32():
            y, after = self.model.step(x, state.tree if reset_mask is None else restarted(state.tree, reset_mask))
        return y + x if self.settings.residual else y, after

    def update_state(self, state: RecurrentState, update: State) -> None:
        if state.time < state.steps and state.time % self.settings.sequence_length == 0:
            # States are replaced and never written in place, so the stored ones stay valid without a copy.
            state.stored.append(state.tree)
        state.time += 1
        state.tree = update

    def minibatches(
        self,
        states: Sequence[RecurrentState],
        reset_mask: Tensor,
        num_minibatches: int,
        generator: torch.Generator,
        own: range | None = None,
        epochs: int = 1,
    ) -> Minibatches[RecurrentMinibatch]:
        steps, envs = reset_mask.shape
        own = range(envs) if own is None else own
        length = min(self.settings.sequence_length, steps)
        resets, columns = reset_mask[:, own.start : own.stop].flatten().to(self.device), len(own)
        # The states before each sequence; sequences are numbered by step, then by environment.
        stored = {
            name: torch.cat([torch.stack([tree[name] for tree in state.stored]) for state in states], dim=1).flatten(
                0, 1
            )
            for name in self.model.state_shapes
        }

        def indices(sequences: Tensor, envs: int) -> Tensor:
            """Index of each step in the flattened segment of `envs` environments, (length, S)."""
            first = sequences + sequences // envs * ((length - 1) * envs)
            return first + torch.arange(0, length * envs, envs, device=first.device).unsqueeze(1)

        def minibatch(chosen: Tensor) -> RecurrentMinibatch:
            everywhere = None
            if columns < envs:
                everywhere = indices(chosen.to(self.device), envs).flatten()
                chosen = chosen[is_own(chosen % envs, own)]
                chosen = chosen // envs * columns + chosen % envs - own.start
            chosen = chosen.to(self.device)
            rows = indices(chosen, columns)
            initial = {name: part.index_select(0, chosen) for name, part in stored.items()}
            flat = rows.flatten()
            return RecurrentMinibatch(
                flat, flat if everywhere is None else everywhere, initial, resets[flat].view_as(rows)
            )

        return Minibatches(shuffled(steps // length * envs, num_minibatches, epochs, generator), minibatch)

    def forward(self, x: Tensor, minibatch: RecurrentMinibatch) -> Tensor:
        x = x.float()
        with self._float32():
            y, _ = self.model.sequence(x.unflatten(0, minibatch.resets.shape), minibatch.initial, minibatch.resets)
        y = y.flatten(0, 1)
        return y + x if self.settings.residual else y

    def _float32(self) -> contextlib.AbstractContextManager[Any]:
        """Disable autocast: recurrent layers compute in float32."""
        if not torch.is_autocast_enabled(self.device.type):
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, enabled=False)


def _layers(kind: type[nn.Module], inputs: int, settings: Recurrence, options: dict[str, Any]) -> SequenceModel:
    """The layers of a class; see `RecurrentMemory`."""
    if settings.residual or (settings.layers != 1 and not issubclass(kind, SequenceModel)):
        raise ValueError(
            "--recurrence.residual is for the agents gru and lstm, and --recurrence.layers for these and classes derived from "
            f"SequenceModel; {kind.__name__} determines them itself, by --agent-option"
        )
    try:
        if issubclass(kind, SequenceModel):
            return Stack(kind, inputs, settings.hidden_size, settings.layers, options)
        return Cell(kind(inputs, settings.hidden_size, **options), settings.hidden_size)
    except TypeError as error:
        raise ValueError(
            f"{kind.__name__} cannot be made of an input width, a hidden size and --agent-option: {error}"
        ) from error
