"""A stand-in for a CUDA device on machines without one.

A tensor of this device wraps a CPU tensor. As on CUDA, it is an error to mix tensors of both devices in an operation or to access
the data without a copy. Copies with `non_blocking` between page-locked memory and the device are complete only when the host
waits: then the host receives what was copied, and it is an error if memory that was being uploaded has changed or is not mapped.

Run as a program, this trains on the device and on the CPU, and prints the results of both as JSON:

    python other_device.py FOLDER FLAGS_AS_JSON ...
"""

import contextlib
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.utils import backend_registration
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map_only

from endless_gym import create, interop

NAME = "elsewhere"


class There(torch.Tensor):
    """A tensor of the device; `here` is the wrapped CPU tensor."""

    @staticmethod
    def __new__(cls, here: torch.Tensor) -> "There":
        shape, strides, offset = here.size(), here.stride(), here.storage_offset()
        made = torch.Tensor._make_wrapper_subclass(
            cls, shape, strides=strides, storage_offset=offset, dtype=here.dtype, device=torch.device(NAME, 0)
        )
        made.here = here
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(operation, args, kwargs or {})


class Device(TorchDispatchMode):
    """Dispatches factory functions with `device="elsewhere"`, such as `torch.zeros`."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(operation, args, kwargs or {})


#: Operations whose result, or the shape of it, is needed on the host. On CUDA the host waits for them.
WAITING = {"_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "_unique2", "unique_dim"}
#: Number of operations for which CUDA would wait: copies to the CPU, and those of `WAITING`.
waits: Counter[str] = Counter()
#: Number of copies from the CPU to the device by shape.
uploads: Counter[tuple[int, ...]] = Counter()
#: Addresses and sizes of page-locked memory, with the mapping of memory that `cudaHostRegister` locked.
locked: dict[int, tuple[int, str | None]] = {}
#: Tensors in page-locked memory, which stays so, as that of PyTorch's allocator.
allocated: list[torch.Tensor] = []
#: Copies in flight, in order: the address on the host, and what completes the copy.
in_flight: list[tuple[int, Callable[[], None]]] = []


def complete(count: int | None = None) -> None:
    """Wait for the first `count` copies in flight, or for all."""
    done, in_flight[:] = in_flight[:count], in_flight[len(in_flight) if count is None else count :]
    for _, finish in done:
        finish()


def mapping(address: int) -> str:
    """The line of the mapping that contains an address, with its file; empty for none."""
    with open("/proc/self/maps") as maps:
        for line in maps:
            first, end = (int(number, 16) for number in line.split(maxsplit=1)[0].split("-"))
            if first <= address < end:
                # Names of files that were removed get a suffix.
                return line.removesuffix(" (deleted)\n").strip()
    return ""


def memory_at(address: int, size: int) -> bytes:
    """The bytes at an address, which need not be mapped."""
    with open("/proc/self/mem", "rb", buffering=0) as memory:
        try:
            return os.pread(memory.fileno(), size, address)
        except OSError:
            return b""


def begin(address: int, size: int, finish: Callable[[], None]) -> None:
    """Complete a copy of host memory later, if it is page-locked."""
    for first, (length, mapped) in locked.items():
        if first <= address and address + size <= first + length:
            if mapped is not None and mapping(first) != mapped:
                raise RuntimeError("the device would use pages that were at this address before")
            in_flight.append((address, finish))
            return
    finish()


def uploading(source: torch.Tensor) -> None:
    """Note that the device is reading a tensor on the host."""
    assert source.is_contiguous()
    # Without a reference to the tensor, which would keep its memory.
    address, size = source.data_ptr(), source.nbytes
    now = memory_at(address, size)
    assert len(now) == size

    def finish() -> None:
        if memory_at(address, size) != now:
            raise RuntimeError("host memory changed while the device was reading it")

    begin(address, size, finish)


class Event:
    """As `torch.cuda.Event`."""

    last = None

    def record(self, stream: Any) -> None:
        self.last = in_flight[-1] if in_flight else None

    def synchronize(self) -> None:
        if self.last in in_flight:
            complete(in_flight.index(self.last) + 1)


class Runtime:
    """As CUDA's runtime, whose errors are numbers."""

    @staticmethod
    def cudaHostRegister(first: int, size: int, flags: int) -> int:
        mapped = mapping(first)
        if any(first < other + length and other < first + size for other, (length, _) in locked.items()):
            return 712
        if first % 4096 or size % 4096 or (flags != interop._READ_ONLY and mapped.split()[1][1] != "w"):
            return 1
        locked[first] = size, mapped
        return 0

    @staticmethod
    def cudaHostUnregister(first: int) -> int:
        size, mapped = locked.pop(first)
        if mapping(first) != mapped:
            raise RuntimeError("memory was unmapped before it was unlocked")
        if any(first <= address < first + size for address, _ in in_flight):
            raise RuntimeError("memory was unlocked while the device was using it")
        return 0


