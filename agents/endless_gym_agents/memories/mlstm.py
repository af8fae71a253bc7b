"""mLSTM: an LSTM whose cell is a matrix, with exponential input gates; a part of xLSTM.

Beck et al., "xLSTM: Extended Long Short-Term Memory", 2024 (https://arxiv.org/abs/2405.04517), in the block of its figure 11 with
M = `expand` * width channels:

    (u_t, z_t) = W_up x_t                                                   u, z (M)
    c_t = silu(convolution of the last 4 u)
    q_t = W_q c_t,   k_t = W_k c_t,   v_t = W_v u_t                          in blocks of 4 channels, without biases
    i~_t = W_i (q_t, k_t, v_t) + b_i,   f~_t = W_f (q_t, k_t, v_t) + b_f     one number per head
    output: W_down ((norm(h_t) + skip * c_t) * silu(z_t))

and for each head with K = M / heads, equations 19 to 27, where i = exp(i~) and f = sigmoid(f~):

    C_t = f_t C_{t-1} + i_t v_t k_t^T / sqrt(K),   n_t = f_t n_{t-1} + i_t k_t / sqrt(K)        cell (K, K), normaliser (K)
    h_t = C_t q_t / (max(|n_t^T q_t|, 1))

The norm subtracts the mean of a head. Cell and normaliser are stored divided by exp(m_t), as in the paper's equation 15, so that
i_t cannot overflow, and the denominator is that of the authors' package `xlstm` 2.0.6, which adds a small number:

    m_t = max(log f_t + m_{t-1}, i~_t),   h_t = C_t q_t / (max(|n_t^T q_t|, exp(-m_t)) + 1e-6)        C, n divided by exp(m)

Here m_t is at least -40, so that exp(-m_t) cannot overflow either. The normaliser is stored as another column of values, all 1.
Initial values are those of the package. It rounds M up to a multiple of 64; here, M must be one of 4 and of the heads.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import ShortConvolution, chunks, heads_first, log_decays
from endless_gym_agents.memories.layers import divided, undecayed
from endless_gym_agents.memories.sequence_model import SequenceModel, State

#: Channels of a block of queries, keys and values.
BLOCK = 4
#: Smallest m.
SMALLEST = -40.0


class MLSTM(SequenceModel):
    """The state is C^T with n as last column, float32 (B, heads, K, K + 1), divided by exp(m); m; and that of the convolution."""

    residual = True

    def __init__(self, input_width: int, width: int, heads: int = 4, expand: int = 2, conv: bool = True) -> None:
        """Make the layer.

        Args:
            input_width: Size of the inputs.
            width: Size of the outputs.
            heads: Number of heads.
            expand: Channels of all heads, as a multiple of `width`; a multiple of 4 and of `heads`.
            conv: Whether there is a convolution; without, c_t is u_t.
        """
        super().__init__()
        self.width, self.heads, inner = width, heads, expand * width
        size, blocks = divided(inner, heads), divided(inner, BLOCK)
        self.enter = nn.Linear(input_width, 2 * inner, bias=False)
        self.convolution = ShortConvolution(inner) if conv else None
        small = (2 / (5 * width)) ** 0.5
        nn.init.normal_(self.enter.weight, std=small)
        # W_q with W_k, and W_v.
        self.of_convolved = nn.Parameter(small * torch.randn(blocks, 2 * BLOCK, BLOCK))
        self.of_inputs = nn.Parameter(small * torch.randn(blocks, BLOCK, BLOCK))
        self.gates = nn.Linear(3 * inner, 2 * heads)
        nn.init.zeros_(self.gates.weight)
        self.gates.bias.data = torch.cat([0.1 * torch.randn(heads), torch.linspace(3, 6, heads)])
        self.norm, self.skip = undecayed(torch.ones(inner)), undecayed(torch.ones(inner))
        self.leave = nn.Linear(inner, width, bias=False)
        nn.init.normal_(self.leave.weight, std=2 / width**0.5)
        self.state_shapes = {"c": (heads, size, size + 1), "m": (heads,)}
        if self.convolution is not None:
            self.state_shapes["convolution"] = self.convolution.state_shape

    def stacked(self, layers: int) -> None:
        self.leave.weight.data /= layers

    def input_norm(self) -> nn.Module:
        return nn.LayerNorm(self.width, eps=1e-5, bias=False)

    def split(self, u: Tensor, c: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Queries, keys, values with another entry 1, log(i) and log(f)."""
        qk = torch.einsum("...bi,boi->...bo", c.unflatten(-1, (-1, BLOCK)), self.of_convolved)
        q, k = (part.flatten(-2) for part in qk.chunk(2, dim=-1))
        v = torch.einsum("...bi,boi->...bo", u.unflatten(-1, (-1, BLOCK)), self.of_inputs).flatten(-2)
        log_i, log_f = self.gates(torch.cat([q, k, v], dim=-1)).chunk(2, dim=-1)
        q, k, v = (part.unflatten(-1, (self.heads, -1)) for part in (q, k, v))
        v = torch.cat([v, torch.ones_like(v[..., :1])], dim=-1)
        return q, k * k.shape[-1] ** -0.5, v, log_i, nn.functional.logsigmoid(log_f)

    def outputs(self, y: Tensor, m: Tensor, c: Tensor, z: Tensor) -> Tensor:
        """The output from C q and n^T q, both divided by exp(m), as one vector, and from m, c and z."""
        h = y[..., :-1] / (torch.maximum(y[..., -1].abs(), torch.exp(-m)) + 1e-6).unsqueeze(-1)
        h = nn.functional.layer_norm(h, h.shape[-1:], eps=1e-5).flatten(-2) * self.norm
        return self.leave((h + self.skip * c) * nn.functional.silu(z))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        u, z = self.enter(x).chunk(2, dim=-1)
        convolved, after = u, {}
        if self.convolution is not None:
            convolved, after["convolution"] = self.convolution.step(u, state["convolution"])
        q, k, v, log_i, log_f = self.split(u, convolved)
        m = torch.maximum(log_f + state["m"], log_i).clamp_min(SMALLEST)
        kept, added = torch.exp(log_f + state["m"] - m), torch.exp(log_i - m)
        c = torch.addcmul(kept[..., None, None] * state["c"], (added.unsqueeze(-1) * k).unsqueeze(-1), v.unsqueeze(-2))
        y = (q.unsqueeze(-2) @ c).squeeze(-2)
        return self.outputs(y, m, convolved, z), {"c": c, "m": m, **after}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        u, z = self.enter(x).chunk(2, dim=-1)
        convolved, after = u, {}
        if self.convolution is not None:
            convolved, after["convolution"] = self.convolution.sequence(u, state["convolution"], resets)
        c, m, outputs, scales = state["c"], state["m"], [], []
        for q, k, v, entry, forget, starts in chunks(*self.split(u, convolved), resets):
            between, before = log_decays(forget, starts)
            before = before + m.unsqueeze(-1)
            # An episode starts with m = 0.
            first = torch.where(starts.unsqueeze(-1), torch.maximum(entry, forget), entry)
            scale = torch.maximum((between + heads_first(first).unsqueeze(-2)).amax(-1), before).clamp_min(SMALLEST)
            weights = torch.exp(between + heads_first(entry).unsqueeze(-2) - scale.unsqueeze(-1))
            kept, q, k, v = torch.exp(before - scale), heads_first(q), heads_first(k), heads_first(v)
            outputs.append(((weights * (q @ k.mT)) @ v + kept.unsqueeze(-1) * (q @ c)).permute(2, 0, 1, 3))
            scales.append(scale.permute(2, 0, 1))
            c = kept[..., -1, None, None] * c + k.mT @ (weights[..., -1, :].unsqueeze(-1) * v)
            m = scale[..., -1]
        y = self.outputs(torch.cat(outputs), torch.cat(scales), convolved, z)
        return y, {"c": c, "m": m, **after}
