"""Ways to write to the memory of a batch. As a program, tries all of them on a served batch and prints how many raised.

A write that is not refused kills the process, since the memory of an engine process is mapped read-only.
"""

import warnings
from collections.abc import Callable

import numpy as np
import torch
import torch.utils.dlpack

import endless_gym

ID = "MortarMayhemB-v0"


class Legacy:
    """An array as a consumer of DLPack's unversioned protocol receives it."""

    def __init__(self, array: np.ndarray) -> None:
        self.capsule = endless_gym.DLPackView(array).__dlpack__()


def imported(array: np.ndarray) -> torch.Tensor:
    """The array, imported by a consumer of the unversioned protocol."""
    return torch.utils.dlpack.from_dlpack(Legacy(array).capsule)


def assign(target: object, index: object = ...) -> None:
    target[index] = 1


def array_writes() -> dict[str, Callable[[np.ndarray], object]]:
    """Writes to an array, by name."""
    return {
        "setitem": assign,
        "part": lambda a: assign(a[:1]),
        "flags": lambda a: a.setflags(write=True),
        "memoryview": lambda a: assign(memoryview(a).cast("B"), 0),
        "DLPackView, unversioned": lambda a: imported(a).fill_(1),
        "DLPackView, unversioned part": lambda a: imported(a[:1]).fill_(1),
        "DLPackView, PyTorch": lambda a: torch.from_dlpack(endless_gym.DLPackView(a)).fill_(1),
        "DLPackView, PyTorch's other name": lambda a: torch.utils.dlpack.from_dlpack(endless_gym.DLPackView(a)).fill_(
            1
        ),
        "DLPackView, numpy": lambda a: assign(np.from_dlpack(endless_gym.DLPackView(a))),
    }


def refused(writes: dict[str, Callable[[object], object]], target: object) -> list[str]:
    """Names of the writes that raised; all must."""
    names = []
    for name, write in writes.items():
        try:
            write(target)
        except (BufferError, RuntimeError, TypeError, ValueError):
            names.append(name)
        else:
            raise AssertionError(f"not refused: {name}")
    return names


def main() -> None:
    warnings.simplefilter("error")
    with endless_gym.serve(ID, 2, seed=1, observation="rgb+features", batches_held=16) as envs:
        envs.reset()
        observation, *_ = envs.step(np.ones((2, 2), np.int64))
        count = 0
        for array in observation.values():
            kept = array.copy()
            count += len(refused(array_writes(), array))
            np.testing.assert_array_equal(array, kept)
        print(count)


if __name__ == "__main__":
    main()