def computed(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    name = operation.overloadpacket.__name__
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    there = [tensor for tensor in tensors if isinstance(tensor, There)]
    # Zero-dimensional tensors may be on any device, and copies cross devices.
    here = [tensor for tensor in tensors if not isinstance(tensor, There) and tensor.dim()]
    if there and here and name not in ("_to_copy", "copy_"):
        shapes = [[tuple(tensor.shape) for tensor in some] for some in (there, here)]
        raise RuntimeError(f"{name}: tensors on two devices, of shapes {shapes[0]} and {shapes[1]}")
    to_cpu = name == "copy_" and bool(here) and here[0] is args[0]
    to_cpu |= name == "_to_copy" and torch.device(kwargs.get("device") or NAME).type == "cpu"
    asked = kwargs.get("device")
    is_later = args[2:] == (True,) if name == "copy_" else name == "_to_copy" and kwargs.get("non_blocking", False)
    if there and (to_cpu or name in WAITING):
        waits[name] += 1
        if not is_later:
            complete()
    if kwargs.pop("pin_memory", False):
        made = operation(*args, **kwargs)
        locked[made.data_ptr()] = made.nbytes, None
        allocated.append(made)
        return made
    if to_cpu and is_later and there and name == "copy_":
        target, copied = args[0], args[1].here.clone()
        begin(target.data_ptr(), target.nbytes, lambda: target.copy_(copied))
        return target
    into = isinstance(args[0], There) if name == "copy_" else name == "_to_copy" and asked is not None and not to_cpu
    if here and into:
        uploads[tuple(here[0].shape)] += 1
        if is_later:
            uploading(here[0])
    if asked is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    own = REPLACED.get(name, operation)
    args_here, kwargs_here = tree_map_only(There, lambda tensor: tensor.here, (args, kwargs))
    out = own(*args_here, **kwargs_here)
    is_there = torch.device(asked).type == NAME if asked is not None else bool(there)
    if name == "copy_":
        is_there = isinstance(args[0], There)
    if not is_there or name == "_local_scalar_dense":
        return out
    out = tree_map_only(torch.Tensor, There, out)
    return out if name in REPLACED else return_and_correct_aliasing(operation, args, kwargs, out)


def lstm_cell(x: Any, h: Any, cell: Any, bias_x: Any = None, bias_h: Any = None) -> Any:
    """The fused LSTM cell, which PyTorch calls on devices other than the CPU; it saves the gates for the backward pass."""
    gates = x + h if bias_x is None else x + h + bias_x + bias_h
    into, forget, new, out = gates.chunk(4, 1)
    after = forget.sigmoid() * cell + into.sigmoid() * new.tanh()
    return out.sigmoid() * after.tanh(), after, gates


def lstm_cell_backward(grad_h: Any, grad_c: Any, before: Any, after: Any, gates: Any, has_bias: bool) -> Any:
    given = (grad_h, grad_c, gates, torch.zeros_like(gates), None, None, before, after)
    to_gates, _, to_cell, *_ = torch.ops.aten._thnn_differentiable_lstm_cell_backward(*given)
    return to_gates, to_cell, to_gates.sum(0) if has_bias else None


def gru_cell(x: Any, h: Any, hidden: Any, bias_x: Any = None, bias_h: Any = None) -> Any:
    """The fused GRU cell; it saves the gates and the hidden state for the backward pass."""
    x, h = (x, h) if bias_x is None else (x + bias_x, h + bias_h)
    (reset_x, update_x, new_x), (reset_h, update_h, new_h) = x.chunk(3, 1), h.chunk(3, 1)
    new = (new_x + (reset_x + reset_h).sigmoid() * new_h).tanh()
    return new + (update_x + update_h).sigmoid() * (hidden - new), torch.cat([x, h, hidden], 1)


def gru_cell_backward(grad: Any, kept: Any, has_bias: bool) -> Any:
    width = grad.shape[1]
    x, h, hidden = kept.split([3 * width, 3 * width, width], 1)
    to_x, to_h, to_hidden, *_ = torch.ops.aten._thnn_differentiable_gru_cell_backward(grad, x, h, hidden, None, None)
    return to_x, to_h, to_hidden, to_x.sum(0) if has_bias else None, to_h.sum(0) if has_bias else None


#: Operations that PyTorch calls only on devices other than the CPU.
REPLACED = {
    "_thnn_fused_gru_cell": gru_cell,
    "_thnn_fused_gru_cell_backward": gru_cell_backward,
    "_thnn_fused_lstm_cell": lstm_cell,
    "_thnn_fused_lstm_cell_backward_impl": lstm_cell_backward,
    # A wrapper does not know that its tensor is a conjugate view.
    "_conj": torch.conj_physical,
    # Use the unfused attention.
    "_fused_sdp_choice": lambda *args, **kwargs: 0,
}


class Module(backend_registration._DummyBackendModule):
    """As `torch.cuda`."""

    Event = Event

    def current_stream(self, device: Any) -> None:
        # Without a device, this would be the stream of the current one, which need not be the tensor's.
        assert device.type == NAME

    def cudart(self) -> type[Runtime]:
        return Runtime

    def memory_reserved(self, device: int) -> int:
        return 1

    def synchronize(self, device: int) -> None:
        complete()

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16]


