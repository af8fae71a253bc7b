"""A block of the Transformer-XL and the GTrXL: attention, and a fully connected layer, each with a residual connection or gate.

`Block` learns: it computes all queries of a minibatch at once. `ActingBlock` computes one step of each environment from cached
keys and values. `transformer` says what a query attends to.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym_agents.memories.layers import linear_relu, transposed
from endless_gym_agents.settings import Transformer

#: Added to the score of a token that a query does not attend to. Finite, so that the softmax of a fully masked row and its
#: gradient are finite with every attention kernel; the output of such a row is set to 0.
MASKED = -1e30


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


def normalised(tokens: Tensor) -> Tensor:
    """Tokens with mean 0 and variance 1: layer normalisation without gain and bias, float (..., width)."""
    return functional.layer_norm(tokens, tokens.shape[-1:])


@dataclass
class Groups:
    """Assignment of the queries of single steps to G groups with K places per head. Some places are empty.

    Attributes:
        shape: G, heads and K.
        query: Row of the query in each place among float (heads * n, size), int64 (G * heads * K,); an arbitrary row for an
            empty place.
        place: Place of each query, int64 (heads * n,).
    """

    shape: tuple[int, int, int]
    query: Tensor
    place: Tensor

    def gather(self, x: Tensor) -> Tensor:
        """Put the queries, float (heads, n, size), into their places: float (G, heads, K, size)."""
        gathered: Tensor = x.flatten(0, 1).index_select(0, self.query).unflatten(0, self.shape)
        return gathered

    def scatter(self, x: Tensor) -> Tensor:
        """The inverse of `gather`, without the empty places: float (heads, n, size)."""
        scattered: Tensor = x.flatten(0, 2).index_select(0, self.place).unflatten(0, (self.shape[1], -1))
        return scattered


class Attention(nn.Module):
    """Multi-head attention with a separate projection, so that the keys and values of a token are computed once and reused."""

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
        # As in the paper's implementation, scores are divided by the square root of the full width, not of the head size.
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

    def forward(
        self,
        x: Tensor,
        tokens: Tensor,
        norm: nn.LayerNorm,
        bias: Tensor,
        first: Tensor,
        distance: Tensor,
        groups: Groups | None,
    ) -> Tensor:
        """Scaled dot-product attention.

        Args:
            x: Inputs of the queries, float (n, queries, width).
            tokens: Normalised tokens with positions added, float (n, tokens, width).
            norm: Layer normalisation of the tokens; its gain and bias are applied here.
            bias: Attention mask, float32 (n, 1, queries, tokens); 0 where the query attends to the token, else `MASKED`.
            first: Whether the query attends to no token, bool (n, queries, 1).
            distance: Steps from the token to the query, int64 (queries, tokens); used by the relative encoding.
            groups: Places of the single queries of x, float (n, 1, width), in groups of K. Then `tokens` is (G, tokens, width),
                `bias` (G, 1, K, tokens), and `distance` (G, 1, K, tokens).

        Returns:
            float (n, queries, width).
        """
        queries = self.project(self.queries, x)
        if groups is not None:
            queries = queries.squeeze(2).transpose(0, 1)  # (heads, n, head size)
        if self.relative:
            # Relative encoding of Dai et al., 2019: a content term and a distance term, each with a learned bias. A distance is
            # at most the number of tokens.
            encoded = self.encoded_distances(torch.arange(tokens.shape[-2] + 1, device=x.device), x.dtype)
            placed = queries if groups is None else groups.gather(queries)
            scores = (placed + self.distance_bias) @ encoded.transpose(-2, -1)  # (n or G, heads, queries, distances)
            chosen = distance.clamp(min=0).expand(*scores.shape[:2], *distance.shape[-2:])
            bias = scores.gather(-1, chosen) * self.scale + bias
            queries = queries + self.content_bias
        keys, values = self._folded(self.keys, norm), self._folded(self.values, norm)
        tokens = tokens.to(queries.dtype)
        if groups is None:
            keys, values = self._projected(tokens, keys), self._projected(tokens, values)
            summed = functional.scaled_dot_product_attention(queries, keys, values, bias, scale=self.scale)
            summed = summed.transpose(1, 2)
        else:
            summed = self._few_queries(queries, tokens, keys, values, bias, groups).transpose(0, 1).unsqueeze(1)
        # The normalisation's bias adds a constant to all scores of a query, which the softmax ignores, and one to all values.
        summed = summed + self.project(self.values, norm.bias.unsqueeze(0)).squeeze(1)
        out: Tensor = self.fc_out(summed.flatten(-2).masked_fill(first, 0.0))
        return out

    def _folded(self, layer: nn.Linear, norm: nn.LayerNorm) -> Tensor:
        """The projection of normalised tokens, with the gain of the normalisation: float (heads, head size, inputs).

        The inputs are the whole token, or with shared heads the head's slice of it. Folding the gain into the projection avoids
        operations of the size of the tokens for the gain and, except with learned positions, for its gradient.
        """
        if layer.in_features != self.size:
            return layer.weight.view(self.heads, self.size, -1) * norm.weight
        return layer.weight * norm.weight.view(self.heads, 1, self.size)

    def _projected(self, tokens: Tensor, projection: Tensor) -> Tensor:
        """Project tokens, float (n, tokens, width), by what `_folded` returned: float (n, heads, tokens, head size)."""
        projected: Tensor
        if projection.shape[-1] != self.size:
            projected = functional.linear(tokens, projection.flatten(0, 1)).unflatten(-1, (self.heads, self.size))
            return projected.transpose(1, 2)
        slices = tokens.flatten(0, 1).unflatten(-1, (self.heads, self.size)).transpose(0, 1)
        projected = torch.bmm(slices, projection.mT).unflatten(1, tokens.shape[:2])
        return projected.transpose(0, 1)

    def _few_queries(
        self, queries: Tensor, tokens: Tensor, keys: Tensor, values: Tensor, bias: Tensor, groups: Groups
    ) -> Tensor:
        """Attention of a few queries to each group of tokens, without the projection of each token.

        Args:
            queries: float (heads, n, head size).
            tokens: Normalised tokens, float (G, tokens, width).
            keys: What `_folded` returned.
            values: What `_folded` returned.
            bias: Added to the scores, float (G, heads or 1, K, tokens).
            groups: The places of the queries.

        Returns:
            float (heads, n, head size).
        """
        keys, values = self._of_whole_tokens(keys), self._of_whole_tokens(values)
        placed = groups.gather(torch.bmm(queries, keys))
        heads = placed.shape[1:3]
        scores = torch.add(bias, (placed.flatten(1, 2) @ tokens.mT).unflatten(1, heads), alpha=self.scale)
        weights = scores.softmax(-1).to(tokens.dtype)
        summed = (weights.flatten(1, 2) @ tokens).unflatten(1, heads)
        return torch.bmm(groups.scatter(summed), values.mT)

    def _of_whole_tokens(self, projection: Tensor) -> Tensor:
        """What `_folded` returned, as the projections of whole tokens: float (heads, head size, width)."""
        if projection.shape[-1] != self.size:
            return projection
        own = torch.eye(self.heads, device=projection.device)[:, None, :, None]
        return (own * projection[:, :, None]).flatten(2)

    def encoded_distances(self, distances: Tensor, dtype: torch.dtype) -> Tensor:
        """Projected encodings of distances int64 (k,), float (heads, k, head size); only with the relative encoding."""
        return self.project(self.distances, sinusoids(distances, self.heads * self.size).to(dtype))


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
        """Make the block with the weight initialisation of the settings."""
        super().__init__()
        width = settings.width
        self.norm_query, self.norm_tokens, self.norm_fc = nn.LayerNorm(width), nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = Attention(settings)
        self.fc = nn.Linear(width, width)
        gate = settings.gate_bias
        self.gate_attention = Gate(width, gate) if settings.gating else None
        self.gate_fc = Gate(width, gate) if settings.gating else None
        self._initialise(settings.initialisation, settings.layers)

    def forward(
        self, x: Tensor, tokens: Tensor, bias: Tensor, first: Tensor, distance: Tensor, groups: Groups | None
    ) -> Tensor:
        """The block's output, float (n, queries, width); arguments as for `Attention.forward`."""
        attended: Tensor = self.attention(self.norm_query(x), tokens, self.norm_tokens, bias, first, distance, groups)
        x = x + attended if self.gate_attention is None else self.gate_attention(x, attended)
        added: Tensor = self.fc(self.norm_fc(x)).relu()
        out: Tensor = x + added if self.gate_fc is None else self.gate_fc(x, added)
        return out

    def _initialise(self, kind: str, layers: int) -> None:
        """Initialise the matrices, including those of the gates; the biases of the relative encoding stay 0."""
        for module in self.modules():
            if not isinstance(module, nn.Linear):
                continue
            # A gate's layer holds several square matrices, one for each part of the gate.
            gates = 1 if module.weight.shape[0] == module.weight.shape[1] else module.out_features // module.in_features
            for weight in module.weight.chunk(gates):
                if kind == "orthogonal":
                    nn.init.orthogonal_(weight, 2**0.5)
                elif kind == "kaiming":
                    nn.init.kaiming_uniform_(weight)
                else:
                    nn.init.xavier_uniform_(weight)
        if kind == "tfixup":
            # As in the authors' code, which scales the output projection only. T-Fixup (Huang et al., 2020) scales more matrices.
            with torch.no_grad():
                self.attention.fc_out.weight.mul_(0.67 * layers**-0.25)


