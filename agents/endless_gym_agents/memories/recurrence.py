"""GRU and LSTM layers over packed sequences, for learning on the CPU.

A minibatch often has few sequences with many steps. PyTorch's layers then spend most of the backward pass on the gradient of the
recurrent weights, which they accumulate step by step. Here it is one matrix product over all steps. All factors that do not
depend on the gradients of later steps are also computed for all steps at once, so a step of a GRU's backward pass takes three
operations. On CUDA, PyTorch's layers call cuDNN, which does the same.

M is the number of steps of all sequences, S the number of sequences, H the hidden size. Steps are in the order of a
`PackedSequence`: first step 0 of all sequences, then step 1 of the sequences that have one, and so on. Longer sequences come
first.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional

from endless_gym_agents.memories.kernels import KernelGRU, KernelLSTM


class PackedGRU(torch.autograd.Function):
    """A GRU layer with the gates of `torch.nn.GRU`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, bias: Tensor, hidden: Tensor, sizes: Sequence[int]) -> Tensor:
        """The hidden states after all steps, float (M, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs with their bias, float (M, 3 * H).
            weight: Recurrent weights `weight_hh` float (3 * H, H).
            bias: Recurrent bias `bias_hh` float (3 * H,).
            hidden: Hidden states before the first steps, float (S, H); they get no gradient.
            sizes: Number of sequences that have each step.
        """
        width = hidden.shape[1]
        projected, gates = torch.empty_like(inputs), torch.empty_like(inputs)
        outputs = inputs.new_empty(len(inputs), width)
        # Views of the rows of each step: reset and update gate together, and the candidate.
        both, last = slice(None, 2 * width), slice(2 * width, None)
        inputs_gates, inputs_candidate = inputs[:, both].split(sizes), inputs[:, last].split(sizes)
        projected_gates, projected_candidate = projected[:, both].split(sizes), projected[:, last].split(sizes)
        reset_update, reset, update, candidate = (
            gates[:, part].split(sizes) for part in (both, slice(None, width), slice(width, 2 * width), last)
        )
        # A product of few rows with a non-contiguous matrix is slow.
        transposed = weight.t().contiguous()
        rows, rows_projected, before = outputs.split(sizes), projected.split(sizes), []
        for t, size in enumerate(sizes):
            hidden = hidden[:size]
            before.append(hidden)
            torch.addmm(bias, hidden, transposed, out=rows_projected[t])
            torch.add(inputs_gates[t], projected_gates[t], out=reset_update[t]).sigmoid_()
            torch.addcmul(inputs_candidate[t], reset[t], projected_candidate[t], out=candidate[t]).tanh_()
            hidden = torch.lerp(candidate[t], hidden, update[t], out=rows[t])
        ctx.save_for_backward(gates, projected[:, last], torch.cat(before), weight)
        ctx.sizes = sizes
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs, weight and bias."""
        gates, projected, before, weight = ctx.saved_tensors
        width = before.shape[1]
        reset, update, candidate = gates.unflatten(1, (3, width)).unbind(1)
        # Factors from the gradient of a hidden state to the gradients before the activations.
        to_candidate = (1 - update) * (1 - candidate.square())
        factors = torch.stack(
            [
                to_candidate * projected * reset * (1 - reset),
                (before - candidate) * update * (1 - update),
                to_candidate * reset,
            ],
            dim=1,
        )
        grad, deltas = grad.clone(memory_format=torch.contiguous_format), torch.empty_like(factors)
        rows, rows_factors, rows_deltas, rows_update = (x.split(ctx.sizes) for x in (grad, factors, deltas, update))
        rows_flat = deltas.flatten(1).split(ctx.sizes)
        for t in range(len(ctx.sizes) - 1, -1, -1):
            torch.mul(rows[t].unsqueeze(1), rows_factors[t], out=rows_deltas[t])
            if t:
                rows[t - 1][: ctx.sizes[t]].addcmul_(rows[t], rows_update[t]).addmm_(rows_flat[t], weight)
        flat = deltas.flatten(1)
        grad_weight, grad_bias = flat.t() @ before, flat.sum(0)
        # The reset gate scales the recurrent part of the candidate only.
        torch.mul(grad, to_candidate, out=deltas[:, 2])
        return flat, grad_weight, grad_bias, None, None


class PackedLSTM(torch.autograd.Function):
    """An LSTM layer with the gates of `torch.nn.LSTM`."""

    @staticmethod
    def forward(ctx: Any, inputs: Tensor, weight: Tensor, hidden: Tensor, cell: Tensor, sizes: Sequence[int]) -> Tensor:
        """The hidden states after all steps, float (M, H).

        Args:
            ctx: Context of autograd.
            inputs: Projected inputs with both biases, float (M, 4 * H).
            weight: Recurrent weights `weight_hh` float (4 * H, H).
            hidden: Hidden states before the first steps, float (S, H); they get no gradient.
            cell: Cell states before the first steps, float (S, H); they get no gradient.
            sizes: Number of sequences that have each step.
        """
        width = hidden.shape[1]
        gates = torch.empty_like(inputs)
        cells, squashed, outputs = (inputs.new_empty(len(inputs), width) for _ in range(3))
        starts = range(0, 4 * width, width)
        entry, forget, candidate, exit_ = (gates[:, start : start + width].split(sizes) for start in starts)
        entry_forget, rows_gates = gates[:, : 2 * width].split(sizes), gates.split(sizes)
        rows_inputs, rows_cells, rows_squashed, rows = (x.split(sizes) for x in (inputs, cells, squashed, outputs))
        transposed = weight.t().contiguous()
        before, cells_before = [], []
        for t, size in enumerate(sizes):
            hidden, cell = hidden[:size], cell[:size]
            before.append(hidden)
            cells_before.append(cell)
            torch.addmm(rows_inputs[t], hidden, transposed, out=rows_gates[t])
            entry_forget[t].sigmoid_()
            candidate[t].tanh_()
            exit_[t].sigmoid_()
            cell = torch.mul(forget[t], cell, out=rows_cells[t]).addcmul_(entry[t], candidate[t])
            hidden = torch.mul(exit_[t], torch.tanh(cell, out=rows_squashed[t]), out=rows[t])
        ctx.save_for_backward(gates, squashed, torch.cat(before), torch.cat(cells_before), weight)
        ctx.sizes = sizes
        return outputs

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of inputs and weight."""
        gates, squashed, before, cells_before, weight = ctx.saved_tensors
        entry, forget, candidate, exit_ = gates.unflatten(1, (4, before.shape[1])).unbind(1)
        # Factors from the gradients of the cell state and of the hidden state to the gradients before the activations.
        factors = torch.stack(
            [candidate * entry * (1 - entry), cells_before * forget * (1 - forget), entry * (1 - candidate.square())],
            dim=1,
        )
        to_exit, to_cell = squashed * exit_ * (1 - exit_), exit_ * (1 - squashed.square())
        grad, grad_cell = grad.clone(memory_format=torch.contiguous_format), torch.zeros_like(squashed)
        deltas = torch.empty_like(gates).unflatten(1, (4, -1))
        rows, cells, rows_factors, rows_to_exit, rows_to_cell, rows_forget = (
            x.split(ctx.sizes) for x in (grad, grad_cell, factors, to_exit, to_cell, forget)
        )
        flat = deltas.flatten(1)
        rows_flat, rows_first, rows_last = (x.split(ctx.sizes) for x in (flat, deltas[:, :3], deltas[:, 3]))
        for t in range(len(ctx.sizes) - 1, -1, -1):
            cells[t].addcmul_(rows[t], rows_to_cell[t])
            torch.mul(cells[t].unsqueeze(1), rows_factors[t], out=rows_first[t])
            torch.mul(rows[t], rows_to_exit[t], out=rows_last[t])
            if t:
                rows[t - 1][: ctx.sizes[t]].addmm_(rows_flat[t], weight)
                torch.mul(cells[t], rows_forget[t], out=cells[t - 1][: ctx.sizes[t]])
        return flat, flat.t() @ before, None, None, None


