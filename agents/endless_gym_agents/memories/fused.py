"""GRU and LSTM layers on CUDA: a loop over fused cells.

cuDNN's layers know no resets inside a sequence. A step here is a mask, a product and PyTorch's fused cell, forward and backward;
the gradients of the weights are one product over all steps. T is the number of steps, S the number of sequences, H the hidden
size; arguments are those of `kernels`.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

aten = torch.ops.aten


def _kept(resets: Tensor, like: Tensor) -> Tensor:
    """Factor of the state before each step, (T, S, 1): 0 at a reset, else 1."""
    return (~resets).to(like.dtype).unsqueeze(-1)


class FusedGRU(torch.autograd.Function):
    """As `kernels.KernelGRU`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, hidden: Tensor, resets: Tensor) -> Tensor:
        """The hidden states after all steps, float32 (T, S, H)."""
        kept, transposed = _kept(resets, inputs), weight.t()
        before, outputs, saved = inputs.new_empty(len(inputs), *hidden.shape), [], []
        for x, keep, masked in zip(inputs, kept, before, strict=True):
            torch.mul(hidden, keep, out=masked)
            hidden, workspace = aten._thnn_fused_gru_cell(x, torch.addmm(bias, masked, transposed), masked)
            outputs.append(hidden)
            saved.append(workspace)
        ctx.save_for_backward(weight, kept, before, *saved)
        return torch.stack(outputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grads: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, bias and hidden states."""
        weight, kept, before, *saved = ctx.saved_tensors
        inputs, gates = [], []
        grad = torch.zeros_like(grads[0])
        for given, keep, workspace in zip(*(reversed(x) for x in (grads.unbind(), kept.unbind(), saved)), strict=True):
            of_inputs, of_gates, grad, _, _ = aten._thnn_fused_gru_cell_backward(grad + given, workspace, False)
            grad = torch.addmm(grad, of_gates, weight).mul_(keep)
            inputs.append(of_inputs)
            gates.append(of_gates)
        flat = torch.stack(gates[::-1]).flatten(0, 1)
        return torch.stack(inputs[::-1]), flat.t() @ before.flatten(0, 1), flat.sum(0), grad, None


class FusedLSTM(torch.autograd.Function):
    """As `kernels.KernelLSTM`."""

    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, weight: Tensor, hidden: Tensor, cell: Tensor, resets: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The hidden states after all steps, float32 (T, S, H), and the cell states after the last, without gradient (S, H)."""
        kept, transposed = _kept(resets, inputs), weight.t()
        before, outputs, saved = inputs.new_empty(len(inputs), *hidden.shape), [], []
        for x, keep, masked in zip(inputs, kept, before, strict=True):
            torch.mul(hidden, keep, out=masked)
            cell_before = cell * keep
            hidden, cell, workspace = aten._thnn_fused_lstm_cell(x, masked @ transposed, cell_before)
            outputs.append(hidden)
            saved += [cell_before, cell, workspace]
        ctx.save_for_backward(weight, kept, before, *saved)
        ctx.mark_non_differentiable(cell)
        return torch.stack(outputs), cell

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grads: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight, hidden states and cell states."""
        weight, kept, before, *saved = ctx.saved_tensors
        gates: list[Tensor] = []
        grad = cell = torch.zeros_like(grads[0])
        for step in range(len(grads) - 1, -1, -1):
            of_gates, cell, _ = aten._thnn_fused_lstm_cell_backward_impl(
                grad + grads[step], cell, *saved[3 * step : 3 * step + 3], False
            )
            grad, cell = (of_gates @ weight).mul_(kept[step]), cell * kept[step]
            gates.append(of_gates)
        inputs = torch.stack(gates[::-1])
        return inputs, inputs.flatten(0, 1).t() @ before.flatten(0, 1), grad, cell, None
