"""Tensors in the format safetensors, in which the trainer in Rust (`endless learn`) writes checkpoints and reads weights.

A file is the length of a header (uint64), the header (JSON), and the numbers, all little-endian. The header has the dtype, the
shape and the place of each tensor by its name.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

#: Ending of the files.
SUFFIX = ".safetensors"

_LENGTH = struct.Struct("<Q")
_DTYPES = {"F32": "<f4", "U8": "u1", "U64": "<u8"}


def write(file: Path, weights: dict[str, Tensor]) -> None:
    """Write float32 tensors by name."""
    header: dict[str, dict[str, object]] = {}
    parts: list[bytes] = []
    offset = 0
    for name, tensor in weights.items():
        content = tensor.detach().cpu().numpy().astype("<f4").tobytes()
        span = [offset, offset + len(content)]
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": span}
        offset = span[1]
        parts.append(content)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    file.write_bytes(b"".join([_LENGTH.pack(len(text)), text, *parts]))


def read(file: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read the tensors by name, and the metadata.

    Raises:
        ValueError: The file is not of this format, is truncated, or has a tensor of another dtype.
    """
    content = file.read_bytes()
    try:
        (length,) = _LENGTH.unpack_from(content)
        header = json.loads(content[_LENGTH.size : _LENGTH.size + length])
        metadata, rest, tensors = header.pop("__metadata__", {}), content[_LENGTH.size + length :], {}
        for name, part in header.items():
            start, end = part["data_offsets"]
            dtype, shape = np.dtype(_DTYPES[part["dtype"]]), part["shape"]
            if not 0 <= start <= end <= len(rest) or end - start != math.prod(shape) * dtype.itemsize:
                raise ValueError(f"{name} has {end - start} bytes at {start}, in a file with {len(rest)}")
            tensors[name] = torch.from_numpy(np.frombuffer(rest[start:end], dtype).copy().reshape(shape))
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError, struct.error) as error:
        raise ValueError(f"{file} is not a file of safetensors, or is truncated: {error}") from error
    return tensors, metadata
