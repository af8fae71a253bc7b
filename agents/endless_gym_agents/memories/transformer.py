"""Transformer-XL, and GTrXL with gated connections: attention to the cached layer inputs of past steps.

The input of each block at each step of an episode is cached without gradient; one such input is called a token. At a step, a
block's query comes from its current input, and its keys and values come from the tokens of the `window - 1` steps before it that
belong to the same episode. A block is pre-norm: LayerNorm, attention, residual connection or gate, LayerNorm, fully connected
layer with ReLU, residual connection or gate.

The keys and values of a token are not recomputed for each window that contains it:

* Acting: a KV cache holds the keys and values of the window, in a ring of fixed size (`transformer_cache`). Each step projects
  only the newest token, for all blocks at once. The cache is recomputed when the weights have changed.
* Learning: a sequence of C steps is processed at once with the tokens of the sequence and of the `window - 1` steps before it. A
  band mask (causal, as wide as the window, and within one episode) determines which query attends to which token.
* Learning with sequences of one step: the steps of a minibatch are grouped by environment and part of the segment, and all
  queries of a group attend to the same tokens under a mask (`Groups`). The key projection is applied to the query instead of the
  tokens, and the value projection to the weighted sum of the tokens. By associativity this gives the same result, and it is
  faster with few queries per token.

A query attends to the token of an earlier step if the distance in steps is at most `window - 1`, and at most the query's position
in its episode. At the first step of an episode there is no token to attend to, and the attention output before the final
projection is 0.

With `Transformer.query_previous`, a layer with ReLU makes the first block's input, hence the first query, from the
embedding and "the previous output of the TrXL block" (section 5.6.3 of the paper, which gives no details). In the
authors' code (MarcoMeter/neroRL, branch `test/query_2`, commit 638502a) that is the last block's input, not its output,
at the previous time step: as stored while acting, without gradient or positional encoding, and 0 at the first step of an
episode. In other words, it is the last block's newest token. It is known before learning begins, so the steps of a
sequence need not be computed one after the other. The earlier branch `test/query` (b71311a) intends the same token with
its positional encoding, but selects that of the first environment of the batch for all environments, and, once the
window is full, that of the current step. This is not reproduced here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym_agents.memories.layers import Affine, linear_relu, orthogonal, transposed
from endless_gym_agents.memories.memory import Memory, MemoryState, Minibatch, Minibatches, is_own, shuffled
from endless_gym_agents.memories.transformer_block import MASKED, ActingBlock, Block, Groups, normalised, sinusoids
from endless_gym_agents.memories.transformer_cache import Projection, RingCache, ring_ages
from endless_gym_agents.settings import Transformer

#: Columns of the cache beyond the window while no segment is recorded. When they are full, the window moves to the front.
SPARE_COLUMNS = 64
#: Smallest number of steps in a part of a segment whose single steps attend to the same tokens.
SHORTEST_PART = 32


class TransformerState(MemoryState):
    """The tokens of n environments in lockstep, with the KV cache.

    A column is a step. The `window - 1` columns before `fill` are what the next step can attend to; older columns are kept for
    learning. When all columns are used, `compact` moves the window to the front.

    Attributes:
        inputs: Tokens: the input of each block at each step, float32 (layers, n, columns, width).
        position: Step number within its episode, int64 (n, columns).
        next_position: Position of the next step unless it starts an episode, int64 (n,).
        fill: Number of columns in use.
        cache: Keys and values of the window; None if they must be computed again.
    """

    def __init__(self, settings: Transformer, num_envs: int, device: torch.device) -> None:
        """Make the state of `num_envs` environments before their first step."""
        self.past = settings.window - 1
        self.fill = self.past
        columns = self.past + SPARE_COLUMNS
        self.inputs = torch.zeros(settings.layers, num_envs, columns, settings.width, device=device)
        self.position = torch.zeros(num_envs, columns, dtype=torch.long, device=device)
        self.next_position = torch.zeros(num_envs, dtype=torch.long, device=device)
        self.cache: RingCache | None = None

    def compact(self, spare_columns: int) -> None:
        """Keep only the last `window - 1` columns, and add `spare_columns` free columns."""
        columns, start = self.past + spare_columns, self.fill - self.past

        def moved(tensor: Tensor, dim: int) -> Tensor:
            fresh = tensor.new_zeros((*tensor.shape[:dim], columns, *tensor.shape[dim + 1 :]))
            fresh.narrow(dim, 0, self.past).copy_(tensor.narrow(dim, start, self.past))
            return fresh

        self.inputs, self.position = moved(self.inputs, 2), moved(self.position, 1)
        self.fill = self.past

    def state_dict(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("fill", "inputs", "position", "next_position")}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        device = self.inputs.device
        self.fill = state_dict["fill"]
        self.inputs, self.position = state_dict["inputs"].to(device), state_dict["position"].to(device)
        self.next_position = state_dict["next_position"].to(device)
        self.cache = None


#: The newest column of a `TransformerState`: the input of each block, float (n, width) each, and the position int64 (n,).
TransformerUpdate: TypeAlias = tuple[list[Tensor], Tensor]


@dataclass
class TransformerMinibatch(Minibatch):
    """Sequences of C steps each, with the P steps before them: `window - 1`, or on the CPU fewer if all episodes are shorter.

    Attributes:
        tokens: The cached inputs of each block, float (layers, sequences, P + C, width); with positions added, normalised and in
            the compute dtype. If the positional encoding is learned, raw float32.
        position: Position of each token in its episode, int64 (sequences, P + C).
        query_position: Position of each query in its episode, int64 (sequences, C).
        bias: Attention mask, float32 (sequences, 1, C, P + C); 0 where the query attends to the token, else `MASKED`.
        distance: Steps from each token to each query, int64 (C, P + C).
        groups: With C = 1, the places of the queries in groups of K. Then `tokens`, `position`, `bias` and `distance` have G
            groups in place of sequences, K queries in place of C, and the tokens that any query of the group may attend to.
        previous: The last block's input at the step before each query, 0 if that belongs to another episode, float32
            (sequences, C, width); None without `Transformer.query_previous`.
    """

    tokens: Tensor
    position: Tensor
    query_position: Tensor
    bias: Tensor
    distance: Tensor
    groups: Groups | None = None
    previous: Tensor | None = None


#: Makes a minibatch from the chosen sequences, sorted and on the CPU, and from `indices` and `everywhere` of `Minibatch`.
MakeMinibatch: TypeAlias = Callable[[Tensor, Tensor, Tensor], TransformerMinibatch]


class TransformerMemory(Memory[TransformerState, TransformerUpdate, TransformerMinibatch]):
    """A fully connected layer, followed by attention blocks.

    Attributes:
        fusion: Layer that combines the embedding with the last block's previous input; None without `Transformer.query_previous`.
    """

    #: Positional encoding by position in the episode, float32 (positions, width); None without an absolute or learned encoding.
    table: Tensor | None

    def __init__(self, input_width: int, settings: Transformer, positions: int, device: torch.device) -> None:
        """Make the layers.

        Args:
            input_width: Size of the encoded observations.
            settings: Settings of the blocks, with the default of `window` resolved.
            positions: Rows of the table of positional encodings.
            device: Device of the states.
        """
        super().__init__()
        self.settings, self.positions, self.device = settings, positions, device
        self.width, self.past = settings.width, settings.window - 1
        self.embedding = nn.Sequential(orthogonal(nn.Linear(input_width, settings.width)), nn.ReLU())
        self.fusion: nn.Sequential | None = None
        if settings.query_previous:
            self.fusion = nn.Sequential(orthogonal(nn.Linear(2 * settings.width, settings.width)), nn.ReLU())
        self.layers = nn.ModuleList(Block(settings) for _ in range(settings.layers))
        if settings.positional_encoding == "absolute":
            # As in the paper's implementation, the table is reversed: the first step of an episode has the largest angles.
            rows = torch.arange(positions - 1, -1, -1)
            self.register_buffer("table", sinusoids(rows, settings.width), persistent=False)
        elif settings.positional_encoding == "learned":
            self.table = nn.Parameter(torch.randn(positions, settings.width))
        else:
            self.register_buffer("table", None)
        self._dtype, self._generation = torch.float32, 0
        #: The blocks for acting; see `refresh`.
        self.acting_blocks: list[ActingBlock] = []
        #: The layer `fusion` for acting.
        self.acting_fusion: Affine | None = None
        #: See `ring_ages`.
        self.ages = ring_ages(settings.window, device)
        #: Whether attention spans only the longest episode, whose length is known on the CPU without waiting for a device.
        self.spans = device.type == "cpu"
        self._attended, self._masked = torch.zeros((), device=device), torch.full((), MASKED, device=device)

    @property
    def blocks(self) -> list[Block]:
        """The blocks in order, from input to output."""
        return [block for block in self.layers if isinstance(block, Block)]

    def initial_state(self, num_envs: int) -> TransformerState:
        return TransformerState(self.settings, num_envs, self.device)

    def begin_segment(self, state: TransformerState, steps: int) -> None:
        state.compact(steps)
        state.cache = None

    def refresh(self, dtype: torch.dtype) -> None:
        self._dtype, self._generation = dtype, self._generation + 1
        self.acting_blocks = [ActingBlock(block, dtype) for block in self.blocks]
        self.acting_fusion = None if self.fusion is None else transposed(self.fusion[0], dtype)

    def step(self, x: Tensor, state: TransformerState, reset_mask: Tensor | None) -> tuple[Tensor, TransformerUpdate]:
        cache = self.cache(state)
        position = state.next_position
        if reset_mask is not None:
            position = position.masked_fill(reset_mask, 0)
        if self.acting_fusion is not None:
            previous = state.inputs[-1].select(1, state.fill - 1)
            if reset_mask is not None:
                previous = previous.masked_fill(reset_mask.unsqueeze(-1), 0.0)
            x = linear_relu(torch.cat([x, previous.to(x.dtype)], dim=-1), self.acting_fusion)
        start, length = 0, cache.slots
        if self.spans:
            start, length = cache.span(min(self.past, max(1, int(position.numpy().max()))))
        ages = slice(self.settings.window - cache.slot + start, self.settings.window - cache.slot + start + length)
        distances = None if cache.distances is None else [encoded[:, ages] for encoded in cache.distances]
        first = None if reset_mask is None else reset_mask.unsqueeze(-1)
        attends = self.ages[ages] <= position.unsqueeze(-1)
        bias = torch.where(attends, self._attended, self._masked)[:, None, None].to(self._dtype)
        keys, values = cache.keys_and_values(start, length)
        encoding = self._encoding(position) if self.settings.query_encoding else None
        inputs = []
        for layer, block in enumerate(self.acting_blocks):
            inputs.append(x)
            x = x if encoding is None else x + encoding
            x = block(x, keys[layer], values[layer], bias, first, None if distances is None else distances[layer])
        return x, (inputs, position)

    def update_state(self, state: TransformerState, update: TransformerUpdate) -> None:
        if state.fill == state.inputs.shape[2]:
            state.compact(SPARE_COLUMNS)
        cache, inputs, position = self.cache(state), torch.stack(update[0]).float(), update[1]
        state.inputs.select(2, state.fill).copy_(inputs)
        state.position.select(1, state.fill).copy_(position)
        state.next_position = position + 1
        cache.append(self.encoded(inputs, position))
        state.fill += 1

    def minibatches(
        self,
        states: Sequence[TransformerState],
        reset_mask: Tensor,
        num_minibatches: int,
        generator: torch.Generator,
        own: range | None = None,
        epochs: int = 1,
    ) -> Minibatches[TransformerMinibatch]:
        steps, envs = reset_mask.shape
        own = range(envs) if own is None else own
        length = min(self.settings.sequence_length, steps)
        past = self.past
        if self.spans:
            past = max(1, min(past, max(int(state.position[:, past:].max()) for state in states)))
        # Columns that no query attends to are skipped. Then column c is step c - past.
        skipped, sequences = self.past - past, steps // length
        tokens = torch.cat([self._tokens(state, skipped) for state in states], dim=1)
        position = torch.cat([state.position[:, skipped:] for state in states])
        parts = (self._groups if length == 1 else self._sequences)(tokens, position, past, steps, length)
        previous = None
        if self.fusion is not None:
            queries = slice(past, past + sequences * length)
            before = torch.cat([state.inputs[-1, :, self.past - 1 :][:, : sequences * length] for state in states])
            previous = before.masked_fill((position[:, queries] == 0).unsqueeze(-1), 0.0)
            previous = previous.unflatten(1, (sequences, length)).flatten(0, 1)

        def steps_of(envs: int) -> Tensor:
            """Index of each step of each sequence in the flattened segment, int64 (envs * sequences, length)."""
            indices = torch.arange(sequences * length * envs).view(sequences, length, envs).permute(2, 0, 1)
            return indices.flatten(0, 1).to(self.device)

        steps_here, steps_everywhere = steps_of(len(own)), steps_of(envs) if len(own) < envs else None

        def minibatch(chosen: Tensor) -> TransformerMinibatch:
            chosen = chosen.sort().values
            everywhere = None
            if steps_everywhere is not None:
                everywhere = steps_everywhere[chosen.to(self.device)].flatten()
                chosen = chosen[is_own(chosen // sequences, own)] - own.start * sequences
            indices = steps_here[chosen.to(self.device)].flatten()
            made = parts(chosen, indices, indices if everywhere is None else everywhere)
            if previous is not None:
                made.previous = previous[chosen.to(self.device)]
            return made

        split = shuffled(envs * sequences, num_minibatches, epochs, generator)
        return Minibatches(split, minibatch)

    def _sequences(self, tokens: Tensor, position: Tensor, past: int, steps: int, length: int) -> MakeMinibatch:
        """Makes minibatches of sequences, each with its own tokens.

        Args:
            tokens: See `_tokens`, float (layers, envs, past + steps, width).
            position: Position of each token, int64 (envs, past + steps).
            past: Number of tokens before the segment.
            steps: Steps of the segment.
            length: Steps of a sequence. Sequence s of an environment spans the columns s * length to (s + 1) * length + past.
        """
        envs, columns = position.shape
        tokens, position = tokens.flatten(1, 2), position.flatten()
        offsets = torch.arange(past + length, device=self.device)
        distance = offsets[past:].unsqueeze(1) - offsets
        outside = (distance < 1) | (distance > self.past)
        # The first column of each sequence in the flattened columns of all environments.
        starts = torch.arange(envs).unsqueeze(1) * columns + torch.arange(steps // length) * length
        starts = starts.flatten().to(self.device)

        def minibatch(chosen: Tensor, indices: Tensor, everywhere: Tensor) -> TransformerMinibatch:
            rows = (starts[chosen.to(self.device)].unsqueeze(1) + offsets).flatten()
            positions = position[rows].unflatten(0, (-1, len(offsets)))
            queries = positions[:, past:]
            bias = torch.zeros(len(chosen), *distance.shape, device=self.device)
            bias.masked_fill_(outside | (distance > queries.unsqueeze(-1)), MASKED)
            chosen_tokens = tokens.index_select(1, rows).unflatten(1, (-1, len(offsets)))
            return TransformerMinibatch(
                indices, everywhere, chosen_tokens, positions, queries, bias.unsqueeze(1), distance
            )

        return minibatch

    def _groups(self, tokens: Tensor, position: Tensor, past: int, steps: int, length: int) -> MakeMinibatch:
        """Makes minibatches of single steps, grouped by environment and part of the segment; arguments as for `_sequences`.

        A sequence of one step would need a copy of `past` tokens for each step. The parts are about as long as the past, so that
        a query attends to half of its group's tokens.
        """
        parts = math.ceil(steps / max(past, SHORTEST_PART))
        part = math.ceil(steps / parts)
        padding = parts * part - steps
        query_position = position[:, past:].flatten()
        tokens = functional.pad(tokens, (0, 0, 0, padding)).unfold(2, past + part, part).mT.flatten(1, 2)
        position = functional.pad(position, (0, padding)).unfold(1, past + part, part).flatten(0, 1)
        columns = torch.arange(past + part, device=self.device)
        num_groups = len(position)

        def minibatch(chosen: Tensor, indices: Tensor, everywhere: Tensor) -> TransformerMinibatch:
            step = chosen % steps
            group = chosen // steps * parts + step // part
            count = torch.bincount(group, minlength=num_groups)
            size, number = int(count.max()), torch.arange(len(chosen))
            # The place of each query among the places (group, size), and the query in each of them.
            in_group = number - (count.cumsum(0) - count)[group]
            query = torch.zeros(num_groups, size, dtype=torch.long).index_put_((group, in_group), number)
            head = torch.arange(self.settings.heads).unsqueeze(-1)
            groups = Groups(
                (num_groups, len(head), size),
                (query.unsqueeze(1) + head * len(chosen)).flatten().to(self.device),
                (group * (len(head) * size) + in_group + head * size).flatten().to(self.device),
            )
            column, query = (past + step % part).to(self.device), query.flatten().to(self.device)
            queries = query_position[chosen.to(self.device)].unsqueeze(-1)
            places = (num_groups, 1, size, 1)
            distance = column[query].view(places) - columns
            bias = torch.zeros(distance.shape, device=self.device)
            masked = (distance < 1) | (distance > self.past) | (distance > queries[query].view(places))
            return TransformerMinibatch(
                indices, everywhere, tokens, position, queries, bias.masked_fill_(masked, MASKED), distance, groups
            )

        return minibatch

    def forward(self, x: Tensor, minibatch: TransformerMinibatch) -> Tensor:
        queries = minibatch.query_position
        x = x.unflatten(0, queries.shape)
        if self.fusion is not None:
            assert minibatch.previous is not None
            x = self.fusion(torch.cat([x, minibatch.previous.to(x.dtype)], dim=-1))
        learned = isinstance(self.table, nn.Parameter)
        encoding = self._encoding(minibatch.position) if learned else None
        query_encoding = self._encoding(queries) if self.settings.query_encoding else None
        first = (queries == 0).unsqueeze(-1)
        for block, tokens in zip(self.blocks, minibatch.tokens, strict=True):
            tokens = tokens if encoding is None else normalised(tokens + encoding)
            x = x if query_encoding is None else x + query_encoding
            x = block(x, tokens, minibatch.bias, first, minibatch.distance, minibatch.groups)
        return x.flatten(0, 1)

    def _tokens(self, state: TransformerState, skipped: int) -> Tensor:
        """The tokens for learning, without the first `skipped` columns; see `TransformerMinibatch.tokens`."""
        tokens = state.inputs[:, :, skipped:]
        if isinstance(self.table, nn.Parameter):
            return tokens
        # Tokens have no gradient, so this is done once per segment, not for each minibatch.
        return normalised(self.encoded(tokens, state.position[:, skipped:])).to(self._dtype)

    def encoded(self, tokens: Tensor, position: Tensor) -> Tensor:
        """Tokens with the encodings of their positions int64 (...,) added, if there are any: float32 (layers, ..., width)."""
        return tokens if self.table is None else tokens + self._encoding(position)

    def _encoding(self, position: Tensor) -> Tensor:
        """Encodings of positions int64 (...,), float32 (..., width). Positions beyond the table share its last row."""
        assert self.table is not None
        return functional.embedding(position.clamp(max=self.positions - 1), self.table)

    def cache(self, state: TransformerState) -> RingCache:
        """The keys and values of the state's tokens; recomputed if the weights have changed."""
        if state.cache is None or state.cache.generation != self._generation:
            window = slice(state.fill - self.past, state.fill)
            tokens = self.encoded(state.inputs[:, :, window], state.position[:, window])
            blocks = self.blocks
            attentions = [block.attention for block in blocks]
            projection = Projection(
                [block.norm_tokens for block in blocks],
                [attention.keys for attention in attentions],
                [attention.values for attention in attentions],
                self.settings.heads,
            )
            distances = None
            if attentions[0].relative:
                ages = torch.arange(2 * self.settings.window, device=self.device).neg() % self.settings.window
                distances = [attention.encoded_distances(ages, self._dtype) for attention in attentions]
            state.cache = RingCache(projection, tokens, self._generation, self._dtype, distances)
        return state.cache
