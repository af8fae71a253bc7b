"""Graphs on the CPU that behave as those of CUDA, for tests without a GPU.

* Capturing executes nothing: whatever the captured operations wrote is undone, and their results are no numbers until a replay.
* A replay repeats the operations, with their arguments as they were, on the same memory, without any Python of the captured
  function.
* Only memory that a tensor refers to after the capture is where it was: a replay that needs other memory, from before the graph
  or of another graph, is an error. CUDA would read what is there by then.
* An operation that waits for the device, and access to the numbers of a tensor, cannot be captured.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from operations import VIEWS
from other_device import WAITING
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torch.utils._pytree import tree_leaves, tree_map_only

#: Numbers that no test expects.
POISON = 77


class Place:
    """Where a tensor is in memory, which is not kept.

    Attributes:
        key: Identifies the memory among that of the places of a graph.
    """

    def __init__(self, tensor: torch.Tensor) -> None:
        self.key = address(tensor)
        self.dtype, self.layout = tensor.dtype, (tensor.storage_offset(), tensor.size(), tensor.stride())
        self._storage = StorageWeakRef(tensor.untyped_storage())

    def storage(self) -> torch.UntypedStorage | None:
        """The memory; None if it was freed."""
        return torch.UntypedStorage._new_with_weak_ptr(self._storage.cdata)

    def tensor(self, temporary: dict[int, torch.UntypedStorage]) -> torch.Tensor:
        """The tensor, in this memory or in that of a replay."""
        storage = self.storage() or temporary.get(self.key)
        if storage is None:
            raise RuntimeError(f"the graph uses memory that was freed, of a tensor of shape {tuple(self.layout[1])}")
        return torch.empty(0, dtype=self.dtype).set_(storage, *self.layout)


class Recording(TorchDispatchMode):
    """Context that executes operations and records them.

    Attributes:
        calls: The operations that compute something, with the places of arguments and results.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Any, Any, Any, Any]] = []
        # The memory that the operations allocate, and other memory that they overwrite with what was there, by address.
        self._own: dict[int, torch.Tensor] = {}
        self._overwritten: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name, kwargs = operation.overloadpacket.__name__, kwargs or {}
        if name in WAITING:
            raise RuntimeError(f"{name} waits for the device, which cannot be captured")
        for index, argument in enumerate(operation._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                written = args[index] if index < len(args) else kwargs[argument.name]
                if address(written) not in self._own and address(written) not in self._overwritten:
                    self._overwritten[address(written)] = (written, whole(written).clone())
        result = operation(*args, **kwargs)
        given = set(map(address, tensors_of((args, kwargs))))
        self._own |= {address(tensor): tensor for tensor in tensors_of(result) if address(tensor) not in given}
        if name not in VIEWS:
            self.calls.append((operation, *tree_map_only(torch.Tensor, Place, (args, kwargs, result))))
        return result

    def finish(self) -> None:
        """Undo what the operations wrote, and forget their results."""
        for tensor, kept in self._overwritten.values():
            whole(tensor).copy_(kept)
        for tensor in self._own.values():
            whole(tensor).fill_(POISON)
        self._own.clear()
        self._overwritten.clear()

    @torch.no_grad()
    def replay(self) -> None:
        """Repeat the operations."""
        temporary: dict[int, torch.UntypedStorage] = {}
        for operation, args, kwargs, result in self.calls:
            given = {place.key for place in places_of((args, kwargs))}
            args, kwargs = tree_map_only(Place, lambda place: place.tensor(temporary), (args, kwargs))
            for place, tensor in zip(places_of(result), tensors_of(operation(*args, **kwargs)), strict=True):
                if place.key in given:
                    continue
                if place.storage() is None:
                    temporary[place.key] = tensor.untyped_storage()
                else:
                    place.tensor(temporary).copy_(tensor)


def tensors_of(values: Any) -> list[torch.Tensor]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, torch.Tensor)]


def places_of(values: Any) -> list[Place]:
    return [leaf for leaf in tree_leaves(values) if isinstance(leaf, Place)]


def address(tensor: torch.Tensor) -> int:
    return tensor.untyped_storage()._cdata


def whole(tensor: torch.Tensor) -> torch.Tensor:
    """The bytes of a tensor's storage."""
    return torch.empty(0, dtype=torch.uint8).set_(tensor.untyped_storage())


class RecordedGraphs:
    """Stands in for `endless_gym_agents.graphs.CudaGraphs`.

    Attributes:
        captures: Number of operations in each graph, without those that only make a view.
        replays: Number of replays.
    """

    def __init__(self) -> None:
        self.captures: list[int] = []
        self.replays = 0

    def warm_up(self, function: Callable[[], None]) -> None:
        for _ in range(2):
            function()

    def capture(self, function: Callable[[], None]) -> Callable[[], None]:
        numpy = torch.Tensor.numpy
        torch.Tensor.numpy = refuse
        recording = Recording()
        try:
            with recording:
                function()
        finally:
            torch.Tensor.numpy = numpy
        recording.finish()
        self.captures.append(len(recording.calls))

        def replay() -> None:
            self.replays += 1
            # One launch, whatever a test counts.
            with _disable_current_modes():
                recording.replay()

        return replay


def refuse(*args: Any, **kwargs: Any) -> None:
    raise RuntimeError("the numbers of a tensor cannot be read while a graph is captured")
