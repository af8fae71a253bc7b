"""RetNet: linear attention with a fixed decay per head and rotated queries and keys.

Sun et al., "Retentive Network: A Successor to Transformer for Large Language Models", 2023 (https://arxiv.org/abs/2307.08621).
The retention of a head is its equation 6, the layer is equation 8 (without the feed-forward network, which the layer after the
memory is):

    S_t = gamma S_{t-1} + k_t v_t^T,   o_t = S_t^T q_t                              state of a head, (K, K)
    gamma of head i = 1 - 2^(-5 - i)
    output: W_O (RMSNorm(o_t) * silu(W_G u_t))

Queries W_Q u_t and keys W_K u_t / sqrt(K) are rotated by the angles t theta (xPos, equation 3), so that their product depends
on the distance of two steps. t counts the steps of the episode.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import attention, attention_step
from endless_gym_agents.memories.scans import steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class RetNet(SequenceModel):
    """The state is S of all heads, float32 (B, heads, K, K) with K = width / heads, and the number of steps, float32 (B, 1)."""

    residual = True
    gamma: Tensor
    theta: Tensor

    def __init__(self, input_width: int, width: int, heads: int = 4) -> None:
        """Make the layer; `width` must be a multiple of `heads`."""
        super().__init__()
        self.width, self.heads, size = width, heads, width // heads
        self.enter = nn.Linear(input_width, 4 * width, bias=False)
        self.norm = nn.RMSNorm(size, eps=1e-5)
        self.leave = nn.Linear(width, width, bias=False)
        for layer in (self.enter, self.leave):
            nn.init.xavier_uniform_(layer.weight, 2**-0.5)
        self.register_buffer("gamma", 1 - 2.0 ** (-5 - torch.arange(heads)), persistent=False)
        theta = 10_000 ** -(torch.arange(size // 2) / (size // 2))
        self.register_buffer("theta", theta, persistent=False)
        self.state_shapes = {"s": (heads, size, size), "steps": (1,)}

    def split(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Queries, keys and values, float32 (..., heads, K) each, and the output gate, for steps float32 (..., 1)."""
        q, k, v, gate = self.enter(x).chunk(4, dim=-1)
        q, k, v = (part.unflatten(-1, (self.heads, -1)) for part in (q, k, v))
        angle = (time * self.theta).unsqueeze(-2)
        turn = angle.cos(), angle.sin()
        return rotated(q, *turn), rotated(k * k.shape[-1] ** -0.5, *turn), v, gate

    def outputs(self, y: Tensor, gate: Tensor) -> Tensor:
        """The output from S^T q and the gate."""
        return self.leave(self.norm(y).flatten(-2) * nn.functional.silu(gate))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        q, k, v, gate = self.split(x, state["steps"])
        y, s = attention_step(q, k, v, self.gamma, state["s"])
        return self.outputs(y, gate), {"s": s, "steps": state["steps"] + 1}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        time = steps_of_episode(state["steps"], resets)
        q, k, v, gate = self.split(x, time)
        y, s = attention(q, k, v, self.gamma.log().expand(*resets.shape, -1), state["s"], resets)
        return self.outputs(y, gate), {"s": s, "steps": time[-1] + 1}


def rotated(x: Tensor, cosine: Tensor, sine: Tensor) -> Tensor:
    """Vectors whose pairs of entries i and i + n are rotated by n angles; another entry stays."""
    one, other, rest = x.tensor_split([cosine.shape[-1], 2 * cosine.shape[-1]], dim=-1)
    return torch.cat([one * cosine - other * sine, other * cosine + one * sine, rest], dim=-1)
