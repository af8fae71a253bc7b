"""Stable Hadamard Memory: a matrix whose entries are weakened or strengthened one by one.

Le, Do and Nguyen, "Stable Hadamard Memory: Revitalizing Memory-Augmented Agents for Reinforcement Learning", 2024
(https://arxiv.org/abs/2410.10132), section 3. With H = `memory_size`:

    u_t = LayerNorm(x_t)
    M_t = M_{t-1} * C_t + U_t                               state, (H, H); all products with * are elementwise
    C_t = 1 + tanh(theta_t v_c(u_t)^T)                      calibration, between 0 and 2
    U_t = eta(u_t) v(u_t) k(u_t)^T                          update; eta = sigmoid(w^T u_t)
    y_t = W (M_t q(u_t) + V u_t)

Keys k and queries q are ReLUs divided by 1e-5 plus their sum, as in the authors' code (thaihungle/SHM). theta_t is one of L =
128 learnt rows. The paper draws it at random for each step, so that the calibrations of different steps are nearly independent
and their product does not grow; drawn anew, it would differ between acting and learning. Here step t of an episode takes row
`stride` t modulo L: all rows in turn with 37. With 0 it is always row 0, which is what the authors' code for POPGym and
their `shm.py` compute; M then overflows in long episodes. Their agent for meta-learning (`pomdp-baselines`) draws rows, and
limits the entries of M to +-100, which `limit` does here. Both agents have the term V u_t, and `shm.py` has not (`shortcut`).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from endless_gym_agents.memories.scans import linear_scan, steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, State

#: L.
ROWS = 128


class SHM(SequenceModel):
    """The state is M, float32 (B, H, H), and the number of steps, float32 (B, 1)."""

    def __init__(
        self,
        input_width: int,
        width: int,
        memory_size: int = 32,
        stride: int = 37,
        limit: float | None = None,
        shortcut: bool = True,
    ) -> None:
        """Make the layer with a memory of H = `memory_size`; the other options are explained above."""
        super().__init__()
        self.width, self.size, self.stride, self.limit = width, memory_size, stride, limit
        self.norm = nn.LayerNorm(input_width)
        self.enter = nn.Linear(input_width, 4 * memory_size + 1, bias=False)
        self.shortcut = nn.Linear(input_width, memory_size) if shortcut else None
        self.theta = nn.Parameter(nn.init.xavier_uniform_(torch.empty(ROWS, memory_size)))
        self.leave = nn.Linear(memory_size, width)
        self.state_shapes = {"m": (memory_size, memory_size), "steps": (1,)}

    def rows(self, time: Tensor) -> Tensor:
        """The row of theta at each step float32 (..., 1) of an episode, int64 (...)."""
        return (time.squeeze(-1).long() * self.stride) % ROWS

    def split(self, x: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Queries (..., H), C and U (..., H, H) for normalised inputs and steps float32 (..., 1)."""
        q, k, v, vc, eta = self.enter(x).split([self.size] * 4 + [1], dim=-1)
        q, k = (part.relu() / (1e-5 + part.relu().sum(-1, keepdim=True)) for part in (q, k))
        theta = self.theta[self.rows(time)]
        calibration = 1 + torch.tanh(theta.unsqueeze(-1) * vc.unsqueeze(-2))
        return q, calibration, (eta.sigmoid() * v).unsqueeze(-1) * k.unsqueeze(-2)

    def outputs(self, u: Tensor, m: Tensor, q: Tensor) -> Tensor:
        """The output W (M q + V u)."""
        y = (m @ q.unsqueeze(-1)).squeeze(-1)
        return self.leave(y if self.shortcut is None else y + self.shortcut(u))  # type: ignore[no-any-return]

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        u = self.norm(x)
        q, calibration, update = self.split(u, state["steps"])
        m = torch.addcmul(update, calibration, state["m"])
        if self.limit is not None:
            m = m.clamp(-self.limit, self.limit)
        return self.outputs(u, m, q), {"m": m, "steps": state["steps"] + 1}

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        if self.limit is not None:
            return super().sequence(x, state, resets)
        u, time = self.norm(x), steps_of_episode(state["steps"], resets)
        q, calibration, update = self.split(u, time)
        m = linear_scan(calibration, update, state["m"], resets)
        return self.outputs(u, m, q), {"m": m[-1], "steps": time[-1] + 1}
