"""GRU, LSTM and minGRU layers over packed sequences, computed by the native kernels of `endless_gym`, on the CPU in float32.

The kernels read and write the tensors' memory. Their documentation, the crate `endless-gym-kernels`, has the equations. M is the
number of steps of all sequences, S the number of sequences, H the hidden size; steps are in the order of a `PackedSequence`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from endless_gym import _native


def kernels_are_faster(width: int) -> bool:
    """Whether the kernels are faster than PyTorch's operations for a hidden size.

    The kernels use one thread. With two, PyTorch was slower up to 128 units; more were not measured.
    """
    threads = torch.get_num_threads()
    return threads == 1 or (threads == 2 and width <= 128)


def _array(tensor: Tensor) -> NDArray[np.float32]:
    """The tensor's memory; a copy if it is not contiguous."""
    array: NDArray[np.float32] = tensor.detach().contiguous().numpy()
    return array


class KernelGRU(torch.autograd.Function):
    """A GRU layer with the gates of `torch.nn.GRU`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, hidden: Tensor, sizes: Sequence[int]) -> Tensor:
        """As `PackedGRU.forward` in `recurrence`, with a gradient of `hidden`."""
        rows, width = len(inputs), hidden.shape[1]
        saved, outputs = inputs.new_empty(rows, 5 * width), inputs.new_empty(rows, width)
        arrays = _array(inputs), _array(weight), _array(bias), _array(hidden)
        _native.gru_forward(*arrays, sizes, (), _array(saved), _array(outputs))
        ctx.save_for_backward(saved, weight)
        ctx.sizes = sizes
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, bias and hidden states."""
        saved, weight = ctx.saved_tensors
        width = grad.shape[1]
        inputs, hidden = grad.new_empty(len(grad), 3 * width), grad.new_empty(ctx.sizes[0], width)
        grad_weight, bias = grad.new_zeros(weight.shape), grad.new_zeros(3 * width)
        arrays = _array(inputs), _array(grad_weight), _array(bias), _array(hidden)
        _native.gru_backward(_array(weight), _array(saved), _array(grad), ctx.sizes, (), *arrays)
        return inputs, grad_weight, bias, hidden, None


class KernelLSTM(torch.autograd.Function):
    """An LSTM layer with the gates of `torch.nn.LSTM`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, hidden: Tensor, cell: Tensor, sizes: Sequence[int]) -> Tensor:
        """As `PackedLSTM.forward` in `recurrence`, with gradients of `hidden` and `cell`."""
        rows, width = len(inputs), hidden.shape[1]
        saved, outputs, cells = (inputs.new_empty(rows, multiple * width) for multiple in (7, 1, 1))
        arrays = _array(inputs), _array(weight), _array(hidden), _array(cell)
        _native.lstm_forward(*arrays, sizes, (), _array(saved), _array(outputs), _array(cells))
        ctx.save_for_backward(saved, weight)
        ctx.sizes = sizes
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, hidden states and cell states."""
        saved, weight = ctx.saved_tensors
        width = grad.shape[1]
        inputs, grad_weight = grad.new_empty(len(grad), 4 * width), grad.new_zeros(weight.shape)
        hidden, cell = (grad.new_empty(ctx.sizes[0], width) for _ in range(2))
        arrays = _array(inputs), _array(grad_weight), _array(hidden), _array(cell)
        _native.lstm_backward(_array(weight), _array(saved), _array(grad), ctx.sizes, (), *arrays)
        return inputs, grad_weight, hidden, cell, None


class KernelMinGRU(torch.autograd.Function):
    """A minGRU layer (Feng et al., 2024): z = sigmoid(x_z), h = (1 - z) h' + z x_h, with projected inputs x and state h'."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, hidden: Tensor, sizes: Sequence[int], resets: Sequence[bool] = ()) -> Tensor:
        """The hidden states after all steps, float32 (M, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs x_z and x_h, float32 (M, 2 * H).
            hidden: Hidden states before the first steps, float32 (S, H).
            sizes: Number of sequences that have each step.
            resets: Whether the state before each step is 0, (M,); empty if there are no such steps.
        """
        rows, width = len(inputs), hidden.shape[1]
        saved, outputs = inputs.new_empty(rows, 2 * width), inputs.new_empty(rows, width)
        _native.mingru_forward(_array(inputs), _array(hidden), sizes, resets, _array(saved), _array(outputs))
        ctx.save_for_backward(inputs, saved)
        ctx.sizes, ctx.resets = sizes, resets
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs and hidden states."""
        inputs, saved = ctx.saved_tensors
        grad_inputs, hidden = grad.new_empty(inputs.shape), grad.new_empty(ctx.sizes[0], grad.shape[1])
        arrays = _array(inputs), _array(saved), _array(grad)
        _native.mingru_backward(*arrays, ctx.sizes, ctx.resets, _array(grad_inputs), _array(hidden))
        return grad_inputs, hidden, None, None
