"""Stable Hadamard Memory: a matrix whose entries are weakened or strengthened one by one.

Le, Do and Nguyen, "Stable Hadamard Memory: Revitalizing Memory-Augmented Agents for Reinforcement Learning", 2024
(https://arxiv.org/abs/2410.10132), section 3. With H = `memory_size`:

    M_t = M_{t-1} * C_t + U_t                               state, (H, H); all products with * are elementwise
    C_t = 1 + tanh(theta_t v_c(u_t)^T)                      calibration, between 0 and 2
    U_t = eta(u_t) v(u_t) k(u_t)^T                          update; eta = sigmoid(w^T u_t)
    y_t = W M_t q(u_t)

Keys k and queries q are ReLUs divided by their sum, as in the paper's code. theta_t is one of L = 128 learnt rows. The paper
draws it at random for each step, so that the calibrations of different steps are nearly independent and their product does not
grow. Here step t of an episode takes row 37 t modulo L: all rows in turn, and the same when acting and when
learning.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.scans import linear_scan, steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, State

#: L and the distance between the rows of two steps, which has no divisor in common with it.
ROWS, STRIDE = 128, 37


class SHM(SequenceModel):
    """The state is M, float32 (B, H, H), and the number of steps, float32 (B, 1)."""

    residual = True

    def __init__(self, input_width: int, width: int, memory_size: int = 32) -> None:
        """Make the layer with a memory of H = `memory_size`."""
        super().__init__()
        self.width, self.size = width, memory_size
        self.enter = nn.Linear(input_width, 4 * memory_size + 1, bias=False)
        self.theta = nn.Parameter(nn.init.xavier_uniform_(torch.empty(ROWS, memory_size)))
        self.leave = nn.Linear(memory_size, width)
        self.state_shapes = {"m": (memory_size, memory_size), "steps": (1,)}

    def split(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries (..., H), C and U (..., H, H) for steps float32 (..., 1)."""
        q, k, v, vc, eta = self.enter(x).split([self.size] * 4 + [1], dim=-1)
        q, k = (part.relu() / (1e-5 + part.relu().sum(-1, keepdim=True)) for part in (q, k))
        theta = self.theta[(time.squeeze(-1).long() * STRIDE) % ROWS]
        calibration = 1 + torch.tanh(theta.unsqueeze(-1) * vc.unsqueeze(-2))
        return q, calibration, (eta.sigmoid() * v).unsqueeze(-1) * k.unsqueeze(-2)

    def outputs(self, m: Tensor, q: Tensor) -> Tensor:
        """The output W M q."""
        return self.leave((m @ q.unsqueeze(-1)).squeeze(-1))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        q, calibration, update = self.split(x, state["steps"])
        m = torch.addcmul(update, calibration, state["m"])
        return self.outputs(m, q), {"m": m, "steps": state["steps"] + 1}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        time = steps_of_episode(state["steps"], resets)
        q, calibration, update = self.split(x, time)
        m = linear_scan(calibration, update, state["m"], resets)
        return self.outputs(m, q), {"m": m[-1], "steps": time[-1] + 1}
