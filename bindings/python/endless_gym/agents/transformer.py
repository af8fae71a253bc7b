"""Transformer-XL, and GTrXL with gated connections: attention to the cached layer inputs of past steps.

The input of each block at each step of an episode is cached without gradient; one such input is called a token. At a step, a
block's query comes from its current input, and its keys and values come from the tokens of the `window - 1` steps before it that
belong to the same episode. A block is pre-norm: LayerNorm, attention, residual connection or gate, LayerNorm, fully connected
layer with ReLU, residual connection or gate.

Keys and values are projected once for each token, not once for each window that contains it:

* Acting: a KV cache holds the keys and values of the window. Each step projects the newest token only. The cache is recomputed
  when a segment begins, since the weights may have changed.
* Learning: a sequence of C steps is processed at once with the tokens of the sequence and of the `window - 1` steps before it. A
  band mask (causal, as wide as the window, and within one episode) says which query attends to which token.

At the first step of an episode there is no token to attend to, and the attention output before the final projection is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym.agents.encoders import orthogonal
from endless_gym.agents.memory import Memory, MemoryState, Minibatch, balanced_split
from endless_gym.agents.settings import Transformer

#: Columns of the cache beyond the window while no segment is recorded. When they are full, the window moves to the front.
SPARE_COLUMNS = 64


def sinusoids(positions: Tensor, width: int) -> Tensor:
    """Sinusoidal positional encoding (Vaswani et al., 2017): the sines of all frequencies, then the cosines.

    Args:
        positions: int64 (...,).
        width: Size of an encoding; even.

    Returns:
        float32 (..., width).
    """
    frequencies = 1e4 ** (-torch.arange(0, width, 2, device=positions.device) / width)
    angles = positions.unsqueeze(-1) * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Attention(nn.Module):
    """Multi-head attention with separate projection, so that the keys and values of a token are computed once and reused."""

    def __init__(self, settings: Transformer) -> None:
        """Make the projections; see `Transformer` for the settings."""
        super().__init__()
        self.heads, self.size = settings.heads, settings.width // settings.heads
        # With shared heads, one matrix projects each head's slice of the vector.
        inner = self.size if settings.shared_heads else settings.width
        self.queries = nn.Linear(inner, inner, bias=False)
        self.keys = nn.Linear(inner, inner, bias=False)
        self.values = nn.Linear(inner, inner, bias=False)
        self.fc_out = nn.Linear(settings.width, settings.width)
        # As in the paper's implementation, scores are divided by the root of the full width, not of the head size.
        self.scale = settings.width**-0.5
        self.relative = settings.positional_encoding == "relative"
        if self.relative:
            self.distances = nn.Linear(inner, inner, bias=False)
            self.content_bias = nn.Parameter(torch.zeros(self.heads, 1, self.size))
            self.distance_bias = nn.Parameter(torch.zeros(self.heads, 1, self.size))

    def project(self, layer: nn.Linear, x: Tensor) -> Tensor:
        """Project and split into heads: float (..., tokens, width) to (..., heads, tokens, head size)."""
        split = (self.heads, self.size)
        shared = layer.in_features == self.size
        projected: Tensor = layer(x.unflatten(-1, split)) if shared else layer(x).unflatten(-1, split)
        return projected.transpose(-3, -2)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor, distance: Tensor) -> Tensor:
        """Scaled dot-product attention.

        Args:
            x: Inputs of the queries, float (n, queries, width).
            keys: float (n, heads, tokens, head size).
            values: float (n, heads, tokens, head size).
            mask: Attention mask, bool (n, queries, tokens); true where the query attends to the token.
            distance: Steps from the token to the query, int64 (queries, tokens); used by the relative encoding.

        Returns:
            float (n, queries, width).
        """
        queries = self.project(self.queries, x)
        # The softmax of a fully masked row, and its gradient, differ between attention kernels. Such a row attends to all tokens
        # here, and its output is set to 0 below.
        fully_masked = ~mask.any(-1, keepdim=True)
        allowed = (mask | fully_masked).unsqueeze(1)
        if not self.relative:
            summed = functional.scaled_dot_product_attention(queries, keys, values, allowed, scale=self.scale)
        else:
            # Relative encoding of Dai et al., 2019: a content term and a distance term, each with a learned bias. A distance is
            # at most the number of tokens.
            table = sinusoids(torch.arange(keys.shape[-2] + 1, device=x.device), x.shape[-1]).to(x.dtype)
            encoded = self.project(self.distances, table)  # (heads, distances, size)
            scores = (queries + self.distance_bias) @ encoded.transpose(-2, -1)  # (n, heads, queries, distances)
            chosen = distance.clamp(min=0).expand(*scores.shape[:2], *distance.shape)
            bias = (scores.gather(-1, chosen) * self.scale).masked_fill(~allowed, float("-inf"))
            content = queries + self.content_bias
            summed = functional.scaled_dot_product_attention(content, keys, values, bias, scale=self.scale)
        summed = summed.masked_fill(fully_masked.unsqueeze(1), 0.0)
        out: Tensor = self.fc_out(summed.transpose(1, 2).flatten(-2))
        return out


class Gate(nn.Module):
    """The GRU-type gate of GTrXL (Parisotto et al., 2020), in place of a residual connection."""

    def __init__(self, width: int, bias: float) -> None:
        """Make the gate.

        Args:
            width: Size of the vectors.
            bias: Initial value of the update gate's bias; the larger, the closer the gate is to passing x through.
        """
        super().__init__()
        self.from_y = nn.Linear(width, 3 * width, bias=False)
        self.from_x = nn.Linear(width, 2 * width, bias=False)
        self.from_reset = nn.Linear(width, width, bias=False)
        self.bias = nn.Parameter(torch.full((width,), float(bias)))
        for layer, parts in ((self.from_y, 3), (self.from_x, 2), (self.from_reset, 1)):
            for part in layer.weight.chunk(parts):
                nn.init.xavier_uniform_(part)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Combine the residual stream x with a sublayer's output y; both and the result float (..., width)."""
        reset_y, update_y, candidate_y = self.from_y(y).chunk(3, dim=-1)
        reset_x, update_x = self.from_x(x).chunk(2, dim=-1)
        reset = torch.sigmoid(reset_y + reset_x)
        update = torch.sigmoid(update_y + update_x - self.bias)
        candidate = torch.tanh(candidate_y + self.from_reset(reset * x))
        out: Tensor = (1 - update) * x + update * candidate
        return out


