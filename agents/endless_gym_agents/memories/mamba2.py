"""Mamba-2: a selective state space model whose decay is one number per head and step.

Dao and Gu, "Transformers are SSMs", 2024 (https://arxiv.org/abs/2405.21060). The layer is the parallel block of its section 7.
With P = `expand` * width / heads channels per head, N entries of the state per channel, and one group of B and C for all heads:

    (z, x, B, C, dt) = W u_t                    z, x (heads * P), B and C (N), dt (heads)
    (x, B, C) = silu(convolution of the last 4 steps)
    dt = softplus(dt + bias),  a = exp(-dt exp(A_log))
    S_t = a S_{t-1} + B (dt x)^T                state of a head, (N, P)
    y_t = S_t^T C + D x
    output: W_out RMSNorm(y * silu(z))

Over sequences, it is computed as section 6 does: chunks of attention with a mask of decays. Initial values are those of the
authors' code, https://github.com/state-spaces/mamba. Its heads have 64 channels, however many these are; here, their number is
fixed, so that they have about 64 at the sizes of the package's agents.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import ShortConvolution, attention, attention_step, decays
from endless_gym_agents.memories.layers import divided, undecayed
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class Mamba2(SequenceModel):
    """The state is S of all heads, float32 (B, heads, N, P), and that of the convolution."""

    residual = True

    def __init__(self, input_width: int, width: int, heads: int = 4, state_size: int = 128, expand: int = 2) -> None:
        """Make the layer.

        Args:
            input_width: Size of the inputs.
            width: Size of the outputs.
            heads: Number of heads.
            state_size: N.
            expand: Channels of all heads, as a multiple of `width`; a multiple of `heads`.
        """
        super().__init__()
        self.width, self.heads, self.inner, self.state_size = width, heads, expand * width, state_size
        self.parts = [self.inner, self.inner + 2 * state_size, heads]
        self.enter = nn.Linear(input_width, sum(self.parts), bias=False)
        self.convolution = ShortConvolution(self.parts[1])
        self.a_log, self.dt_bias = decays(heads, 1.0)
        self.d = undecayed(torch.ones(heads))
        self.norm = nn.RMSNorm(self.inner, eps=1e-5)
        self.leave = nn.Linear(self.inner, width, bias=False)
        self.state_shapes = {
            "s": (heads, state_size, divided(self.inner, heads)),
            "convolution": self.convolution.state_shape,
        }

    def stacked(self, layers: int) -> None:
        self.leave.weight.data /= layers**0.5

    def split(self, convolved: Tensor, dt: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """X by head, dt x, B and C as those of one head, and log(a)."""
        x, b, c = convolved.split([self.inner, self.state_size, self.state_size], dim=-1)
        x, dt = x.unflatten(-1, (self.heads, -1)), nn.functional.softplus(dt + self.dt_bias)
        return x, dt.unsqueeze(-1) * x, b.unsqueeze(-2), c.unsqueeze(-2), -dt * self.a_log.exp()

    def outputs(self, y: Tensor, x: Tensor, z: Tensor) -> Tensor:
        """The output from S^T C, x and z."""
        y = (y + self.d.unsqueeze(-1) * x).flatten(-2)
        return self.leave(self.norm(y * nn.functional.silu(z)))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        z, inputs, dt = self.enter(x).split(self.parts, dim=-1)
        convolved, window = self.convolution.step(inputs, state["convolution"])
        x, values, b, c, log_decay = self.split(convolved, dt)
        y, s = attention_step(c, b, values, log_decay.exp(), state["s"])
        return self.outputs(y, x, z), {"s": s, "convolution": window}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        z, inputs, dt = self.enter(x).split(self.parts, dim=-1)
        convolved, window = self.convolution.sequence(inputs, state["convolution"], resets)
        x, values, b, c, log_decay = self.split(convolved, dt)
        y, s = attention(c, b, values, log_decay, state["s"], resets)
        return self.outputs(y, x, z), {"s": s, "convolution": window}