class ActingBlock:
    """A block for one step of n environments, with few operations, as `agent.acting` has for the other layers.

    Weights that need no transposition or conversion are shared with the block, not copied.
    """

    def __init__(self, block: Block, dtype: torch.dtype) -> None:
        """Prepare the weights of `block`, to compute in `dtype`."""
        attention = block.attention
        self.heads, self.size, self.scale = attention.heads, attention.size, attention.scale
        self.rows = attention.queries.in_features  # a head's slice, or the whole vector
        self.queries = attention.queries.weight.detach().t().to(dtype)
        self.fc_out, self.fc = transposed(attention.fc_out, dtype), transposed(block.fc, dtype)
        self.norm_query, self.norm_fc = (
            (norm.normalized_shape, norm.weight.detach(), norm.bias.detach())
            for norm in (block.norm_query, block.norm_fc)
        )
        self.gate_attention, self.gate_fc = block.gate_attention, block.gate_fc
        self.content_bias = attention.content_bias.detach() if attention.relative else None
        self.distance_bias = attention.distance_bias.detach() if attention.relative else None

    def __call__(
        self, x: Tensor, keys: Tensor, values: Tensor, bias: Tensor, first: Tensor | None, encoded: Tensor | None
    ) -> Tensor:
        """The block's output, float (n, width).

        Args:
            x: float (n, width).
            keys: float (n, heads, tokens, head size).
            values: float (n, heads, tokens, head size).
            bias: Attention mask, float (n, 1, 1, tokens); 0 or `MASKED`.
            first: Whether the query attends to no token, bool (n, 1); None if every query attends to some.
            encoded: Projected encodings of the distances of the tokens, float (heads, tokens, head size); None without relative
                encoding.
        """
        normal = functional.layer_norm(x, *self.norm_query)
        queries = torch.mm(normal.view(-1, self.rows), self.queries).view(-1, self.heads, 1, self.size)
        if encoded is not None:
            assert self.content_bias is not None and self.distance_bias is not None
            bias = torch.add(bias, (queries + self.distance_bias) @ encoded.transpose(-2, -1), alpha=self.scale)
            queries = queries + self.content_bias
        summed = functional.scaled_dot_product_attention(queries, keys, values, bias, scale=self.scale)
        summed = summed.transpose(1, 2).reshape(x.shape)
        if first is not None:
            summed = summed.masked_fill(first, 0.0)
        attended = torch.addmm(self.fc_out[0], summed, self.fc_out[1])
        x = x + attended if self.gate_attention is None else self.gate_attention(x, attended)
        added = linear_relu(functional.layer_norm(x, *self.norm_fc), self.fc)
        out: Tensor = x + added if self.gate_fc is None else self.gate_fc(x, added)
        return out