class Block(nn.Module):
    """One pre-norm block of the Transformer-XL."""

    def __init__(self, settings: Transformer) -> None:
        """Make the block with the weight initialisation that the settings name."""
        super().__init__()
        width = settings.width
        self.norm_query, self.norm_tokens, self.norm_fc = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = Attention(settings)
        self.fc = nn.Linear(width, width)
        self._initialise(settings.initialisation, settings.layers)
        gate = settings.gate_bias
        self.gate_attention = Gate(width, gate) if settings.gating else None
        self.gate_fc = Gate(width, gate) if settings.gating else None

    def keys_and_values(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Project tokens with positions added, (n, tokens, width), to keys and values, (n, heads, tokens, head size) each."""
        tokens = self.norm_tokens(tokens)
        attention = self.attention
        return attention.project(attention.keys, tokens), attention.project(attention.values, tokens)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor, distance: Tensor) -> Tensor:
        """The block's output, float (n, queries, width); arguments as for `Attention.forward`."""
        attended: Tensor = self.attention(self.norm_query(x), keys, values, mask, distance)
        x = x + attended if self.gate_attention is None else self.gate_attention(x, attended)
        added: Tensor = self.fc(self.norm_fc(x)).relu()
        out: Tensor = x + added if self.gate_fc is None else self.gate_fc(x, added)
        return out

    def _initialise(self, kind: str, layers: int) -> None:
        for weight in self.parameters():
            if weight.dim() < 2:
                continue
            if kind == "orthogonal":
                nn.init.orthogonal_(weight, 2**0.5)
            elif kind == "kaiming":
                nn.init.kaiming_uniform_(weight)
            else:
                nn.init.xavier_uniform_(weight)
        if kind == "tfixup":
            # T-Fixup (Huang et al., 2020) scales the value projection, the output projection and the fully connected layer.
            with torch.no_grad():
                for layer in (self.attention.values, self.attention.fc_out, self.fc):
                    layer.weight.mul_(0.67 * layers**-0.25)


class TransformerState(MemoryState):
    """The tokens of n environments in lockstep, with the KV cache.

    A column is a step. The `window - 1` columns before `fill` are what the next step can attend to; older columns are kept for
    learning. When all columns are used, `compact` moves the window to the front.

    Attributes:
        inputs: Tokens: the input of each block at each step, float32 (layers, n, columns, width).
        keys: KV cache: keys of the tokens with the current weights, float32 (layers, n, heads, columns, head size); None while
            the cache is invalid.
        values: As `keys`.
        position: Step number within its episode, int64 (n, columns).
        episode: Number of the episode in its environment, int64 (n, columns); -1 in columns without a step.
        current_episode: Number of the current episode, int64 (n,).
        next_position: Position of the next step unless it starts an episode, int64 (n,).
        fill: Number of columns in use.
    """

    def __init__(self, settings: Transformer, num_envs: int, device: torch.device) -> None:
        """Make the state of `num_envs` environments before their first step."""
        self.past = settings.window - 1
        self.fill = self.past
        columns = self.past + SPARE_COLUMNS
        self.inputs = torch.zeros(settings.layers, num_envs, columns, settings.width, device=device)
        self.position = torch.zeros(num_envs, columns, dtype=torch.long, device=device)
        self.episode = torch.full((num_envs, columns), -1, device=device)
        self.current_episode = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.next_position = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.keys: Tensor | None = None
        self.values: Tensor | None = None

    def compact(self, spare_columns: int) -> None:
        """Keep only the last `window - 1` columns, add `spare_columns` free columns, and invalidate the KV cache."""
        columns, start = self.past + spare_columns, self.fill - self.past

        def moved(tensor: Tensor, dim: int, empty: int) -> Tensor:
            kept = tensor.narrow(dim, start, self.past)
            shape = (*tensor.shape[:dim], columns, *tensor.shape[dim + 1 :])
            fresh = tensor.new_full(shape, empty)
            fresh.narrow(dim, 0, self.past).copy_(kept)
            return fresh

        self.inputs = moved(self.inputs, 2, 0)
        self.position, self.episode = moved(self.position, 1, 0), moved(self.episode, 1, -1)
        self.keys = self.values = None
        self.fill = self.past

    def state_dict(self) -> dict[str, Any]:
        # The keys are those of the checkpoint format.
        return {
            "fill": self.fill,
            "inputs": self.inputs,
            "position": self.position,
            "episode": self.episode,
            "running": self.current_episode,
            "next_position": self.next_position,
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        device = self.inputs.device
        self.fill = state_dict["fill"]
        self.inputs = state_dict["inputs"].to(device)
        self.position, self.episode = state_dict["position"].to(device), state_dict["episode"].to(device)
        self.current_episode = state_dict["running"].to(device)
        self.next_position = state_dict["next_position"].to(device)
        self.keys = self.values = None


@dataclass
class TransformerUpdate:
    """The newest column of a `TransformerState`.

    Attributes:
        inputs: The input of each block, float (layers, n, 1, width).
        episode: int64 (n,).
        position: int64 (n,).
    """

    inputs: Tensor
    episode: Tensor
    position: Tensor


@dataclass
class TransformerMinibatch(Minibatch):
    """Sequences of C steps each, with the P steps before them: `window - 1`, or fewer if all episodes are shorter.

    Attributes:
        tokens: The cached inputs of each block, float32 (layers, sequences, P + C, width).
        position: Position of each token in its episode, int64 (sequences, P + C).
        mask: Attention mask, bool (sequences, C, P + C); true where the query attends to the token.
        distance: Steps from each token to each query, int64 (C, P + C).
    """

    tokens: Tensor
    position: Tensor
    mask: Tensor
    distance: Tensor


class TransformerMemory(Memory[TransformerState, TransformerUpdate, TransformerMinibatch]):
    """A fully connected layer, followed by attention blocks."""

    #: Positional encoding by position in the episode, float32 (positions, width); None without an absolute or learned encoding.
    table: Tensor | None

    def __init__(self, input_width: int, settings: Transformer, positions: int, device: torch.device) -> None:
        """Make the layers.

        Args:
            input_width: Size of the encoded observations.
            settings: Settings of the blocks, with `window` at its final value.
            positions: Rows of the table of positional encodings.
            device: Device of the states.
        """
        super().__init__()
        self.settings, self.positions, self.device = settings, positions, device
        self.width, self.past = settings.width, settings.window - 1
        self.embedding = nn.Sequential(orthogonal(nn.Linear(input_width, settings.width)), nn.ReLU())
        self.layers = nn.ModuleList(Block(settings) for _ in range(settings.layers))
        if settings.positional_encoding == "absolute":
            # As in the paper's implementation, the table is reversed: the first step of an episode has the largest angles.
            rows = torch.arange(positions - 1, -1, -1)
            self.register_buffer("table", sinusoids(rows, settings.width), persistent=False)
        elif settings.positional_encoding == "learned":
            self.table = nn.Parameter(torch.randn(positions, settings.width))
        else:
            self.register_buffer("table", None)

    @property
    def blocks(self) -> list[Block]:
        """The blocks in order, from input to output."""
        return [block for block in self.layers if isinstance(block, Block)]

    def initial_state(self, num_envs: int) -> TransformerState:
        return TransformerState(self.settings, num_envs, self.device)

    def begin_segment(self, state: TransformerState, steps: int) -> None:
        state.compact(steps)

    def step(self, x: Tensor, state: TransformerState, reset_mask: Tensor) -> tuple[Tensor, TransformerUpdate]:
        keys, values = self._kv_cache(state)
        episode = state.current_episode + reset_mask.long()
        position = state.next_position.masked_fill(reset_mask, 0)
        past = self._past_length(position)
        window = slice(state.fill - past, state.fill)
        mask = (state.episode[:, window] == episode.unsqueeze(1)).unsqueeze(1)  # (n, 1, past)
        distance = torch.arange(past, 0, -1, device=self.device).unsqueeze(0)
        x = self.embedding(x).unsqueeze(1)
        inputs = []
        for layer, block in enumerate(self.blocks):
            inputs.append(x)
            x = self._query_input(x, position.unsqueeze(1))
            x = block(x, keys[layer, :, :, window], values[layer, :, :, window], mask, distance)
        return x.squeeze(1), TransformerUpdate(torch.stack(inputs), episode, position)

    def update_state(self, state: TransformerState, update: TransformerUpdate) -> None:
        if state.fill == state.inputs.shape[2]:
            state.compact(SPARE_COLUMNS)
        keys, values = self._kv_cache(state)
        column, inputs = state.fill, update.inputs.float()
        state.inputs[:, :, column] = inputs.squeeze(2)
        state.episode[:, column], state.position[:, column] = update.episode, update.position
        state.current_episode, state.next_position = update.episode, update.position + 1
        for layer, block in enumerate(self.blocks):
            key, value = block.keys_and_values(self._add_positions(inputs[layer], update.position.unsqueeze(1)))
            keys[layer, :, :, column], values[layer, :, :, column] = key.squeeze(2), value.squeeze(2)
        state.fill += 1

    def minibatches(
        self, states: Sequence[TransformerState], reset_mask: Tensor, num_minibatches: int, generator: torch.Generator
    ) -> Sequence[TransformerMinibatch]:
        steps, envs = reset_mask.shape
        length = min(self.settings.sequence_length, steps)
        position = torch.cat([state.position for state in states])
        past = self._past_length(position[:, self.past :])
        span, skipped = past + length, self.past - past
        # Columns that no query attends to are skipped. Then column c is step c - past, and sequence s of an environment spans the
        # columns from s * length to s * length + span.
        position = position[:, skipped:].unfold(1, span, length)
        inputs = torch.cat([state.inputs[:, :, skipped:] for state in states], dim=1).unfold(2, span, length)
        episode = torch.cat([state.episode[:, skipped:] for state in states]).unfold(1, span, length)
        sequences = steps // length
        distance = torch.arange(past, span, device=self.device).unsqueeze(1) - torch.arange(span, device=self.device)
        band = (distance > 0) & (distance < self.settings.window)
        minibatches = []
        for chosen in balanced_split([length] * (envs * sequences), num_minibatches, generator):
            env, sequence = chosen // sequences, chosen % sequences
            time = (sequence * length).unsqueeze(1) + torch.arange(length)
            env_, sequence_ = env.to(self.device), sequence.to(self.device)
            episodes = episode[env_, sequence_]
            mask = band & (episodes[:, past:, None] == episodes[:, None, :])
            minibatches.append(
                TransformerMinibatch(
                    indices=(time * envs + env.unsqueeze(1)).flatten().to(self.device),
                    tokens=inputs[:, env_, sequence_].transpose(2, 3),
                    position=position[env_, sequence_],
                    mask=mask,
                    distance=distance,
                )
            )
        return minibatches

    def forward(self, x: Tensor, minibatch: TransformerMinibatch) -> Tensor:
        length, span = minibatch.distance.shape
        x = self.embedding(x).unflatten(0, (-1, length))
        position = minibatch.position[:, span - length :]
        for block, tokens in zip(self.blocks, minibatch.tokens, strict=True):
            keys, values = block.keys_and_values(self._add_positions(tokens, minibatch.position))
            x = block(self._query_input(x, position), keys, values, minibatch.mask, minibatch.distance)
        return x.flatten(0, 1)

    def _past_length(self, position: Tensor) -> int:
        """The largest number of past steps that a query at one of these positions can attend to; 1 or more."""
        return max(1, min(self.past, int(position.max())))

    def _add_positions(self, tokens: Tensor, position: Tensor) -> Tensor:
        """Add the encodings of positions int64 (...,) to tokens (..., width). Positions beyond the table share its last row."""
        if self.table is None:
            return tokens
        return tokens + self.table[position.clamp(max=self.positions - 1)]

    def _query_input(self, x: Tensor, position: Tensor) -> Tensor:
        return self._add_positions(x, position) if self.settings.query_encoding else x

    def _kv_cache(self, state: TransformerState) -> tuple[Tensor, Tensor]:
        """The keys and values of the state's tokens; computed with the current weights if the cache is invalid."""
        if state.keys is not None and state.values is not None:
            return state.keys, state.values
        used = slice(0, state.fill)
        shape = (len(self.blocks), state.inputs.shape[1], self.settings.heads, state.inputs.shape[2])
        size = self.width // self.settings.heads
        state.keys, state.values = (state.inputs.new_zeros(*shape, size) for _ in range(2))
        for layer, block in enumerate(self.blocks):
            tokens = self._add_positions(state.inputs[layer, :, used], state.position[:, used])
            keys, values = block.keys_and_values(tokens)
            state.keys[layer, :, :, used], state.values[layer, :, :, used] = keys.float(), values.float()
        return state.keys, state.values