class Generator(torch.Generator):
    """A CPU generator for every device, so that random numbers are equal on all devices."""

    def __new__(cls, device: Any = "cpu") -> torch.Generator:
        return super().__new__(cls, "cpu")


def register() -> None:
    """Register the device with PyTorch; must be called before the first backward pass, and cannot be undone."""
    backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=Module())


@contextlib.contextmanager
def device() -> Iterator[None]:
    """Context in which the device can be used."""
    generator, save, to, cuda = torch.Generator, torch.save, torch.nn.Module.to, create.cuda_to_pin
    torch.Generator = Generator

    def moved(module: torch.nn.Module, *args: Any, **kwargs: Any) -> torch.nn.Module:
        """Replace the parameters, whose class changes with the device."""
        torch.__future__.set_swap_module_params_on_conversion(True)
        to(module, *args, **kwargs)
        torch.__future__.set_swap_module_params_on_conversion(False)
        return module

    torch.nn.Module.to = moved
    create.cuda_to_pin = lambda pin_memory, copy: torch.get_device_module(NAME) if pin_memory else None
    # Files contain CPU tensors; for CUDA tensors, `map_location` has this effect.
    torch.save = lambda state, file: save(tree_map_only(There, lambda tensor: tensor.here.clone(), state), file)
    try:
        with Device():
            yield
    finally:
        torch.Generator, torch.save, torch.nn.Module.to, create.cuda_to_pin = generator, save, to, cuda


def main() -> None:
    from endless_gym_agents.evaluation.evaluate import evaluate
    from endless_gym_agents.training import checkpoint
    from endless_gym_agents.training.train import parse, train

    register()
    folder = Path(sys.argv[1])
    results = []
    for number, flags in enumerate(map(json.loads, sys.argv[2:])):
        both = {}
        for name in ("cpu", NAME):
            settings = replace(parse(flags), device=name, run=str(folder / f"{number}-{name}"))
            with device() if name == NAME else contextlib.nullcontext():
                run = train(settings)
                # Resume from the checkpoint.
                settings = replace(
                    settings, resume=str(run), ppo=replace(settings.ppo, updates=settings.ppo.updates + 1)
                )
                rows = [json.loads(line) for line in (train(settings) / "progress.jsonl").read_text().splitlines()]
                episodes = evaluate(checkpoint.load(run, name).agent, range(2), 1, num_threads=1)
            both[name] = {"rows": rows, "episodes": episodes}
        results.append(both)
    print(json.dumps(results))


if __name__ == "__main__":
    main()
