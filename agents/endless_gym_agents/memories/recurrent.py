"""Recurrent memories: GRU, LSTM, and the classes of other layers, trained with truncated backpropagation through time.

For learning, a segment is cut into sequences after every `sequence_length` steps, and, except for sequence models, at the start
of each episode. A sequence starts from the hidden state that was stored while acting (there is no burn-in), and gradients stop
at its start. Sequences are packed (`PackedSequence`): there is no padding, and the number of sequential steps is the length of
the longest sequence. Learning uses the layers of `recurrence` on the CPU, and PyTorch's elsewhere.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence

from endless_gym_agents.memories.kernels import kernels_are_faster
from endless_gym_agents.memories.layers import orthogonal
from endless_gym_agents.memories.memory import Memory, MemoryState, Minibatch, Minibatches, is_own, shuffled
from endless_gym_agents.memories.recurrence import packed_layers
from endless_gym_agents.memories.sequence_model import SequenceModel, Stack, State, restarted
from endless_gym_agents.settings import Recurrence


class RecurrentState(MemoryState):
    """The hidden state, and the stored states from which the sequences of the current segment start.

    Attributes:
        hidden: float32 (parts, layers, n, hidden size). A GRU has one part, an LSTM two: hidden state and cell state.
        stored: The hidden states before steps 0, L, 2L, ... of the segment, for sequences of length L; shaped as `hidden`.
        time: Steps since the segment began.
        steps: Length of the segment in steps; 0 if no segment is recorded.
    """

    def __init__(self, hidden: Tensor) -> None:
        """Make a state with the given hidden state, outside a segment."""
        self.hidden = hidden
        self.stored: list[Tensor] = []
        self.time = self.steps = 0

    def state_dict(self) -> dict[str, Any]:
        return {"hidden": self.hidden}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.hidden = state_dict["hidden"].to(self.hidden.device)


@dataclass
class RecurrentMinibatch(Minibatch):
    """Packed sequences, in decreasing order of length.

    Attributes:
        batch_sizes: Number of sequences that have a step t, int64 (longest,), on the CPU; as in `PackedSequence`.
        initial_hidden: States before the first steps of the sequences, float32 (parts, layers, sequences, hidden size).
        resets: Whether each of the M steps is the first of an episode, bool (M,), on the CPU.
    """

    batch_sizes: Tensor
    initial_hidden: Tensor
    resets: Tensor


class RecurrentMemory(Memory[RecurrentState, Tensor, RecurrentMinibatch]):
    """An optional fully connected layer, followed by GRU or LSTM layers.

    The update that `step` returns is the next hidden state, float (parts, layers, n, hidden size).
    """

    #: Whether a sequence ends with its episode.
    cut_at_episodes = True

    def __init__(self, kind: str, input_width: int, settings: Recurrence, device: torch.device) -> None:
        """Make the layers with orthogonal weights and zero biases.

        Args:
            kind: The kind of the recurrent layers, `gru` or `lstm`.
            input_width: Size of the encoded observations.
            settings: Number and size of the layers, and the length of a sequence.
            device: Device of the states.

        Raises:
            ValueError: A residual connection without embedding whose inputs do not have the hidden size.
        """
        super().__init__()
        self.settings = settings
        self.width = settings.hidden_size
        self.parts = 2 if kind == "lstm" else 1
        self.device = device
        if settings.residual and not settings.embedding and input_width != self.width:
            raise ValueError(
                f"--recurrence.residual needs inputs of the hidden size {self.width}, got an input width of {input_width}; "
                "add --recurrence.embedding"
            )
        self.embedding = _embedding(input_width, settings)
        layers = nn.LSTM if kind == "lstm" else nn.GRU
        self.recurrent = layers(self.width if settings.embedding else input_width, self.width, settings.layers)
        for name, parameter in self.recurrent.named_parameters():
            if "weight" in name:
                nn.init.orthogonal_(parameter, 2**0.5)
            else:
                nn.init.zeros_(parameter)
        self._cells: Sequence[Sequence[Tensor]] = []

    def initial_state(self, num_envs: int) -> RecurrentState:
        shape = (self.parts, self.settings.layers, num_envs, self.width)
        return RecurrentState(torch.zeros(shape, device=self.device))

    def begin_segment(self, state: RecurrentState, steps: int) -> None:
        state.stored, state.time, state.steps = [], 0, steps

    def refresh(self, dtype: torch.dtype) -> None:
        # The recurrent layers compute in float32, whatever `dtype` is.
        self._cells = self.recurrent.all_weights

    def step(self, x: Tensor, state: RecurrentState, reset_mask: Tensor | None) -> tuple[Tensor, Tensor]:
        hidden = state.hidden
        if reset_mask is not None:
            hidden = hidden.masked_fill(reset_mask.unsqueeze(-1), 0.0)
        x = x.float()
        y = x
        after: list[tuple[Tensor, ...]] = []
        with self._float32():
            for cell, *parts in zip(self._cells, *(part.unbind() for part in hidden.unbind()), strict=True):
                if self.parts == 1:
                    y = torch.gru_cell(y, parts[0], *cell)
                    after.append((y,))
                else:
                    after.append(torch.lstm_cell(y, parts, *cell))
                    y = after[-1][0]
        if len(after) == 1 and self.parts == 1:
            next_hidden = y.view(1, 1, *y.shape)
        else:
            next_hidden = torch.stack([torch.stack(part) for part in zip(*after, strict=True)])
        return y + x if self.settings.residual else y, next_hidden

    def update_state(self, state: RecurrentState, update: Tensor) -> None:
        if state.time < state.steps and state.time % self.settings.sequence_length == 0:
            # Hidden states are replaced and never written in place, so the stored ones stay valid without a copy.
            state.stored.append(state.hidden)
        state.time += 1
        state.hidden = update

    def minibatches(
        self,
        states: Sequence[RecurrentState],
        reset_mask: Tensor,
        num_minibatches: int,
        generator: torch.Generator,
        own: range | None = None,
        epochs: int = 1,
    ) -> Minibatches[RecurrentMinibatch]:
        length, (steps, envs) = self.settings.sequence_length, reset_mask.shape
        own = range(envs) if own is None else own
        stored = torch.stack(
            [torch.cat([state.stored[cut] for state in states], dim=2) for cut in range(-(-steps // length))]
        )  # (cuts, parts, layers, own environments, hidden size)
        # A sequence starts every `length` steps and with each episode. Sequences are ordered by environment, then by step.
        starts = reset_mask.t() & self.cut_at_episodes
        starts[:, ::length] = True
        env, time = starts.nonzero(as_tuple=True)
        start = env * steps + time
        lengths = torch.cat([start[1:], torch.tensor([envs * steps])]) - start

        def minibatch(chosen: Tensor) -> RecurrentMinibatch:
            everywhere = None
            if len(own) < envs:
                everywhere, _ = packed(time[chosen], env[chosen], lengths[chosen], envs)
                everywhere, chosen = everywhere.to(self.device), chosen[is_own(env[chosen], own)]
            chosen = chosen[lengths[chosen].argsort(descending=True, stable=True)]
            e, t, sizes = env[chosen], time[chosen], lengths[chosen]
            n = e - own.start if own.start else e
            indices, batch_sizes = packed(t, n, sizes, len(own))
            resets = reset_mask[:, own.start : own.stop].flatten()[indices]
            indices = indices.to(self.device)
            hidden = stored[(t // length).to(stored.device), :, :, n.to(stored.device)]
            starts_episode = reset_mask[t, e].to(stored.device)[:, None]
            hidden = hidden.permute(1, 2, 0, 3).masked_fill(starts_episode, 0.0).contiguous()
            everywhere = indices if everywhere is None else everywhere
            return RecurrentMinibatch(indices, everywhere, batch_sizes, hidden, resets)

        return Minibatches(shuffled(lengths.tolist(), num_minibatches, epochs, generator), minibatch)

    def forward(self, x: Tensor, minibatch: RecurrentMinibatch) -> Tensor:
        x = x.float()
        with self._float32():
            if x.device.type == "cpu":
                sizes, weights = minibatch.batch_sizes.tolist(), self.recurrent.all_weights
                native = self.settings.kernels == "auto" and kernels_are_faster(self.width)
                y = packed_layers(x, weights, minibatch.initial_hidden, sizes, native)
            else:
                hidden = minibatch.initial_hidden
                sequences = PackedSequence(x, minibatch.batch_sizes)
                output, _ = self.recurrent(sequences, hidden[0] if self.parts == 1 else tuple(hidden))
                y = output.data
        return y + x if self.settings.residual else y

    def _float32(self) -> contextlib.AbstractContextManager[Any]:
        """Disable autocast, which would run cuDNN's recurrent layers in float16 where bfloat16 is requested."""
        if not torch.is_autocast_enabled(self.device.type):
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, enabled=False)


