"""The KV cache of the Transformer-XL for acting: keys and values of the last steps, in a ring of fixed size.

All environments step together, so the step of each slot is known on the host: no operation waits for the device, and all shapes
are constant. The ring has as many slots as the window has steps; the current slot still holds the step that has just left the
window.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def ring_ages(slots: int, device: torch.device) -> Tensor:
    """Ages of the slots of a ring in steps, for every current slot: int64 (2 * slots,).

    If s is the current slot, the age of slot j is entry `slots - s + j`. The current slot has no step yet, so its age is the
    largest int64.
    """
    ages = torch.arange(2 * slots, device=device).neg() % slots
    return ages.masked_fill(ages == 0, torch.iinfo(torch.int64).max)


class Projection:
    """Projects the tokens of all blocks to keys and values at once."""

    def __init__(
        self, norms: Sequence[nn.LayerNorm], keys: Sequence[nn.Linear], values: Sequence[nn.Linear], heads: int
    ) -> None:
        """Copy and stack the weights of the blocks; later changes have no effect.

        Args:
            norms: The layer normalisation of the tokens of each block.
            keys: The key projection of each block, of a whole token or of each head's slice of it.
            values: As `keys`.
            heads: Number of heads.
        """
        self.heads, self.size, self.rows = heads, norms[0].normalized_shape[0] // heads, keys[0].in_features
        self.scale = torch.stack([norm.weight.detach() for norm in norms]).unsqueeze(1)
        self.shift = torch.stack([norm.bias.detach() for norm in norms]).unsqueeze(1)
        matrices = []
        for pair in zip(keys, values, strict=True):
            parts = [layer.weight.detach().view(-1, self.size, self.rows) for layer in pair]
            # For each head its key, then its value; with shared heads there is one matrix for all.
            matrices.append(torch.cat(parts, dim=1).flatten(0, 1).t())
        self.matrices = torch.stack(matrices)  # (layers, rows, outputs)

    def __call__(self, tokens: Tensor) -> Tensor:
        """Keys and values float (layers, m, heads, 2 * head size), of tokens with positions added, float32 (layers, m, width)."""
        normal = functional.layer_norm(tokens, tokens.shape[-1:])
        normal = torch.addcmul(self.shift, normal, self.scale).view(len(self.matrices), -1, self.rows)
        return torch.bmm(normal, self.matrices).view(*tokens.shape[:2], self.heads, 2 * self.size)


class RingCache:
    """Keys and values of n environments.

    Attributes:
        slot: Slot of the current step.
        generation: Number of the weights that computed the keys and values; see `TransformerMemory.refresh`.
        distances: Projected encodings of the ages of `ring_ages` for each block, float (heads, 2 * slots, head size); None
            without relative encoding.
    """

    def __init__(
        self,
        projection: Projection,
        tokens: Tensor,
        generation: int,
        dtype: torch.dtype,
        distances: list[Tensor] | None,
    ) -> None:
        """Make the cache for the window before the current step.

        Args:
            projection: Projects the tokens.
            tokens: The last `slots - 1` tokens with positions added, float32 (layers, n, slots - 1, width).
            generation: See the attribute.
            dtype: Type of the keys and values.
            distances: See the attribute.
        """
        layers, envs, past, _ = tokens.shape
        self.projection, self.generation, self.distances = projection, generation, distances
        self.size, self.slots, self.slot = projection.size, past + 1, past
        shape = (layers, envs, projection.heads, self.slots, 2 * self.size)
        self._ring = torch.zeros(shape, dtype=dtype, device=tokens.device)
        projected = projection(tokens.flatten(1, 2)).unflatten(1, (envs, past))
        self._ring[:, :, :, :past] = projected.transpose(2, 3)
        self._columns = self._ring.unbind(3)
        self._all = self._split(self._ring)

    def span(self, past: int) -> tuple[int, int]:
        """First slot and number of slots of a part of the ring that contains the last `past` steps."""
        return (self.slot - past, past) if past <= self.slot else (0, self.slots)

    def keys_and_values(self, start: int, length: int) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Keys and values of each block, float (n, heads, length, head size), of the slots from `start` on."""
        return self._all if length == self.slots else self._split(self._ring.narrow(3, start, length))

    def append(self, tokens: Tensor) -> None:
        """Write the current step's tokens, float32 (layers, n, width), with positions added, and advance to the next slot."""
        self._columns[self.slot].copy_(self.projection(tokens))
        self.slot = (self.slot + 1) % self.slots

    def _split(self, slots: Tensor) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        return slots.narrow(4, 0, self.size).unbind(), slots.narrow(4, self.size, self.size).unbind()
