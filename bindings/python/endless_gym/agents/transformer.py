"""Memory in cached layer inputs: Transformer-XL, and GTrXL with its gates.

What block `l` took as its input at step `t` of an episode is cached, without gradient: the episodic memory. At step `t`
the block's query is its current input; its keys and values are made from its cached inputs of the steps before, as many
of the same episode as the window holds beside the current step. Then attention, a connection around it, a fully connected
layer, a connection around that. Inputs are normalised before attention and before the fully connected layer.

A token, the cached input of one step, has the same key and value in each window that it is in. They are projected once:
while acting, for the token that is new; while learning, for each token of a sequence and of the `window - 1` steps before
it. A mask, a band of the window's width that no episode's boundary crosses, says which query attends to which token. At
the first step of an episode there is nothing to attend to, and the attention's weighted sum is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym.agents.encoders import orthogonal
from endless_gym.agents.memory import Memory, Plan, State, shares
from endless_gym.agents.settings import Transformer

#: Steps that the episodic memory has room for beyond the window, before it is moved to the front, while nothing is recorded.
ROOM = 64


def sinusoids(positions: Tensor, width: int) -> Tensor:
    """Sines of all frequencies, then their cosines: (..., width) for positions (...,)."""
    frequencies = 1e4 ** (-torch.arange(0, width, 2, device=positions.device) / width)
    angles = positions.unsqueeze(-1) * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class Attention(nn.Module):
    """Multi-head attention, in parts: what is made of each token once, and what of each query."""

    def __init__(self, settings: Transformer) -> None:
        super().__init__()
        self.heads, self.size = settings.heads, settings.width // settings.heads
        # With shared heads one matrix serves all heads, each for its part of the vector.
        inner = self.size if settings.shared_heads else settings.width
        self.queries = nn.Linear(inner, inner, bias=False)
        self.keys = nn.Linear(inner, inner, bias=False)
        self.values = nn.Linear(inner, inner, bias=False)
        self.fc_out = nn.Linear(settings.width, settings.width)
        # The paper's implementation divides by the root of the whole width, not of a head's.
        self.scale = settings.width**-0.5
        self.relative = settings.positional_encoding == "relative"
        if self.relative:
            self.distances = nn.Linear(inner, inner, bias=False)
            self.content_bias = nn.Parameter(torch.zeros(self.heads, 1, self.size))
            self.distance_bias = nn.Parameter(torch.zeros(self.heads, 1, self.size))

    def project(self, layer: nn.Linear, x: Tensor) -> Tensor:
        """(..., tokens, width) to (..., heads, tokens, size)."""
        split = (self.heads, self.size)
        shared = layer.in_features == self.size
        projected: Tensor = layer(x.unflatten(-1, split)) if shared else layer(x).unflatten(-1, split)
        return projected.transpose(-3, -2)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor, distance: Tensor) -> Tensor:
        """Attend.

        Args:
            x: What asks, (n, queries, width).
            keys: (n, heads, tokens, size).
            values: (n, heads, tokens, size).
            mask: Which query attends to which token, bool (n, queries, tokens).
            distance: How many steps a token is older than a query, int64 (queries, tokens).
        """
        queries = self.project(self.queries, x)
        # What a softmax over nothing is, and its gradient, is each kernel's choice: a query that may attend to no token attends
        # to all of them, and its sum is taken away below.
        nothing = ~mask.any(-1, keepdim=True)
        allowed = (mask | nothing).unsqueeze(1)
        if not self.relative:
            summed = functional.scaled_dot_product_attention(queries, keys, values, allowed, scale=self.scale)
        else:
            # Dai et al., 2019: the query meets the distance beside the content, each with a bias.
            # No token is older than there are tokens.
            table = sinusoids(torch.arange(keys.shape[-2] + 1, device=x.device), x.shape[-1]).to(x.dtype)
            encoded = self.project(self.distances, table)  # (heads, distances, size)
            scores = (queries + self.distance_bias) @ encoded.transpose(-2, -1)  # (n, heads, queries, distances)
            chosen = distance.clamp(min=0).expand(*scores.shape[:2], *distance.shape)
            bias = (scores.gather(-1, chosen) * self.scale).masked_fill(~allowed, float("-inf"))
            content = queries + self.content_bias
            summed = functional.scaled_dot_product_attention(content, keys, values, bias, scale=self.scale)
        summed = summed.masked_fill(nothing.unsqueeze(1), 0.0)
        out: Tensor = self.fc_out(summed.transpose(1, 2).flatten(-2))
        return out


class Gate(nn.Module):
    """GTrXL's gate, in the manner of a GRU: lets y, what a block adds, change the stream x."""

    def __init__(self, width: int, bias: float) -> None:
        super().__init__()
        self.from_y = nn.Linear(width, 3 * width, bias=False)
        self.from_x = nn.Linear(width, 2 * width, bias=False)
        self.from_reset = nn.Linear(width, width, bias=False)
        self.bias = nn.Parameter(torch.full((width,), float(bias)))
        for layer, parts in ((self.from_y, 3), (self.from_x, 2), (self.from_reset, 1)):
            for part in layer.weight.chunk(parts):
                nn.init.xavier_uniform_(part)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        reset_y, update_y, candidate_y = self.from_y(y).chunk(3, dim=-1)
        reset_x, update_x = self.from_x(x).chunk(2, dim=-1)
        reset = torch.sigmoid(reset_y + reset_x)
        update = torch.sigmoid(update_y + update_x - self.bias)
        candidate = torch.tanh(candidate_y + self.from_reset(reset * x))
        out: Tensor = (1 - update) * x + update * candidate
        return out


