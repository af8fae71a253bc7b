"""What is computed from the memory's output."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from endless_gym.agents.encoders import orthogonal


class PolicyHead(nn.Module):
    """Unnormalised log-probabilities for each branch of a multi-discrete action: a list of (n, choices)."""

    def __init__(self, input_width: int, width: int, branches: Sequence[int]) -> None:
        super().__init__()
        self.hidden = nn.Sequential(orthogonal(nn.Linear(input_width, width)), nn.ReLU())
        # Small weights: at the start all actions are about as likely.
        self.branches = nn.ModuleList(orthogonal(nn.Linear(width, choices), 0.1) for choices in branches)

    def forward(self, x: Tensor) -> list[Tensor]:
        x = self.hidden(x)
        return [branch(x).float() for branch in self.branches]


class ValueHead(nn.Module):
    """The expected return, (n,)."""

    def __init__(self, input_width: int, width: int, gain: float) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            orthogonal(nn.Linear(input_width, width)), nn.ReLU(), orthogonal(nn.Linear(width, 1), gain)
        )

    def forward(self, x: Tensor) -> Tensor:
        value: Tensor = self.layers(x).squeeze(-1)
        return value.float()


class ReconstructionHead(nn.Module):
    """The Atari encoder backwards: logits of the frame, (n, channels, 84, 84)."""

    def __init__(self, input_width: int, channels: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *(orthogonal(nn.Linear(input_width, 64 * 7 * 7)), nn.ReLU(), nn.Unflatten(1, (64, 7, 7))),
            *(orthogonal(nn.ConvTranspose2d(64, 64, 3, stride=1)), nn.ReLU()),
            *(orthogonal(nn.ConvTranspose2d(64, 32, 4, stride=2)), nn.ReLU()),
            orthogonal(nn.ConvTranspose2d(32, channels, 8, stride=4)),
        )

    def forward(self, x: Tensor) -> Tensor:
        logits: Tensor = self.layers(x)
        return logits.float()


class GroundTruthHead(nn.Module):
    """An estimate of what `info["ground_truth"]` says, (n, entries)."""

    def __init__(self, input_width: int, width: int, entries: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            orthogonal(nn.Linear(input_width, width)), nn.ReLU(), orthogonal(nn.Linear(width, entries))
        )

    def forward(self, x: Tensor) -> Tensor:
        estimate: Tensor = self.layers(x)
        return estimate.float()
