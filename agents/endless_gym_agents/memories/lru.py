"""LRU: a linear recurrence with a diagonal complex matrix, between linear layers.

Orvieto et al., "Resurrecting Recurrent Neural Networks for Long Sequences", 2023 (https://arxiv.org/abs/2303.06349). The
recurrence is that of its sections 3.3 and 3.4, with N complex entries of the state:

    h_t = lambda * h_{t-1} + gamma * (B u_t)                    state, complex (batch, N); products with * are elementwise
    y_t = Re(C h_t) + D * u_t
    lambda = exp(-exp(nu) + i exp(theta))                       magnitude below 1 for all nu
    gamma = sqrt(1 - |lambda|^2)                                normalisation, at initialisation; learnt as its logarithm

At initialisation lambda is uniform on the ring between the radii r_min and r_max, up to the phase `max_phase`, and B and C are
Gaussian with variance 1 / (2 width) and 1 / N. A GELU and a gated linear unit follow, as in the paper's figure 1, in a residual
layer:

    (a_t, g_t) = W gelu(y_t),   output: a_t * sigmoid(g_t)

Where an episode starts, lambda is 0 for that step, as Lu et al. reset S5 ("Structured State Space Models for In-Context
Reinforcement Learning", 2023, https://arxiv.org/abs/2303.03982).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.scans import linear_scan
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class LRU(SequenceModel):
    """The state is h: its real and imaginary parts, float32 (B, N) each. N is the width."""

    residual = True

    def __init__(
        self, input_width: int, width: int, r_min: float = 0.9, r_max: float = 0.999, max_phase: float = 0.314
    ) -> None:
        """Make the layer; the defaults of `r_min`, `r_max` and `max_phase` are those of the paper's tasks with long sequences."""
        super().__init__()
        self.width, self.state_shapes = width, {"real": (width,), "imaginary": (width,)}
        square = torch.rand(width) * (r_max**2 - r_min**2) + r_min**2
        self.nu = nn.Parameter(torch.log(-0.5 * torch.log(square)))
        self.theta = nn.Parameter(torch.log(max_phase * torch.rand(width).clamp_min(1e-3)))
        self.log_gamma = nn.Parameter(0.5 * torch.log(1.0 - square))
        # Real and imaginary rows of B, and columns of C.
        self.b = nn.Parameter(torch.randn(2 * width, input_width) / math.sqrt(2 * input_width))
        self.c = nn.Parameter(torch.randn(width, 2 * width) / math.sqrt(width))
        self.d = nn.Parameter(torch.randn(width))
        self.gate = nn.Linear(width, 2 * width)

    def eigenvalues(self) -> Tensor:
        """lambda, complex64 (N,)."""
        return torch.polar(torch.exp(-self.nu.exp()), self.theta.exp())

    def inputs(self, x: Tensor) -> Tensor:
        """Gamma * (B u), complex64 (..., N)."""
        real, imaginary = (nn.functional.linear(x, self.b).unflatten(-1, (2, -1)) * self.log_gamma.exp()).unbind(-2)
        return torch.complex(real, imaginary)

    def outputs(self, x: Tensor, h: Tensor) -> Tensor:
        """The output from the inputs and the states, float32 (..., width)."""
        # Re(C h) = Re(C) Re(h) - Im(C) Im(h); the sign is part of the weights.
        y = nn.functional.linear(torch.cat([h.real, h.imag], dim=-1), self.c) + self.d * x
        return nn.functional.glu(self.gate(nn.functional.gelu(y)))

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h = self.eigenvalues() * torch.complex(state["real"], state["imaginary"]) + self.inputs(x)
        return self.outputs(x, h), {"real": h.real, "imaginary": h.imag}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        h = linear_scan(self.eigenvalues(), self.inputs(x), torch.complex(state["real"], state["imaginary"]), resets)
        return self.outputs(x, h), {"real": h[-1].real, "imaginary": h[-1].imag}