class Block(nn.Module):
    """One layer of the Transformer-XL, normalised before its parts."""

    def __init__(self, settings: Transformer) -> None:
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
        """Of tokens (n, tokens, width) with their positions added: two of (n, heads, tokens, size)."""
        tokens = self.norm_tokens(tokens)
        attention = self.attention
        return attention.project(attention.keys, tokens), attention.project(attention.values, tokens)

    def forward(self, x: Tensor, keys: Tensor, values: Tensor, mask: Tensor, distance: Tensor) -> Tensor:
        """The stream after this block; as for `Attention.forward`."""
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
            # Huang et al., 2020: values, the projection after them, and the fully connected layer of an encoder's block.
            with torch.no_grad():
                for layer in (self.attention.values, self.attention.fc_out, self.fc):
                    layer.weight.mul_(0.67 * layers**-0.25)


class EpisodicMemory(State):
    """The cached inputs of all blocks, of n environments in lockstep.

    The last `window - 1` steps before `fill` are what the next step may attend to; what is older only serves learning.
    Columns are steps; once they are used up, the last ones move to the front.

    Attributes:
        inputs: What each block took, (layers, n, columns, width).
        keys: Made from the inputs with the weights at hand, (layers, n, heads, columns, size); None before they are needed.
        values: As `keys`.
        position: The step's number in its episode, int64 (n, columns).
        episode: The episode's number in its environment; -1 where nothing is remembered, int64 (n, columns).
        running: The number of the running episode, int64 (n,).
        next_position: The number that the next step has in its episode, unless it starts a new one, int64 (n,).
        fill: Columns that are in use.
    """

    def __init__(self, settings: Transformer, num_envs: int, device: torch.device) -> None:
        self.past = settings.window - 1
        self.fill = self.past
        columns = self.past + ROOM
        self.inputs = torch.zeros(settings.layers, num_envs, columns, settings.width, device=device)
        self.position = torch.zeros(num_envs, columns, dtype=torch.long, device=device)
        self.episode = torch.full((num_envs, columns), -1, device=device)
        self.running = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.next_position = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.keys: Tensor | None = None
        self.values: Tensor | None = None

    def move_to_front(self, room: int) -> None:
        """Keep the last `window - 1` columns, and make room for more; keys and values are to be made again."""
        columns, last = self.past + room, slice(self.fill - self.past, self.fill)

        def moved(tensor: Tensor, dim: int, empty: int) -> Tensor:
            kept = tensor.narrow(dim, last.start, self.past)
            shape = (*tensor.shape[:dim], columns, *tensor.shape[dim + 1 :])
            fresh = tensor.new_full(shape, empty)
            fresh.narrow(dim, 0, self.past).copy_(kept)
            return fresh

        self.inputs = moved(self.inputs, 2, 0)
        self.position, self.episode = moved(self.position, 1, 0), moved(self.episode, 1, -1)
        self.keys = self.values = None
        self.fill = self.past

    def tensors(self) -> dict[str, Any]:
        names = ("inputs", "position", "episode", "running", "next_position")
        return {"fill": self.fill} | {name: getattr(self, name) for name in names}

    def load(self, tensors: dict[str, Any]) -> None:
        for name, value in tensors.items():
            setattr(self, name, value.to(self.inputs.device) if isinstance(value, Tensor) else value)
        self.keys = self.values = None