class CellMemory(RecurrentMemory):
    """A recurrent memory around a cell of your own: a `torch.nn.Module` that computes one step.

    The cell is made by `Class(input_width, hidden_size, **options)`, with `--recurrence.hidden-size` and `--agent-option`. Its
    `forward(x, state)` takes inputs float (n, input_width) and states float (n, state_width), and returns the outputs
    (n, width) and the next states. Its attributes `width` and `state_width` are the hidden size by default. An episode starts
    with the state 0.

    Gradients flow back through as many steps as `--recurrence.sequence-length` says.
    """

    def __init__(
        self,
        make: type[nn.Module],
        input_width: int,
        settings: Recurrence,
        options: dict[str, Any],
        device: torch.device,
    ) -> None:
        """Make the memory.

        Args:
            make: The class of the cell.
            input_width: Size of the encoded observations.
            settings: Hidden size, embedding and sequence length.
            options: Further arguments of the class.
            device: Device of the states.

        Raises:
            ValueError: The class does not take these arguments, or the settings are those of other layers.
        """
        nn.Module.__init__(self)
        if settings.layers != 1 or settings.residual:
            raise ValueError(
                "--recurrence.layers and --recurrence.residual have no effect on an agent of your own; use --agent-option"
            )
        self.settings, self.device, self.parts = settings, device, 1
        self.embedding = _embedding(input_width, settings)
        try:
            self.cell = make(
                settings.hidden_size if settings.embedding else input_width, settings.hidden_size, **options
            )
        except TypeError as error:
            raise _not_made(make, error) from error
        self.width = int(getattr(self.cell, "width", settings.hidden_size))
        self._state_width = int(getattr(self.cell, "state_width", settings.hidden_size))

    def initial_state(self, num_envs: int) -> RecurrentState:
        return RecurrentState(torch.zeros((1, 1, num_envs, self._state_width), device=self.device))

    def refresh(self, dtype: torch.dtype) -> None:
        pass

    def step(self, x: Tensor, state: RecurrentState, reset_mask: Tensor | None) -> tuple[Tensor, Tensor]:
        hidden = state.hidden[0, 0]
        if reset_mask is not None:
            hidden = hidden.masked_fill(reset_mask.unsqueeze(-1), 0.0)
        with self._float32():
            y, hidden = self.cell(x.float(), hidden)
        return y, hidden[None, None]

    def forward(self, x: Tensor, minibatch: RecurrentMinibatch) -> Tensor:
        hidden, outputs = minibatch.initial_hidden[0, 0], []
        with self._float32():
            # Longer sequences come first, so those that have ended are at the end.
            for step in x.float().split(minibatch.batch_sizes.tolist()):
                y, hidden = self.cell(step, hidden[: len(step)])
                outputs.append(y)
        return torch.cat(outputs)


