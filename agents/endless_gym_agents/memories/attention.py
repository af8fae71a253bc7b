"""Linear attention with decay, and the short convolutions that precede it.

The state of a head is a matrix to which each step adds the product of a key and a value, after the old entries have decayed.
Over a sequence, the steps of a chunk are computed at once by matrix products, and the state is passed from chunk to chunk, as
in "Gated Linear Attention Transformers with Hardware-Efficient Training" (Yang et al., 2023). Resets become zeros of the matrix
of decays.

T steps of B environments are time-major. The sizes of keys and values of H heads are K and V.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.layers import undecayed

#: Steps of a chunk.
CHUNK = 64


def heads_first(x: Tensor) -> Tensor:
    """(C, B, H, ...) as (B, H, C, ...)."""
    return x.permute(1, 2, 0, *range(3, x.dim()))


def log_decays(log_decay: Tensor, resets: Tensor) -> tuple[Tensor, Tensor]:
    """Logarithms of the products of decays within a chunk of C steps; minus infinity from one episode to another.

    Args:
        log_decay: Logarithm of the factor of the state at each step, at most 0, float32 (C, B, H).
        resets: Whether each step is the first of an episode, bool (C, B).

    Returns:
        From the step j to the step i, at [..., i, j], float32 (B, H, C, C); and from the state before the chunk to each step,
        float32 (B, H, C).
    """
    steps = len(log_decay)
    log_decay, episode = heads_first(log_decay), resets.t().cumsum(1)
    # Sums of terms of one sign, and no differences of sums, which would be inexact.
    ones = torch.ones(steps, steps, dtype=torch.bool, device=resets.device).tril()
    between = log_decay.unsqueeze(-1).masked_fill(~ones.tril(-1), 0.0).cumsum(-2)
    same = (episode.unsqueeze(2) == episode.unsqueeze(1)) & ones
    between = between.masked_fill(~same.unsqueeze(1), -torch.inf)
    before = log_decay.cumsum(-1).masked_fill((episode > 0).unsqueeze(1), -torch.inf)
    return between, before


def chunks(*parts: Tensor) -> Iterator[tuple[Tensor, ...]]:
    """The chunks of sequences."""
    return zip(*(part.split(CHUNK) for part in parts), strict=True)


def attention(
    queries: Tensor,
    keys: Tensor,
    values: Tensor,
    log_decay: Tensor,
    state: Tensor,
    resets: Tensor,
    rate: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Linear attention with decay over T steps.

    With decays a and keys k, values v and queries q, the state is S_t = a_t S_{t-1} + k_t u_t^T and the output S_t^T q_t, where
    u_t = v_t. With rates b, which make it the gated delta rule, u_t = b_t (v_t - a_t S_{t-1}^T k_t).

    Args:
        queries: float32 (T, B, H, K), or (T, B, 1, K) if they are the same for all heads.
        keys: float32, as `queries`.
        values: float32 (T, B, H, V).
        log_decay: log(a), at most 0, float32 (T, B, H).
        state: S before the first step, float32 (B, H, K, V).
        resets: Whether each step is the first of an episode, bool (T, B).
        rate: The rates b, float32 (T, B, H).

    Returns:
        The outputs, float32 (T, B, H, V), and the state after the last step.
    """
    outputs = []
    rates = rate if rate is not None else torch.empty(len(values), 0)
    for q, k, u, log_a, starts, b in chunks(queries, keys, values, log_decay, resets, rates):
        between, before = (log.exp() for log in log_decays(log_a, starts))
        q, k, u = heads_first(q), heads_first(k), heads_first(u)
        if rate is not None:
            # u_i depends on u_j of the steps j < i: a triangular system of equations.
            b = heads_first(b).unsqueeze(-1)
            mixing = b * between * (k @ k.mT)
            # The solver reads neither the diagonal, which is 1, nor what is above it.
            u = b * (u - before.unsqueeze(-1) * (k @ state))
            u = torch.linalg.solve_triangular(mixing, u, upper=False, unitriangular=True)
        y = (between * (q @ k.mT)) @ u + before.unsqueeze(-1) * (q @ state)
        outputs.append(y.permute(2, 0, 1, 3))
        state = before[..., -1, None, None] * state + k.mT @ (between[..., -1, :].unsqueeze(-1) * u)
    return torch.cat(outputs), state


def attention_step(
    q: Tensor, k: Tensor, v: Tensor, decay: Tensor, state: Tensor, rate: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """One step of `attention`, with shapes without T, and the decay itself.

    Returns:
        The output, float32 (B, H, V), and the state after the step.
    """
    state = decay[..., None, None] * state
    if rate is not None:
        v = rate.unsqueeze(-1) * (v - (k.unsqueeze(-2) @ state).squeeze(-2))
    state = torch.addcmul(state, k.unsqueeze(-1), v.unsqueeze(-2))
    return (q.unsqueeze(-2) @ state).squeeze(-2), state


def decays(heads: int, smallest: float) -> tuple[nn.Parameter, nn.Parameter]:
    """Initial values of Mamba-2's decays exp(-A dt) of heads: A uniform from `smallest` to 16, dt log-uniform from 0.001 to 0.1.

    Returns:
        log(A), and the bias b with softplus(b) = dt, float32 (heads,) each.
    """
    # Never log(0).
    a = 16 - (16 - smallest) * torch.rand(heads)
    dt = torch.exp(torch.rand(heads) * math.log(100) + math.log(0.001))
    return undecayed(a.log()), undecayed(dt + torch.log(-torch.expm1(-dt)))


class ShortConvolution(nn.Module):
    """A causal convolution over a few steps of each channel, y_t = bias + sum_j w_j x_{t-j}, followed by SiLU.

    Its state are the previous inputs, oldest first, float32 (B, `size` - 1, channels).
    """

    def __init__(self, channels: int, size: int = 4, bias: bool = True) -> None:
        """Make the convolution with PyTorch's initial values of a depthwise convolution."""
        super().__init__()
        self.size, self.state_shape, limit = size, (size - 1, channels), size**-0.5
        self.weight = nn.Parameter(torch.empty(size, channels).uniform_(-limit, limit))
        self.bias = undecayed(torch.empty(channels).uniform_(-limit, limit)) if bias else None

    def step(self, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """One step of inputs float32 (B, channels); returns the outputs and the state after the step."""
        window = torch.cat([state, x.unsqueeze(1)], dim=1)
        y = (window * self.weight.flip(0)).sum(1)
        return nn.functional.silu(y if self.bias is None else y + self.bias), window[:, 1:]

    def sequence(self, x: Tensor, state: Tensor, resets: Tensor) -> tuple[Tensor, Tensor]:
        """T steps of inputs float32 (T, B, channels); returns the outputs and the state after the last step."""
        steps = len(x)
        window = torch.cat([state.transpose(0, 1), x])
        # Steps since the episode began; the state belongs to the episode before the first reset.
        time = torch.arange(steps, device=x.device).unsqueeze(1)
        age = time - torch.where(resets, time, -self.size).cummax(0).values
        y = self.weight[0] * x if self.bias is None else torch.addcmul(self.bias, self.weight[0], x)
        for past in range(1, self.size):
            earlier = window[self.size - 1 - past : self.size - 1 - past + steps]
            y = y + self.weight[past] * earlier.masked_fill((age < past).unsqueeze(-1), 0.0)
        kept = torch.arange(self.size - 2, -1, -1, device=x.device).unsqueeze(1) <= age[-1]
        after = window[-(self.size - 1) :].masked_fill(~kept.unsqueeze(-1), 0.0)
        return nn.functional.silu(y), after.transpose(0, 1)