@dataclass
class TransformerPlan(Plan):
    """Sequences of C steps each, with the P steps before them: `window - 1`, or fewer if all episodes are shorter.

    Attributes:
        tokens: The cached inputs, (layers, sequences, P + C, width).
        position: Of each token in its episode, int64 (sequences, P + C).
        mask: Which query attends to which token, bool (sequences, C, P + C).
        distance: How many steps a token is older than a query, int64 (C, P + C).
    """

    tokens: Tensor
    position: Tensor
    mask: Tensor
    distance: Tensor


class TransformerMemory(Memory):
    """An embedding layer, then blocks of attention to the episodic memory."""

    #: The encoding of each position in an episode, (positions, width), if there is one.
    table: Tensor | None

    def __init__(self, input_width: int, settings: Transformer, positions: int, device: torch.device) -> None:
        super().__init__()
        self.settings, self.positions, self.device = settings, positions, device
        self.width, self.past = settings.width, settings.window - 1
        self.embedding = nn.Sequential(orthogonal(nn.Linear(input_width, settings.width)), nn.ReLU())
        self.layers = nn.ModuleList(Block(settings) for _ in range(settings.layers))
        if settings.positional_encoding == "absolute":
            # As in the paper's implementation, the table is reversed: an episode's first step has the largest angles.
            rows = torch.arange(positions - 1, -1, -1)
            self.register_buffer("table", sinusoids(rows, settings.width), persistent=False)
        elif settings.positional_encoding == "learned":
            self.table = nn.Parameter(torch.randn(positions, settings.width))
        else:
            self.register_buffer("table", None)

    @property
    def blocks(self) -> list[Block]:
        """The blocks, from the input to the output."""
        return [block for block in self.layers if isinstance(block, Block)]

    def initial_state(self, num_envs: int) -> EpisodicMemory:
        return EpisodicMemory(self.settings, num_envs, self.device)

    def begin_segment(self, state: State, steps: int) -> None:
        assert isinstance(state, EpisodicMemory)
        state.move_to_front(steps)

    def step(self, x: Tensor, state: State, first: Tensor) -> tuple[Tensor, Any]:
        assert isinstance(state, EpisodicMemory)
        if state.keys is None or state.values is None:
            self._project_all(state)
        assert state.keys is not None and state.values is not None
        episode = state.running + first.long()
        position = state.next_position.masked_fill(first, 0)
        past = self._needed(position)
        window = slice(state.fill - past, state.fill)
        mask = (state.episode[:, window] == episode.unsqueeze(1)).unsqueeze(1)  # (n, 1, past)
        distance = torch.arange(past, 0, -1, device=self.device).unsqueeze(0)
        x = self.embedding(x).unsqueeze(1)
        inputs = []
        for layer, block in enumerate(self.blocks):
            inputs.append(x)
            x = self._query(x, position.unsqueeze(1))
            x = block(x, state.keys[layer, :, :, window], state.values[layer, :, :, window], mask, distance)
        return x.squeeze(1), (torch.stack(inputs), episode, position)

    def remember(self, state: State, news: Any) -> None:
        assert isinstance(state, EpisodicMemory)
        if state.fill == state.inputs.shape[2]:
            state.move_to_front(ROOM)
            self._project_all(state)
        assert state.keys is not None and state.values is not None
        inputs, episode, position = news
        column, inputs = state.fill, inputs.float()
        state.inputs[:, :, column] = inputs.squeeze(2)
        state.episode[:, column], state.position[:, column] = episode, position
        state.running, state.next_position = episode, position + 1
        for layer, block in enumerate(self.blocks):
            key, value = block.keys_and_values(self._placed(inputs[layer], position.unsqueeze(1)))
            state.keys[layer, :, :, column], state.values[layer, :, :, column] = key.squeeze(2), value.squeeze(2)
        state.fill += 1

    def plan(
        self, states: Sequence[State], first: Tensor, minibatches: int, generator: torch.Generator
    ) -> Sequence[TransformerPlan]:
        memories = [state for state in states if isinstance(state, EpisodicMemory)]
        steps, envs = first.shape
        length = min(self.settings.sequence_length, steps)
        position = torch.cat([memory.position for memory in memories])
        past = self._needed(position[:, self.past :])
        span, skipped = past + length, self.past - past
        # Without those that nothing attends to, column c is step c - past; an environment's sequence s spans columns sL to
        # sL + span.
        position = position[:, skipped:].unfold(1, span, length)
        inputs = torch.cat([memory.inputs[:, :, skipped:] for memory in memories], dim=1).unfold(2, span, length)
        episode = torch.cat([memory.episode[:, skipped:] for memory in memories]).unfold(1, span, length)
        sequences = steps // length
        ages = torch.arange(past, span, device=self.device).unsqueeze(1) - torch.arange(span, device=self.device)
        band = (ages > 0) & (ages < self.settings.window)
        plans = []
        for chosen in shares([length] * (envs * sequences), minibatches, generator):
            env, sequence = chosen // sequences, chosen % sequences
            flat = (sequence * length).unsqueeze(1) + torch.arange(length)
            env_, sequence_ = env.to(self.device), sequence.to(self.device)
            episodes = episode[env_, sequence_]
            mask = band & (episodes[:, past:, None] == episodes[:, None, :])
            plans.append(
                TransformerPlan(
                    steps=(flat * envs + env.unsqueeze(1)).flatten().to(self.device),
                    tokens=inputs[:, env_, sequence_].transpose(2, 3),
                    position=position[env_, sequence_],
                    mask=mask,
                    distance=ages,
                )
            )
        return plans

    def forward(self, x: Tensor, plan: TransformerPlan) -> Tensor:
        length, span = plan.distance.shape
        x = self.embedding(x).unflatten(0, (-1, length))
        position = plan.position[:, span - length :]
        for block, tokens in zip(self.blocks, plan.tokens, strict=True):
            keys, values = block.keys_and_values(self._placed(tokens, plan.position))
            x = block(self._query(x, position), keys, values, plan.mask, plan.distance)
        return x.flatten(0, 1)

    def _needed(self, position: Tensor) -> int:
        """How many steps before a query can be of its episode and in its window, at most; 1 at least."""
        return max(1, min(self.past, int(position.max())))

    def _placed(self, tokens: Tensor, position: Tensor) -> Tensor:
        """Tokens (..., width) with the encoding of their positions (...,) added; beyond its table all share the last row."""
        if self.table is None:
            return tokens
        return tokens + self.table[position.clamp(max=self.positions - 1)]

    def _query(self, x: Tensor, position: Tensor) -> Tensor:
        return self._placed(x, position) if self.settings.query_encoding else x

    def _project_all(self, state: EpisodicMemory) -> None:
        """Keys and values of the whole window, with the weights of now."""
        used = slice(0, state.fill)
        shape = (len(self.blocks), state.inputs.shape[1], self.settings.heads, state.inputs.shape[2])
        size = self.width // self.settings.heads
        state.keys, state.values = (state.inputs.new_zeros(*shape, size) for _ in range(2))
        for layer, block in enumerate(self.blocks):
            placed = self._placed(state.inputs[layer, :, used], state.position[:, used])
            keys, values = block.keys_and_values(placed)
            state.keys[layer, :, :, used], state.values[layer, :, :, used] = keys.float(), values.float()
