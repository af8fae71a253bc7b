"""mLSTM: an LSTM whose cell is a matrix, with exponential input gates; a part of xLSTM.

Beck et al., "xLSTM: Extended Long Short-Term Memory", 2024 (https://arxiv.org/abs/2405.04517), equations 19 to 27, for each
head with K = width / heads; i and f are one number per head:

    C_t = f_t C_{t-1} + i_t v_t k_t^T,   n_t = f_t n_{t-1} + i_t k_t        cell (K, K), normaliser (K)
    h_t = o_t * (C_t q_t / max(|n_t^T q_t|, 1))                              output
    q_t = W_q u_t + b_q,   k_t = W_k u_t / sqrt(K) + b_k,   v_t = W_v u_t + b_v
    i_t = exp(w_i^T u_t + b_i),   f_t = sigmoid(w_f^T u_t + b_f),   o_t = sigmoid(W_o u_t + b_o)

The heads are normalised before o_t, and a linear layer follows. Cell and normaliser are stored divided by exp(m_t), as in the
paper's equation 15, so that i_t cannot overflow; but m_t is at least 0, so that nothing else can:

    m_t = max(log f_t + m_{t-1}, log i_t, 0)

The normaliser is stored as another column of values, all 1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.attention import chunks, heads_first, log_decays
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class MLSTM(SequenceModel):
    """The state is C^T with n as last column, float32 (B, heads, K, K + 1), both divided by exp(m), and m, float32 (B, heads)."""

    residual = True

    def __init__(self, input_width: int, width: int, heads: int = 4) -> None:
        """Make the layer with the gates of the paper's code: biases of f from 3 to 6, so that heads forget at different rates."""
        super().__init__()
        self.width, self.heads, size = width, heads, width // heads
        self.enter = nn.Linear(input_width, 4 * width)
        self.gates = nn.Linear(input_width, 2 * heads)
        nn.init.zeros_(self.gates.weight)
        self.gates.bias.data = torch.cat([torch.zeros(heads), torch.linspace(3, 6, heads)])
        self.norm = nn.RMSNorm(size, eps=1e-5)
        self.leave = nn.Linear(width, width, bias=False)
        self.state_shapes = {"c": (heads, size, size + 1), "m": (heads,)}

    def split(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Queries, keys, values with another entry 1, the output gate, log(i) and log(f)."""
        q, k, v, gate = self.enter(x).chunk(4, dim=-1)
        q, k, v = (part.unflatten(-1, (self.heads, -1)) for part in (q, k, v))
        log_i, log_f = self.gates(x).chunk(2, dim=-1)
        v = torch.cat([v, torch.ones_like(v[..., :1])], dim=-1)
        return q, k * k.shape[-1] ** -0.5, v, gate, log_i, nn.functional.logsigmoid(log_f)

    def outputs(self, y: Tensor, m: Tensor, gate: Tensor) -> Tensor:
        """The output from C q and n^T q, both divided by exp(m), as one vector, and from m and the output gate."""
        h = y[..., :-1] / torch.maximum(y[..., -1].abs(), torch.exp(-m)).unsqueeze(-1)
        return self.leave(self.norm(h).flatten(-2) * gate.sigmoid())  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        q, k, v, gate, log_i, log_f = self.split(x)
        m = torch.maximum(log_f + state["m"], log_i).clamp_min(0.0)
        kept, added = torch.exp(log_f + state["m"] - m), torch.exp(log_i - m)
        c = kept[..., None, None] * state["c"] + (added.unsqueeze(-1) * k).unsqueeze(-1) * v.unsqueeze(-2)
        return self.outputs((q.unsqueeze(-2) @ c).squeeze(-2), m, gate), {"c": c, "m": m}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        *parts, gate, log_i, log_f = self.split(x)
        c, m, outputs, scales = state["c"], state["m"], [], []
        for q, k, v, entry, forget, starts in chunks(*parts, log_i, log_f, resets):
            between, before = log_decays(forget, starts)
            between, before = between + heads_first(entry).unsqueeze(-2), before + m.unsqueeze(-1)
            scale = torch.maximum(between.amax(-1), before).clamp_min(0.0)
            weights, kept = torch.exp(between - scale.unsqueeze(-1)), torch.exp(before - scale)
            q, k, v = heads_first(q), heads_first(k), heads_first(v)
            outputs.append(((weights * (q @ k.mT)) @ v + kept.unsqueeze(-1) * (q @ c)).permute(2, 0, 1, 3))
            scales.append(scale.permute(2, 0, 1))
            c = kept[..., -1, None, None] * c + (weights[..., -1, :].unsqueeze(-1) * k).mT @ v
            m = scale[..., -1]
        return self.outputs(torch.cat(outputs), torch.cat(scales), gate), {"c": c, "m": m}
