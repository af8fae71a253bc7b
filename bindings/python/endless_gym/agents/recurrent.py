"""Memory in a hidden state: GRU and LSTM.

While learning, segments are cut where episodes start, and where gradients are to stop. The pieces are packed: the steps
number t of all that are long enough stand next to each other. No time is spent on padding, and as many steps have to wait
for one another as the longest piece has.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence

from endless_gym.agents.encoders import orthogonal
from endless_gym.agents.memory import Memory, Plan, State, shares
from endless_gym.agents.settings import Recurrence


class RecurrentState(State):
    """The hidden state, and those of the running segment that sequences start from.

    Attributes:
        hidden: (parts, layers, n, hidden size); a GRU's state has one part, an LSTM's two: hidden and cell state.
        starts: The hidden states before steps 0, L, 2L, ... of the segment, for sequences of length L.
        time: Steps since the segment began.
        steps: Steps of the segment; 0 where nothing is recorded.
    """

    def __init__(self, hidden: Tensor) -> None:
        self.hidden = hidden
        self.starts: list[Tensor] = []
        self.time = self.steps = 0

    def tensors(self) -> dict[str, Any]:
        return {"hidden": self.hidden}

    def load(self, tensors: dict[str, Any]) -> None:
        self.hidden = tensors["hidden"].to(self.hidden.device)


@dataclass
class RecurrentPlan(Plan):
    """Packed sequences, the longest first.

    Attributes:
        batch_sizes: How many sequences have a step number t, int64 on the CPU (longest,).
        start: Their states before their first steps, (parts, layers, sequences, hidden size).
    """

    batch_sizes: Tensor
    start: Tensor


class RecurrentMemory(Memory):
    """An optional fully connected layer, then GRU or LSTM layers."""

    def __init__(
        self, kind: Literal["gru", "lstm"], input_width: int, settings: Recurrence, device: torch.device
    ) -> None:
        super().__init__()
        self.settings = settings
        self.width = settings.hidden_size
        self.parts = 2 if kind == "lstm" else 1
        self.device = device
        if settings.residual and not settings.embedding and input_width != self.width:
            raise ValueError(
                f"a residual connection needs inputs of the hidden size, {self.width}, not {input_width}; "
                "use --recurrence.embedding"
            )
        self.embedding = None
        if settings.embedding:
            self.embedding = nn.Sequential(orthogonal(nn.Linear(input_width, self.width)), nn.ReLU())
        layers = nn.LSTM if kind == "lstm" else nn.GRU
        self.recurrent = layers(self.width if settings.embedding else input_width, self.width, settings.layers)
        for name, parameter in self.recurrent.named_parameters():
            if "weight" in name:
                nn.init.orthogonal_(parameter, 2**0.5)
            else:
                nn.init.zeros_(parameter)

    def initial_state(self, num_envs: int) -> RecurrentState:
        shape = (self.parts, self.settings.layers, num_envs, self.width)
        return RecurrentState(torch.zeros(shape, device=self.device))

    def begin_segment(self, state: State, steps: int) -> None:
        assert isinstance(state, RecurrentState)
        state.starts, state.time, state.steps = [], 0, steps

    def step(self, x: Tensor, state: State, first: Tensor) -> tuple[Tensor, Tensor]:
        assert isinstance(state, RecurrentState)
        hidden = state.hidden.masked_fill(first[:, None], 0.0)
        x = self._embedded(x).float()
        with self._precisely():
            y, after = self.recurrent(x.unsqueeze(0), self._split(hidden))
        y = y.squeeze(0)
        return y + x if self.settings.residual else y, self._joined(after)

    def remember(self, state: State, news: Tensor) -> None:
        assert isinstance(state, RecurrentState)
        if state.time < state.steps and state.time % self.settings.sequence_length == 0:
            state.starts.append(state.hidden)
        # A new tensor each time, never written into: the states of sequences' starts stay as they were.
        state.hidden, state.time = news.float(), state.time + 1

    def plan(
        self, states: Sequence[State], first: Tensor, minibatches: int, generator: torch.Generator
    ) -> Sequence[RecurrentPlan]:
        length, (steps, envs) = self.settings.sequence_length, first.shape
        stored = torch.stack(
            [
                torch.cat([state.starts[cut] for state in states if isinstance(state, RecurrentState)], dim=2)
                for cut in range(-(-steps // length))
            ]
        )  # (cuts, parts, layers, N, hidden size)
        # Sequences start at every `length` steps and with each episode. In the order of environments, then of steps:
        starts = first.t().clone()
        starts[:, ::length] = True
        env, time = starts.nonzero(as_tuple=True)
        at = env * steps + time
        lengths = torch.cat([at[1:], torch.tensor([envs * steps])]) - at
        plans = []
        for chosen in shares(lengths.tolist(), minibatches, generator):
            chosen = chosen[lengths[chosen].argsort(descending=True, stable=True)]
            n, t, own = env[chosen], time[chosen], lengths[chosen]
            later = torch.arange(int(own[0])).unsqueeze(1)  # (longest, 1)
            exists = later < own
            packed = ((t + later) * envs + n)[exists]
            state = stored[(t // length).to(stored.device), :, :, n.to(stored.device)]
            state = state.permute(1, 2, 0, 3).masked_fill(first[t, n].to(stored.device)[:, None], 0.0)
            plans.append(RecurrentPlan(packed.to(self.device), exists.sum(1), state.contiguous()))
        return plans

    def forward(self, x: Tensor, plan: RecurrentPlan) -> Tensor:
        x = self._embedded(x).float()
        with self._precisely():
            packed, _ = self.recurrent(PackedSequence(x, plan.batch_sizes), self._split(plan.start))
        y: Tensor = packed.data
        return y + x if self.settings.residual else y

    def _precisely(self) -> torch.autocast:
        """In float32: PyTorch would give cuDNN's layers float16 where bfloat16 is asked for."""
        return torch.autocast(self.device.type, enabled=False)

    def _embedded(self, x: Tensor) -> Tensor:
        if self.embedding is not None:
            x = self.embedding(x)
        return x

    def _split(self, hidden: Tensor) -> Tensor | tuple[Tensor, Tensor]:
        """As PyTorch's layers take it."""
        return hidden[0] if self.parts == 1 else (hidden[0], hidden[1])

    def _joined(self, hidden: Tensor | tuple[Tensor, Tensor]) -> Tensor:
        return hidden.unsqueeze(0) if isinstance(hidden, Tensor) else torch.stack(hidden)
