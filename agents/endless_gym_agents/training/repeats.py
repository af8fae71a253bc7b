"""Equal frames are encoded once, which saves most of the encoder's work where observations repeat.

In Mortar Mayhem and Mystery Path, an agent that stands still or returns to a place sees the same frame again. The encoder and
the layer after it have no memory, so equal frames have equal outputs. While acting, a frame is encoded at its first occurrence
in a segment. While learning, a minibatch encodes each distinct frame once (`Segment.distinct`), and the gradients of equal
frames are added before the encoder.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


class EmbeddedFrames:
    """The embeddings of a segment's frames on the CPU, while the segment is collected with constant weights.

    Frames are compared by a hash, and byte by byte where the hashes are equal.

    Attributes:
        first: Index of the first frame with the same bytes, for each frame that was embedded, int64 (frames,).
    """

    def __init__(self, frames: Tensor) -> None:
        """Begin with no embeddings.

        Args:
            frames: All frames of the segment, uint8 (frames, height, width, channels); each is written before it is embedded.
        """
        self._frames = frames
        self._bytes: NDArray[np.uint8] = frames.flatten(1).numpy()
        self.first = torch.arange(len(frames))
        self._first: NDArray[np.int64] = self.first.numpy()
        self._by_hash: dict[int, int] = {}
        self._embeddings: Tensor | None = None

    def clear(self) -> None:
        """Forget all embeddings: another segment begins, or the weights have changed."""
        self._by_hash.clear()
        self._embeddings = None

    def embed(self, indices: range, embed: Callable[[Tensor], Tensor]) -> Tensor:
        """The embeddings of consecutive frames, float (n, width).

        Args:
            indices: Indices of the n frames.
            embed: Computes the embeddings float (m, width) of m frames.
        """
        new = [index for index in indices if self._find(index) == index]
        if new:
            embeddings = embed(self._frames[new])
            if self._embeddings is None:
                self._embeddings = embeddings.new_empty(len(self._frames), embeddings.shape[1])
            self._embeddings[new] = embeddings
        assert self._embeddings is not None
        return self._embeddings.index_select(0, self.first[indices.start : indices.stop])

    def _find(self, index: int) -> int:
        """Record and return the index of the first frame with the same bytes as the frame `index`."""
        frame = self._bytes[index]
        first = self._by_hash.setdefault(hash(frame.tobytes()), index)
        if first != index and not np.array_equal(self._bytes[first], frame):
            first = index  # another frame with the same hash
        self._first[index] = first
        return first