def packed_layers(
    x: Tensor, weights: Sequence[Sequence[Tensor]], hidden: Tensor, sizes: Sequence[int], native: bool = False
) -> Tensor:
    """The outputs of the last of stacked GRU or LSTM layers, float (M, H), with gradients of inputs and weights.

    Args:
        x: Inputs, float (M, inputs).
        weights: `weight_ih`, `weight_hh`, `bias_ih` and `bias_hh` of each layer, as in `all_weights` of PyTorch's layers.
        hidden: States before the first steps, float (parts, layers, S, H). A GRU has one part, an LSTM two: hidden state and
            cell state. They get no gradient.
        sizes: Number of sequences that have each step.
        native: Whether the native kernels compute the layers, which takes float32.
    """
    gru, lstm = (KernelGRU, KernelLSTM) if native else (PackedGRU, PackedLSTM)
    for layer, (weight_ih, weight_hh, bias_ih, bias_hh) in enumerate(weights):
        if len(hidden) == 1:
            x = gru.apply(functional.linear(x, weight_ih, bias_ih), weight_hh, bias_hh, hidden[0, layer], sizes)
        else:
            inputs = functional.linear(x, weight_ih, bias_ih + bias_hh)
            x = lstm.apply(inputs, weight_hh, hidden[0, layer], hidden[1, layer], sizes)
    return x
