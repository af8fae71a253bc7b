"""Counts the operations that PyTorch dispatches."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Operations(TorchDispatchMode):
    """Context that counts operations, except those that only make a view, since they compute nothing.

    Attributes:
        calls: Number of calls by name of the operation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: Counter[str] = Counter()

    @property
    def computed(self) -> int:
        """Number of operations that compute something."""
        return self.calls.total()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = operation.overloadpacket.__name__
        if not operation.is_view and name not in ("_unsafe_view", "unsafe_split"):
            self.calls[name] += 1
        return operation(*args, **(kwargs or {}))


class Products(TorchDispatchMode):
    """Context that records in which type each layer computes its products.

    Attributes:
        types: The types by number of weights, of matrix products and convolutions.
    """

    def __init__(self) -> None:
        super().__init__()
        self.types: dict[int, set[torch.dtype]] = {}

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        position = {"convolution": 1, "mm": 1, "addmm": 2}.get(operation.overloadpacket.__name__)
        if position is not None:
            weight = args[position]
            self.types.setdefault(weight.numel(), set()).add(weight.dtype)
        return operation(*args, **(kwargs or {}))
