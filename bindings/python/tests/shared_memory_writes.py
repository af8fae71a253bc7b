"""Ways to write to the memory of a batch. As a program: tries all of them on a served batch, and prints how many raised.

A write that is not refused kills the process, since the memory of another process is mapped read-only.
"""

import contextlib
import warnings
from collections.abc import Callable

import numpy as np
import torch
import torch.utils.dlpack

import endless_gym

ID = "MortarMayhemB-v0"

#: Modes in which operations reach a tensor's `__torch_dispatch__` differently decomposed.
MODES = [contextlib.nullcontext, torch.no_grad, torch.inference_mode]


class Legacy:
    """What a consumer of DLPack's unversioned protocol passes on."""

    def __init__(self, array: np.ndarray) -> None:
        self.capsule = endless_gym.DLPackView(array).__dlpack__()


def imported(array: np.ndarray) -> torch.Tensor:
    """By a consumer of the unversioned protocol."""
    return torch.utils.dlpack.from_dlpack(Legacy(array).capsule)


def assign(target: object, index: object = ...) -> None:
    target[index] = 1


def tensor_writes() -> dict[str, Callable[[torch.Tensor], object]]:
    """Writes to a tensor of any dtype, by name."""
    return {
        "fill_": lambda t: t.fill_(1),
        "zero_": lambda t: t.zero_(),
        "add_": lambda t: t.add_(1),
        "+=": lambda t: t.__iadd__(1),
        "copy_": lambda t: t.copy_(torch.ones(t.shape)),
        "clamp_": lambda t: t.clamp_(0, 1),
        "random_": lambda t: t.random_(),
        "masked_fill_": lambda t: t.masked_fill_(torch.ones(t.shape, dtype=torch.bool), 1),
        "index_fill_": lambda t: t.index_fill_(0, torch.tensor([0]), 1),
        "index_put_": lambda t: t.index_put_((torch.tensor([0]),), torch.ones(t.shape[1:]).to(t.dtype)),
        "setitem": assign,
        "setitem of a row": lambda t: assign(t, 0),
        "setitem by a mask": lambda t: assign(t, torch.ones(t.shape[0], dtype=torch.bool)),
        "row": lambda t: t[0].fill_(1),
        "part": lambda t: t[:1].fill_(1),
        "iterated": lambda t: next(iter(t)).fill_(1),
        "view": lambda t: t.view(-1).fill_(1),
        "reshape": lambda t: t.reshape(-1).fill_(1),
        "flatten": lambda t: t.flatten().fill_(1),
        "transpose": lambda t: t.movedim(-1, 0).fill_(1),
        "T of a part": lambda t: t.reshape(t.shape[0], -1).T.fill_(1),
        "expand": lambda t: t.expand_as(t).fill_(1),
        "as_strided": lambda t: t.as_strided((1,), (1,)).fill_(1),
        "unsqueeze": lambda t: t.unsqueeze(0).fill_(1),
        "squeeze": lambda t: t.squeeze().fill_(1),
        "unbind": lambda t: t.unbind()[0].fill_(1),
        "split": lambda t: t.split(1)[0].fill_(1),
        "chunk": lambda t: torch.chunk(t, 2)[0].fill_(1),
        "unsafe_split": lambda t: torch.unsafe_split(t, 1)[0].fill_(1),
        "unsafe_split_with_sizes": lambda t: torch.unsafe_split_with_sizes(t, [1] * t.shape[0])[0].fill_(1),
        "unsafe_chunk": lambda t: torch.unsafe_chunk(t, 2)[0].fill_(1),
        "_unsafe_view": lambda t: torch.ops.aten._unsafe_view(t, [-1]).fill_(1),
        "lift": lambda t: torch.ops.aten.lift(t).fill_(1),
        "dropout": lambda t: torch.nn.functional.dropout(t, training=False).fill_(1),
        "type_as": lambda t: t.type_as(torch.zeros(1, dtype=t.dtype)).fill_(1),
        "narrow": lambda t: t.narrow(0, 0, 1).fill_(1),
        "diagonal": lambda t: t.reshape(t.shape[0], -1).diagonal().fill_(1),
        "detach": lambda t: t.detach().fill_(1),
        "data": lambda t: t.data.fill_(1),
        "contiguous": lambda t: t.contiguous().fill_(1),
        "same dtype": lambda t: t.to(t.dtype).fill_(1),
        "same device": lambda t: t.cpu().fill_(1),
        "as_tensor": lambda t: torch.as_tensor(t).fill_(1),
        "asarray": lambda t: torch.asarray(t).fill_(1),
        "another dtype": lambda t: t.view(torch.uint8).fill_(1),
        "a view of a view": lambda t: t[0].reshape(-1)[:1].fill_(1),
        "out": lambda t: torch.ones(t.shape, dtype=t.dtype, out=t),
        "out of add": lambda t: torch.add(t.clone(), 1, out=t),
        "foreach": lambda t: torch._foreach_zero_([t.clone(), t]),
        "operator": lambda t: torch.ops.aten.fill_(t, 1),
        "inplace": lambda t: torch.nn.functional.relu(t, inplace=True),
        "set_": lambda t: t.set_(),
        "resize_": lambda t: t.resize_(0),
        "storage": lambda t: assign(t.storage(), 0),
        "untyped_storage": lambda t: assign(t.untyped_storage(), 0),
        "storage of the base class": lambda t: assign(torch.Tensor.untyped_storage(t), 0),
        "share_memory_": lambda t: t.share_memory_(),
        "numpy": lambda t: assign(t.numpy()),
        "numpy of a part": lambda t: assign(t[:1].numpy()),
        "asarray of numpy": lambda t: assign(np.asarray(t)),
        "flags of numpy": lambda t: t.numpy().setflags(write=True),
        "numpy of the base class": lambda t: assign(torch.Tensor.numpy(t)),
        "from_dlpack": lambda t: torch.from_dlpack(t).fill_(1),
        "to_dlpack": lambda t: torch.from_dlpack(torch.utils.dlpack.to_dlpack(t)).fill_(1),
        "numpy from_dlpack": lambda t: assign(np.from_dlpack(t)),
    }


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
            tensor = endless_gym.torch_view(array)
            count += len(refused(array_writes(), array))
            for mode in MODES:
                with mode():
                    count += len(refused(tensor_writes(), tensor))
            np.testing.assert_array_equal(array, kept)
        print(count)


if __name__ == "__main__":
    main()