class SequenceMemory(RecurrentMemory):
    """A recurrent memory of stacked layers of a class derived from `SequenceModel`: one of `memories`, or one of your own.

    The state of a layer, a tree of tensors, is stored as the entries of one vector of an environment.
    """

    cut_at_episodes = False

    def __init__(
        self,
        make: type[SequenceModel],
        input_width: int,
        settings: Recurrence,
        options: dict[str, Any],
        device: torch.device,
    ) -> None:
        """Make the layers; arguments and errors as for `CellMemory`, which has no number of layers."""
        nn.Module.__init__(self)
        if settings.residual:
            raise ValueError(
                "--recurrence.residual is for the agents gru and lstm; other layers determine it themselves"
            )
        self.settings, self.device, self.parts = settings, device, 1
        self.embedding = _embedding(input_width, settings)
        inputs = settings.hidden_size if settings.embedding else input_width
        try:
            self.cell = Stack(make, inputs, settings.hidden_size, settings.layers, options)
        except TypeError as error:
            raise _not_made(make, error) from error
        self.width = self.cell.width
        for layer in self.cell.layers:
            layer.native = settings.kernels == "auto"
        self._sizes = [math.prod(shape) for shape in self.cell.state_shapes.values()]

    def initial_state(self, num_envs: int) -> RecurrentState:
        return RecurrentState(torch.zeros((1, 1, num_envs, sum(self._sizes)), device=self.device))

    def refresh(self, dtype: torch.dtype) -> None:
        pass

    def step(self, x: Tensor, state: RecurrentState, reset_mask: Tensor | None) -> tuple[Tensor, Tensor]:
        tree = self._tree(state.hidden[0, 0])
        with self._float32():
            y, after = self.cell.step(x.float(), tree if reset_mask is None else restarted(tree, reset_mask))
        vectors = [after[name].flatten(1) for name in self.cell.state_shapes]
        return y, torch.cat(vectors, dim=1)[None, None]

    def forward(self, x: Tensor, minibatch: RecurrentMinibatch) -> Tensor:
        sizes = minibatch.batch_sizes
        # Shorter sequences are padded at their end with other steps, whose outputs are not used.
        exists = torch.arange(int(sizes[0])) < sizes.unsqueeze(1)
        rows = exists.flatten().cumsum(0) - 1
        resets = minibatch.resets[rows].view_as(exists).to(x.device)
        padded = x.float().index_select(0, rows.to(x.device)).unflatten(0, exists.shape)
        with self._float32():
            y, _ = self.cell.sequence(padded, self._tree(minibatch.initial_hidden[0, 0]), resets)
        return y.flatten(0, 1).index_select(0, exists.flatten().nonzero()[:, 0].to(x.device))

    def _tree(self, vectors: Tensor) -> State:
        """The states in vectors (n, entries), as views."""
        parts = zip(self.cell.state_shapes.items(), vectors.split(self._sizes, dim=1), strict=True)
        return {name: part.unflatten(1, shape) for (name, shape), part in parts}


def _not_made(make: type[nn.Module], error: TypeError) -> ValueError:
    return ValueError(f"{make.__name__} cannot be made of an input width, a hidden size and --agent-option: {error}")


def _embedding(input_width: int, settings: Recurrence) -> nn.Sequential | None:
    """The fully connected layer before the recurrent layers, if there is one."""
    if not settings.embedding:
        return None
    return nn.Sequential(orthogonal(nn.Linear(input_width, settings.hidden_size)), nn.ReLU())


def packed(time: Tensor, env: Tensor, lengths: Tensor, envs: int) -> tuple[Tensor, Tensor]:
    """The steps of sequences in the order of a `PackedSequence`, if the sequences are in decreasing order of length.

    Args:
        time: First step of each sequence, int64 (sequences,).
        env: Environment of each sequence, int64 (sequences,).
        lengths: Steps of each sequence, int64 (sequences,).
        envs: Number of environments in the segment.

    Returns:
        The index of each step in the flattened segment, int64, and the number of sequences that have a step t, int64 (longest,).
    """
    offset = torch.arange(int(lengths.max()) if len(lengths) else 0).unsqueeze(1)  # (longest, 1)
    exists = offset < lengths
    return ((time + offset) * envs + env)[exists], exists.sum(1)
