"""Gated DeltaNet: linear attention that decays, and replaces what it has stored for a key.

Yang, Kautz and Hatamizadeh, "Gated Delta Networks: Improving Mamba2 with Delta Rule", 2024 (https://arxiv.org/abs/2412.06464).
The gated delta rule is its equation 10, transposed here so that a state has keys as rows:

    S_t = a_t (I - b_t k_t k_t^T) S_{t-1} + b_t k_t v_t^T = a_t S_{t-1} + b_t k_t (v_t - a_t S_{t-1}^T k_t)^T
    o_t = S_t^T q_t

with, as in its figure 1 and section 3.4,

    q_t, k_t = unit(silu(convolution(W u_t))),   v_t = silu(convolution(W u_t)),   q_t divided by sqrt(K)
    b_t = sigmoid(W_b u_t),   a_t = exp(-exp(A_log) softplus(W_a u_t + bias))        one number per head
    y_t = W_o (rmsnorm(o_t) * silu(W_g u_t)),   u = rmsnorm(x)
    block: y' = x + y,   y' + W (silu(U n) * V n),   n = rmsnorm(y')

Over sequences, the rows of the terms u_t = b_t (v_t - ...) of a chunk solve a triangular system of equations (section 3.3).

Proportions and initial values are those of the authors' code, https://github.com/NVlabs/GatedDeltaNet and
https://github.com/fla-org/flash-linear-attention: keys of all heads together have 0.75 times, values 1.5 times the width, and the
feed-forward network 8/3 times, rounded up. The standard deviation of weights is 0.02 for their width of 2048, and larger for less
width, so that outputs have the same size. They have heads of 256 channels; here are 4 heads, whose sizes are rounded down.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import ShortConvolution, attention, attention_step, decays
from endless_gym_agents.memories.layers import FeedForward
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class GatedDeltaNet(SequenceModel):
    """The state is S of all heads, float32 (B, heads, K, V), and that of the convolution."""

    residual = True

    def __init__(
        self,
        input_width: int,
        width: int,
        heads: int = 4,
        key_factor: float = 0.75,
        value_factor: float = 2.0,
        feed_forward: float = 8 / 3,
    ) -> None:
        """Make the layer.

        Args:
            input_width: Size of the inputs.
            width: Size of the outputs.
            heads: Number of heads.
            key_factor: Size of the keys of all heads, as a multiple of `width`.
            value_factor: V / K.
            feed_forward: Size of the feed-forward network, as a multiple of `width`; 0 for none.
        """
        super().__init__()
        self.width, self.heads = width, heads
        size = max(1, int(key_factor * width / heads))
        value_size = round(value_factor * size)
        self.sizes = [heads * size, heads * size, heads * value_size]
        self.enter = nn.Linear(input_width, sum(self.sizes) + self.sizes[2] + 2 * heads, bias=False)
        self.convolution = ShortConvolution(sum(self.sizes), bias=False)
        self.a_log, self.dt_bias = decays(heads, 0.0)
        self.norm = nn.RMSNorm(value_size, eps=1e-5)
        self.leave = nn.Linear(self.sizes[2], width, bias=False)
        self.state_shapes = {"s": (heads, size, value_size), "convolution": self.convolution.state_shape}
        if feed_forward:
            self.feed_forward = FeedForward(self.input_norm(), width, feed_forward, nn.functional.silu)
        for layer in self.modules():
            if isinstance(layer, nn.Linear):
                nn.init.normal_(layer.weight, std=0.02 * (2048 / width) ** 0.5)

    def project(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The inputs of the convolution, the output gate, b and log(a)."""
        parts = [sum(self.sizes), self.sizes[2], self.heads, self.heads]
        inputs, gate, a, b = self.enter(x).split(parts, dim=-1)
        return inputs, gate, b.sigmoid(), -self.a_log.exp() * nn.functional.softplus(a + self.dt_bias)

    def split(self, convolved: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries, keys and values, float32 (..., heads, K or V) each."""
        q, k, v = (part.unflatten(-1, (self.heads, -1)) for part in convolved.split(self.sizes, dim=-1))
        return unit(q) * q.shape[-1] ** -0.5, unit(k), v

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


def unit(x: Tensor) -> Tensor:
    """Vectors divided by their length."""
    return x * torch.rsqrt(x.square().sum(-1, keepdim=True) + 1e-6)
