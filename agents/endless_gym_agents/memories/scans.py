"""Linear recurrences over whole sequences, with resets.

T steps of B environments are time-major, (T, B, ...). A reset at step t, bool (T, B), discards the state before that step.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def linear_scan(decay: Tensor, inputs: Tensor, state: Tensor, resets: Tensor) -> Tensor:
    """The states h_t = a_t h_{t-1} + b_t of an elementwise recurrence, real or complex (T, B, ...).

    On the CPU this is a loop with one operation per step, forward and backward; elsewhere, an associative scan.

    Args:
        decay: The factors a, which can be expanded to the shape of `inputs`.
        inputs: The terms b, (T, B, ...).
        state: The state before the first step, (B, ...).
        resets: Whether each step is the first of an episode, bool (T, B).
    """
    decay = decay.expand_as(inputs).masked_fill(resets.view(*resets.shape, *[1] * (inputs.dim() - 2)), 0.0)
    first = torch.addcmul(inputs[0], decay[0], state)
    states: Tensor = LinearScan.apply(decay, torch.cat([first.unsqueeze(0), inputs[1:]]))
    return states


class LinearScan(torch.autograd.Function):
    """h_0 = b_0, h_t = a_t h_{t-1} + b_t."""

    @staticmethod
    def forward(ctx: Any, decay: Tensor, inputs: Tensor) -> Tensor:
        """The states h, (T, ...), from the factors a and the terms b of the same shape."""
        states = scan(decay, inputs)
        ctx.save_for_backward(decay, states)
        return states

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of factors and terms: g_t = dh_t + conj(a_{t+1}) g_{t+1}, da_t = g_t conj(h_{t-1}), db_t = g_t."""
        decay, states = ctx.saved_tensors
        # The same recurrence, backwards in time; its first factor has no effect.
        reversed_decay = torch.cat([decay[:1], decay[1:].flip(0)]).conj().resolve_conj()
        grad_inputs = scan(reversed_decay, grad.flip(0)).flip(0)
        grad_decay = torch.zeros_like(decay)
        torch.mul(grad_inputs[1:], states[:-1].conj(), out=grad_decay[1:])
        return grad_decay, grad_inputs


def scan(decay: Tensor, inputs: Tensor) -> Tensor:
    """The states of `LinearScan`, without gradients."""
    return sequential(decay, inputs) if inputs.device.type == "cpu" else associative(decay, inputs)


def sequential(decay: Tensor, inputs: Tensor) -> Tensor:
    """`scan` as a loop over steps."""
    states = torch.empty_like(inputs, memory_format=torch.contiguous_format)
    rows = states.unbind()
    rows[0].copy_(inputs[0])
    for t, (a, b) in enumerate(zip(decay.unbind()[1:], inputs.unbind()[1:], strict=True)):
        torch.addcmul(b, a, rows[t], out=rows[t + 1])
    return states


def associative(decay: Tensor, inputs: Tensor) -> Tensor:
    """`scan` in log2(T) passes over all steps (Hillis and Steele, 1986), which join neighbouring intervals of doubling length."""
    offset = 1
    while offset < len(inputs):
        joined = torch.addcmul(inputs[offset:], decay[offset:], inputs[:-offset])
        inputs = torch.cat([inputs[:offset], joined])
        decay = torch.cat([decay[:offset], decay[offset:] * decay[:-offset]])
        offset *= 2
    return inputs


def steps_of_episode(before: Tensor, resets: Tensor) -> Tensor:
    """The number of each step in its episode, float32 (T, B, 1), from that of the first step if no episode starts, (B, 1)."""
    time = torch.arange(len(resets), device=resets.device).unsqueeze(1)
    start = torch.where(resets, time, -1).cummax(0).values
    return torch.where(start < 0, time + before.squeeze(1), time - start).to(before.dtype).unsqueeze(2)
