"""minGRU: a GRU whose gate and candidate depend on the input only, so that its state is a linear recurrence.

Feng et al., "Were RNNs All We Needed?", 2024 (https://arxiv.org/abs/2410.01201), section 3.1:

    z_t = sigmoid(W_z x_t + b_z)            update gate
    h~_t = W_h x_t + b_h                    candidate
    h_t = (1 - z_t) h_{t-1} + z_t h~_t      state and output, (B, width)

This is the form of the paper's section 3. In appendix B, which computes in log space, the candidate is g(W_h x_t + b_h) with
g(x) = x + 0.5 for x >= 0, else sigmoid(x). With `positive`, so it is here, with PyTorch's initial weights, as in the authors'
code (BorealisAI/minRNNs) and in minGRU-pytorch, which has no biases. The scan needs no log space. The convolution and the
feed-forward part around the layer in the authors' language models are left out.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.kernels import KernelMinGRU
from endless_gym_agents.memories.scans import linear_scan
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class MinGRU(SequenceModel):
    """The state is h, float32 (B, width). `projection` has the rows of W_z, then those of W_h."""

    def __init__(self, input_width: int, width: int, positive: bool = False) -> None:
        """Make the layer, with orthogonal weights and zero biases unless the candidate is `positive`."""
        super().__init__()
        self.width, self.state_shapes, self.positive = width, {"h": (width,)}, positive
        self.projection = nn.Linear(input_width, 2 * width)
        if not positive:
            for part in self.projection.weight.data.chunk(2):
                nn.init.orthogonal_(part)
            nn.init.zeros_(self.projection.bias)

    def projected(self, x: Tensor) -> Tensor:
        """The argument of the gate, then the candidate: (..., 2 width)."""
        projected: Tensor = self.projection(x)
        if not self.positive:
            return projected
        z, candidate = projected.chunk(2, dim=-1)
        return torch.cat([z, torch.where(candidate >= 0, candidate + 0.5, candidate.sigmoid())], dim=-1)

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        z, candidate = self.projected(x).chunk(2, dim=-1)
        h = torch.lerp(state["h"], candidate, z.sigmoid())
        return h, {"h": h}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        projected = self.projected(x)
        if self.native and x.device.type == "cpu" and x.dtype == torch.float32:
            h: Tensor = KernelMinGRU.apply(projected, state["h"], resets)
        else:
            z, candidate = projected.chunk(2, dim=-1)
            z = z.sigmoid()
            h = linear_scan(1 - z, z * candidate, state["h"], resets)
        return h, {"h": h[-1]}
