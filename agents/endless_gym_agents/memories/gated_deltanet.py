"""Gated DeltaNet: linear attention that decays, and replaces what it has stored for a key.

Yang, Kautz and Hatamizadeh, "Gated Delta Networks: Improving Mamba2 with Delta Rule", 2024 (https://arxiv.org/abs/2412.06464).
The gated delta rule is its equation 10, transposed here so that a state has keys as rows:

    S_t = a_t (I - b_t k_t k_t^T) S_{t-1} + b_t k_t v_t^T = a_t S_{t-1} + b_t k_t (v_t - a_t S_{t-1}^T k_t)^T
    o_t = S_t^T q_t

with, as in its figure 1 and section 3.4,

    q_t, k_t = l2norm(silu(convolution(W u_t))),   v_t = silu(convolution(W u_t))
    b_t = sigmoid(W_b u_t),   a_t = exp(-exp(A_log) softplus(W_a u_t + bias))        one number per head
    output: W_o (RMSNorm(o_t) * silu(W_g u_t))

Over sequences, the rows of the terms u_t = b_t (v_t - ...) of a chunk solve a triangular system of equations (section 3.3).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import ShortConvolution, attention, attention_step
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class GatedDeltaNet(SequenceModel):
    """The state is S of all heads, float32 (B, heads, K, K) with K = width / heads, and that of the convolution."""

    residual = True

    def __init__(self, input_width: int, width: int, heads: int = 4) -> None:
        """Make the layer; `width` must be a multiple of `heads`."""
        super().__init__()
        self.width, self.heads = width, heads
        self.enter = nn.Linear(input_width, 4 * width + 2 * heads, bias=False)
        self.convolution = ShortConvolution(3 * width)
        # As in Mamba-2.
        dt = torch.exp(torch.rand(heads) * (math.log(0.1) - math.log(0.001)) + math.log(0.001))
        self.dt_bias = nn.Parameter(dt + torch.log(-torch.expm1(-dt)))
        self.a_log = nn.Parameter(torch.log(torch.rand(heads) * 15 + 1))
        self.norm = nn.RMSNorm(width // heads, eps=1e-5)
        self.leave = nn.Linear(width, width, bias=False)
        size = width // heads
        self.state_shapes = {"s": (heads, size, size), "convolution": self.convolution.state_shape}

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The inputs of the convolution, the output gate, b and log(a)."""
        inputs, gate, a, b = self.enter(x).split([3 * self.width, self.width, self.heads, self.heads], dim=-1)
        return inputs, gate, b.sigmoid(), -self.a_log.exp() * nn.functional.softplus(a + self.dt_bias)

    def split(self, convolved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values, float32 (..., heads, K) each."""
        q, k, v = convolved.unflatten(-1, (3, self.heads, -1)).unbind(-3)
        return nn.functional.normalize(q, dim=-1), nn.functional.normalize(k, dim=-1), v

    def outputs(self, y: Tensor, gate: Tensor) -> Tensor:
        """The output from S^T q and the output gate."""
        return self.leave(self.norm(y).flatten(-2) * nn.functional.silu(gate))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        inputs, gate, rate, log_decay = self.project(x)
        convolved, window = self.convolution.step(inputs, state["convolution"])
        y, s = attention_step(*self.split(convolved), log_decay.exp(), state["s"], rate)
        return self.outputs(y, gate), {"s": s, "convolution": window}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        inputs, gate, rate, log_decay = self.project(x)
        convolved, window = self.convolution.sequence(inputs, state["convolution"], resets)
        y, s = attention(*self.split(convolved), log_decay, state["s"], resets, rate)
        return self.outputs(y, gate), {"s": s, "convolution": window}
