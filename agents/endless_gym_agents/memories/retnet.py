"""RetNet: linear attention with a fixed decay per head and rotated queries and keys.

Sun et al., "Retentive Network: A Successor to Transformer for Large Language Models", 2023 (https://arxiv.org/abs/2307.08621).
The retention of a head is its equation 6, the layer equation 8, with values twice as wide as keys as in its section 3.1:

    S_t = gamma S_{t-1} + k_t v_t^T,   o_t = S_t^T q_t / sqrt(sum_{s <= t} gamma^(t - s))       state of a head, (K, V)
    gamma of head i = 1 - 2^(-5 - i)
    y_t = W_O (rms(o_t) * silu(W_G u_t)),   u = rmsnorm(x)
    block: y' = x + y,   y' + W (gelu(U n) * V n),   n = rmsnorm(y')

Queries W_Q u_t and keys W_K u_t / sqrt(K) are rotated by the angles t theta (equation 3), so that their product depends on the
distance of two steps. t counts the steps of the episode.

Scale, normalisations, angles (with both ends, 1 and 10^-4), the gate of the feed-forward network and initial values are those of
the authors' code, https://github.com/microsoft/torchscale, in its form for single steps. That network has as many weights as the
paper's, which has no gate. The pairs of entries that are rotated are i and i + K / 2 instead of neighbours, a permutation of the
rows of W_Q and W_K. The authors have heads of 256 channels; here are 4 heads, and so 4 decays, at any width.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import attention, attention_step
from endless_gym_agents.memories.layers import FeedForward, divided
from endless_gym_agents.memories.scans import steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, State

#: Added to the mean squares of all normalisations.
EPSILON = 1e-6


class RetNet(SequenceModel):
    """The state is S of all heads, float32 (B, heads, K, V), and the number of steps, float32 (B, 1)."""

    residual = True
    gamma: Tensor
    theta: Tensor

    def __init__(
        self, input_width: int, width: int, heads: int = 4, value_factor: float = 2.0, feed_forward: float = 4 / 3
    ) -> None:
        """Make the layer.

        Args:
            input_width: Size of the inputs.
            width: Size of the outputs and of the keys of all heads; a multiple of `heads`.
            heads: Number of heads.
            value_factor: V / K.
            feed_forward: Size of the feed-forward network, as a multiple of `width`; 0 for none.
        """
        super().__init__()
        self.width, self.heads, size = width, heads, divided(width, heads)
        value_size = round(value_factor * size)
        self.parts = [width, width, heads * value_size, heads * value_size]
        self.enter = nn.Linear(input_width, sum(self.parts), bias=False)
        self.leave = nn.Linear(heads * value_size, width, bias=False)
        for weight in self.enter.weight.data.split(self.parts):
            nn.init.xavier_uniform_(weight, 2**-2.5)
        nn.init.xavier_uniform_(self.leave.weight, 2**-1)
        # A file of an agent tells the number of heads by it.
        self.register_buffer("gamma", 1 - 2.0 ** (-5 - torch.arange(heads)))
        self.register_buffer("theta", 10_000 ** -torch.linspace(0, 1, size // 2), persistent=False)
        self.state_shapes = {"s": (heads, size, value_size), "steps": (1,)}
        if feed_forward:
            self.feed_forward = FeedForward(self.input_norm(), width, feed_forward, nn.functional.gelu)

    def input_norm(self) -> nn.Module:
        return nn.RMSNorm(self.width, eps=EPSILON)

    def split(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Queries, keys and values, float32 (..., heads, K or V) each, and the output gate, for steps float32 (..., 1)."""
        q, k, v, gate = self.enter(x).split(self.parts, dim=-1)
        q, k, v = (part.unflatten(-1, (self.heads, -1)) for part in (q, k, v))
        angle = (time * self.theta).unsqueeze(-2)
        turn = angle.cos(), angle.sin()
        return rotated(q, *turn), rotated(k * k.shape[-1] ** -0.5, *turn), v, gate

    def scale(self, time: Tensor) -> Tensor:
        """The sum of powers of gamma from 0 to `time`, float32 (..., heads)."""
        return (1 - self.gamma ** (time + 1)) / (1 - self.gamma)

    def outputs(self, y: Tensor, time: Tensor, gate: Tensor) -> Tensor:
        """The output from S^T q, the step and the gate."""
        o = y * self.scale(time).rsqrt().unsqueeze(-1)
        o = nn.functional.rms_norm(o, o.shape[-1:], eps=EPSILON)
        return self.leave(o.flatten(-2) * nn.functional.silu(gate))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        time = state["steps"]
        q, k, v, gate = self.split(x, time)
        y, s = attention_step(q, k, v, self.gamma, state["s"])
        return self.outputs(y, time, gate), {"s": s, "steps": time + 1}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        time = steps_of_episode(state["steps"], resets)
        q, k, v, gate = self.split(x, time)
        y, s = attention(q, k, v, self.gamma.log().expand(*resets.shape, -1), state["s"], resets)
        return self.outputs(y, time, gate), {"s": s, "steps": time[-1] + 1}


def rotated(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Vectors whose pairs of entries i and i + n are rotated by n angles; another entry stays."""
    one, other, rest = x.tensor_split([cosine.shape[-1], 2 * cosine.shape[-1]], dim=-1)
    return torch.cat([one * cosine - other * sine, other * cosine + one * sine, rest], dim=-1)
