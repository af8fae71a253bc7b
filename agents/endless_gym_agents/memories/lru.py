"""LRU: a linear recurrence with a diagonal complex matrix, between linear layers.

Orvieto et al., "Resurrecting Recurrent Neural Networks for Long Sequences", 2023 (https://arxiv.org/abs/2303.06349). The
recurrence is that of its sections 3.3 and 3.4, with N complex entries of the state:

    h_t = lambda * h_{t-1} + gamma * (B u_t)                    state, complex (batch, N); products with * are elementwise
    y_t = Re(C h_t) + D * u_t
    lambda = exp(-exp(nu) + i exp(theta))                       magnitude below 1 for all nu
    gamma = sqrt(1 - |lambda|^2)                                normalisation, at initialisation; learnt as its logarithm

At initialisation lambda is uniform on the ring between the radii r_min and r_max, up to the phase `max_phase`, and B and C are
Gaussian with variance 1 / (2 width) and 1 / N. The block is that of the paper's figure 1, with a GELU and a gated linear unit:

    x + a_t * sigmoid(g_t),   (a_t, g_t) = W gelu(y_t) + b,   u_t = layernorm(x_t)

lambda, gamma and B learn more slowly than other weights, and without weight decay. Initial values, the GELU (by tanh), and the
factor of the learning rate are those of https://github.com/NicolasZucchet/minimal-LRU, after the paper's code. It normalises over
a batch by default; here, its layer normalisation is used, since acting and learning have different batches.

Where an episode starts, lambda is 0 for that step, as Lu et al. reset S5 ("Structured State Space Models for In-Context
Reinforcement Learning", 2023, https://arxiv.org/abs/2303.03982).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.layers import undecayed
from endless_gym_agents.memories.scans import linear_scan
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class LRU(SequenceModel):
    """The state is h: its real and imaginary parts, float32 (B, N) each."""

    residual = True

    def __init__(
        self,
        input_width: int,
        width: int,
        state_size: int = 0,
        r_min: float = 0.0,
        r_max: float = 1.0,
        max_phase: float = 6.28,
        learning_rate_factor: float = 0.5,
    ) -> None:
        """Make the layer.

        Args:
            input_width: Size of the inputs.
            width: Size of the outputs.
            state_size: N; 0 for the width.
            r_min: Smallest initial magnitude of lambda. The paper's tasks with long sequences use 0.9, ...
            r_max: ... and 0.999 for the largest, ...
            max_phase: ... and 0.314 for the largest initial phase.
            learning_rate_factor: Learning rate of lambda, gamma and B, as a multiple of that of other weights.
        """
        super().__init__()
        size = state_size or width
        self.width, self.state_shapes = width, {"real": (size,), "imaginary": (size,)}
        # Logarithms of neither 0 nor 1.
        square = torch.rand(size).clamp(1e-7, 1 - 1e-7) * (r_max**2 - r_min**2) + r_min**2

        def recurrent(value: Tensor) -> nn.Parameter:
            return undecayed(value, learning_rate_factor)

        self.nu = recurrent(torch.log(-0.5 * torch.log(square)))
        self.theta = recurrent(torch.log(max_phase * (1 - torch.rand(size))))
        self.log_gamma = recurrent(0.5 * torch.log(1 - square))
        # Real and imaginary rows of B, and columns of C.
        self.b = recurrent(torch.randn(2 * size, input_width) / math.sqrt(2 * input_width))
        self.c = nn.Parameter(torch.randn(width, 2 * size) / math.sqrt(size))
        self.d = nn.Parameter(torch.randn(width))
        self.gate = nn.Linear(width, 2 * width)
        # LeCun's normal distribution, truncated at two standard deviations, which makes it narrower.
        deviation = width**-0.5 / 0.87962566
        nn.init.trunc_normal_(self.gate.weight, std=deviation, a=-2 * deviation, b=2 * deviation)
        nn.init.zeros_(self.gate.bias)

    def input_norm(self) -> nn.Module:
        return nn.LayerNorm(self.width, eps=1e-6)

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
        return nn.functional.glu(self.gate(nn.functional.gelu(y, approximate="tanh")))

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h = self.eigenvalues() * torch.complex(state["real"], state["imaginary"]) + self.inputs(x)
        return self.outputs(x, h), {"real": h.real, "imaginary": h.imag}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        h = linear_scan(self.eigenvalues(), self.inputs(x), torch.complex(state["real"], state["imaginary"]), resets)
        return self.outputs(x, h), {"real": h[-1].real, "imaginary": h[-1].imag}
