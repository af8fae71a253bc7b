"""Fast and Forgetful Memory: fixed rates of decay and fixed periods, each with each, for gated inputs.

Morad et al., "Reinforcement Learning with Fast and Forgetful Memory", 2023 (https://arxiv.org/abs/2310.04128), section 4. With
m traces and c contexts:

    x~_t = (W_1 u_t) * sigmoid(W_2 u_t)                             gated input, (m)
    S_t = gamma * S_{t-1} + x~_t 1^T                                state, complex (m, c)
    gamma = exp(-a) exp(i b)^T                                      a (m), b (c), learnt
    z_t = W_3 (Re S_t, Im S_t)
    y_t = LayerNorm(z_t) * g_t + (W_4 u_t) * (1 - g_t),   g_t = sigmoid(W_5 u_t)

Initial values and limits of a are those of the authors' code (proroklab/ffm, `standalone/ffm`), whose a has the other sign:
the slowest trace decays to 1 % and the slowest context turns once in `longest` = 1024 steps, and the fastest trace has the
factor 0.51. The code needs powers of 1 / gamma in double precision, which limits a; the scan here does not, and has the same
limits.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.layers import undecayed
from endless_gym_agents.memories.scans import linear_scan
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class FFM(SequenceModel):
    """The state is S: its real and imaginary parts, float32 (B, m, c) each."""

    def __init__(self, input_width: int, width: int, traces: int = 32, contexts: int = 4, longest: int = 1024) -> None:
        """Make the layer with the paper's sizes m = `traces` and c = `contexts`."""
        super().__init__()
        self.width, self.state_shapes = width, dict.fromkeys(("real", "imaginary"), (traces, contexts))
        self.parts = [traces, traces, width, width]
        self.enter = nn.Linear(input_width, sum(self.parts))
        self.fastest = math.log(torch.finfo(torch.float64).max) / longest - 0.01
        self.a = undecayed(torch.linspace(self.fastest - 0.01, -math.log(0.01) / longest, traces))
        self.b = undecayed(2 * math.pi / torch.linspace(1, longest, contexts))
        self.mix = nn.Linear(2 * traces * contexts, width)
        self.norm = nn.LayerNorm(width, elementwise_affine=False)

    def gamma(self) -> Tensor:
        """gamma, complex64 (m, c); no entry grows."""
        with torch.no_grad():
            self.a.clamp_(1e-8, self.fastest)
        return torch.polar(torch.exp(-self.a).unsqueeze(1).expand(-1, len(self.b)), self.b.expand(len(self.a), -1))

    def split(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The gated input as complex64 (..., m, c), the part that skips the memory, and the gate g."""
        entry, entry_gate, through, gate = self.enter(x).split(self.parts, dim=-1)
        gated = (entry * entry_gate.sigmoid()).unsqueeze(-1).expand(*entry.shape, len(self.b))
        return torch.complex(gated, torch.zeros_like(gated)), through, gate.sigmoid()

    def outputs(self, s: Tensor, through: Tensor, gate: Tensor) -> Tensor:
        """The output y from the states and the other parts."""
        z = self.mix(torch.cat([s.real.flatten(-2), s.imag.flatten(-2)], dim=-1))
        return torch.lerp(through, self.norm(z), gate)

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        entry, through, gate = self.split(x)
        s = self.gamma() * torch.complex(state["real"], state["imaginary"]) + entry
        return self.outputs(s, through, gate), {"real": s.real, "imaginary": s.imag}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        entry, through, gate = self.split(x)
        s = linear_scan(self.gamma(), entry, torch.complex(state["real"], state["imaginary"]), resets)
        return self.outputs(s, through, gate), {"real": s[-1].real, "imaginary": s[-1].imag}
