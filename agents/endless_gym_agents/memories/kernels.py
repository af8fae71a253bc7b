"""GRU, LSTM and minGRU layers, computed by the native kernels of `endless_gym`, on the CPU in float32.

The kernels read and write the tensors' memory. Their documentation, the crate `endless-gym-kernels`, has the equations. A kernel
uses one thread, so the sequences are divided among PyTorch's threads. T is the number of steps, S the number of sequences, H the
hidden size. Resets, bool (T, S), mark the steps before which the state is 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, reduce
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from endless_gym import _native

#: Fewest sequences for a thread, so that the products have several rows.
SEQUENCES_PER_THREAD = 4


def _shares(sequences: int) -> list[slice]:
    """The sequences of each thread."""
    count = max(1, min(torch.get_num_threads(), sequences // SEQUENCES_PER_THREAD))
    return [slice(*ends) for ends in pairwise(np.linspace(0, sequences, count + 1, dtype=int).tolist())]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="endless-kernels")


def _each(compute: Callable[..., tuple[Tensor, ...]], *of_shares: Sequence[Any]) -> list[tuple[Tensor, ...]]:
    """What `compute` returns for each share, by the kind of tensor."""
    run = map if len(of_shares[0]) == 1 else _pool().map
    return list(zip(*run(compute, *of_shares), strict=True))


def _array(tensor: Tensor) -> NDArray[Any]:
    """The tensor's memory; a copy if it is not contiguous."""
    array: NDArray[Any] = tensor.detach().contiguous().numpy()
    return array


def _rows(tensor: Tensor) -> NDArray[Any]:
    """As `_array`, for a tensor (T, S, width), with one row for each step of each sequence."""
    return _array(tensor).reshape(-1, tensor.shape[-1])


def _empty(like: Tensor, share: slice, *widths: int) -> list[Tensor]:
    """Uninitialised tensors (T, sequences of the share, width)."""
    return [like.new_empty(len(like), share.stop - share.start, width) for width in widths]


def _joined(parts: Sequence[Tensor], dim: int = 1) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts), dim)


class KernelGRU(torch.autograd.Function):
    """A GRU layer with the gates of `torch.nn.GRU`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, hidden: Tensor, resets: Tensor) -> Tensor:
        """The hidden states after all steps, float32 (T, S, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs with their bias, float32 (T, S, 3 * H).
            weight: Recurrent weights `weight_hh` float32 (3 * H, H).
            bias: Recurrent bias `bias_hh` float32 (3 * H,).
            hidden: Hidden states before the first step, float32 (S, H).
            resets: Whether the state before each step is 0, bool (T, S).
        """
        width, shared = hidden.shape[1], (_array(weight), _array(bias))

        def compute(share: slice) -> tuple[Tensor, ...]:
            saved, outputs = _empty(inputs, share, 5 * width, width)
            given = _rows(inputs[:, share]), *shared, _array(hidden[share]), _array(resets[:, share])
            _native.gru_forward(*given, _rows(saved), _rows(outputs))
            return saved, outputs

        ctx.shares = _shares(len(hidden))
        saved, outputs = _each(compute, ctx.shares)
        ctx.save_for_backward(weight, resets, *saved)
        return _joined(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, bias and hidden states."""
        weight, resets, *saved = ctx.saved_tensors
        width = grad.shape[2]

        def compute(share: slice, saved: Tensor) -> tuple[Tensor, ...]:
            (inputs,), hidden = _empty(grad, share, 3 * width), grad.new_empty(saved.shape[1], width)
            grad_weight, bias = grad.new_zeros(weight.shape), grad.new_zeros(3 * width)
            given = _array(weight), _rows(saved), _rows(grad[:, share]), _array(resets[:, share])
            _native.gru_backward(*given, _rows(inputs), _array(grad_weight), _array(bias), _array(hidden))
            return inputs, grad_weight, bias, hidden

        inputs, weights, biases, hidden = _each(compute, ctx.shares, saved)
        return _joined(inputs), reduce(torch.add, weights), reduce(torch.add, biases), _joined(hidden, 0), None


class KernelLSTM(torch.autograd.Function):
    """An LSTM layer with the gates of `torch.nn.LSTM`."""

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, weight: Tensor, hidden: Tensor, cell: Tensor, resets: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The hidden states after all steps, float32 (T, S, H), and the cell states after the last, without gradient (S, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs with both biases, float32 (T, S, 4 * H).
            weight: Recurrent weights `weight_hh` float32 (4 * H, H).
            hidden: Hidden states before the first step, float32 (S, H).
            cell: Cell states before the first step, float32 (S, H).
            resets: Whether the state before each step is 0, bool (T, S).
        """
        width, shared = hidden.shape[1], _array(weight)

        def compute(share: slice) -> tuple[Tensor, ...]:
            saved, outputs, cells = _empty(inputs, share, 7 * width, width, width)
            states = _array(hidden[share]), _array(cell[share])
            given = _rows(inputs[:, share]), shared, *states, _array(resets[:, share])
            _native.lstm_forward(*given, _rows(saved), _rows(outputs), _rows(cells))
            return saved, outputs, cells[-1]

        ctx.shares = _shares(len(hidden))
        saved, outputs, cells = _each(compute, ctx.shares)
        ctx.save_for_backward(weight, resets, *saved)
        last = _joined(cells, 0)
        ctx.mark_non_differentiable(last)
        return _joined(outputs), last

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, hidden states and cell states."""
        weight, resets, *saved = ctx.saved_tensors
        width = grad.shape[2]

        def compute(share: slice, saved: Tensor) -> tuple[Tensor, ...]:
            (inputs,), grad_weight = _empty(grad, share, 4 * width), grad.new_zeros(weight.shape)
            hidden, cell = (grad.new_empty(saved.shape[1], width) for _ in range(2))
            given = _array(weight), _rows(saved), _rows(grad[:, share]), _array(resets[:, share])
            _native.lstm_backward(*given, _rows(inputs), _array(grad_weight), _array(hidden), _array(cell))
            return inputs, grad_weight, hidden, cell

        inputs, weights, hidden, cell = _each(compute, ctx.shares, saved)
        return _joined(inputs), reduce(torch.add, weights), _joined(hidden, 0), _joined(cell, 0), None


class KernelMinGRU(torch.autograd.Function):
    """A minGRU layer (Feng et al., 2024): z = sigmoid(x_z), h = (1 - z) h' + z x_h, with projected inputs x and state h'."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, hidden: Tensor, resets: Tensor) -> Tensor:
        """The hidden states after all steps, float32 (T, S, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs x_z and x_h, float32 (T, S, 2 * H).
            hidden: Hidden states before the first step, float32 (S, H).
            resets: Whether the state before each step is 0, bool (T, S).
        """
        saved, outputs = torch.empty_like(inputs), inputs.new_empty(*resets.shape, hidden.shape[1])
        _native.mingru_forward(_rows(inputs), _array(hidden), _array(resets), _rows(saved), _rows(outputs))
        ctx.save_for_backward(inputs, saved, resets)
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs and hidden states."""
        inputs, saved, resets = ctx.saved_tensors
        grad_inputs, hidden = torch.empty_like(inputs), grad.new_empty(grad.shape[1:])
        given = _rows(inputs), _rows(saved), _rows(grad), _array(resets)
        _native.mingru_backward(*given, _rows(grad_inputs), _array(hidden))
        return grad_inputs, hidden, None
