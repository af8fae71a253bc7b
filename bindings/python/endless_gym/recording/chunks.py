"""Arrays that grow by one row per step and are compressed in chunks as they grow."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: The fastest level: frames are mostly areas of one colour, which higher levels hardly compress further.
LEVEL = 1

#: Largest size of a chunk in bytes. HDF5 caches 1 MB of an array, so reading frames in order decompresses each chunk only once.
CHUNK_BYTES = 2**20


@dataclass(frozen=True)
class Chunks:
    """An array in compressed chunks along its first axis, as HDF5's deflate filter stores it. Zeros fill the last chunk.

    Attributes:
        shape: Shape of the array.
        dtype: Its dtype.
        rows: Rows of each chunk.
        data: The chunks.
    """

    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    rows: int
    data: list[bytes]

    @staticmethod
    def of(array: NDArray[Any]) -> Chunks:
        """A small array in one chunk."""
        return Chunks(array.shape, array.dtype, len(array), [zlib.compress(array.tobytes(), LEVEL)])


class GrowingArrays:
    """One growing array for each of n environments."""

    def __init__(self, num_envs: int, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
        """Make empty arrays whose rows have this shape and dtype."""
        row_bytes = int(np.prod(shape, dtype=np.int64)) * dtype.itemsize
        self._rows = max(1, min(256, CHUNK_BYTES // row_bytes))
        self._block = np.zeros((num_envs, self._rows, *shape), dtype)
        self._chunks: list[list[bytes]] = [[] for _ in range(num_envs)]
        self._count = 0

    def append(self, values: NDArray[Any], active: NDArray[np.bool_]) -> None:
        """Append a row to each array; those of environments that are not active are lost."""
        place = self._count % self._rows
        self._block[:, place] = values
        self._count += 1
        if place == self._rows - 1:
            for env in np.flatnonzero(active):
                self._chunks[env].append(zlib.compress(self._block[env], LEVEL))

    def finish(self, env: int) -> Chunks:
        """The array of an environment, which must have been active in every `append` so far."""
        block, chunks = self._block[env], self._chunks[env]
        place = self._count % self._rows
        rows = self._rows if chunks else place
        if place:
            block[place:] = 0
            chunks.append(zlib.compress(block[:rows], LEVEL))
        return Chunks((self._count, *block.shape[1:]), block.dtype, rows, chunks)
