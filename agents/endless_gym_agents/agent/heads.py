"""The heads: policy, value, and the auxiliary heads that reconstruct the frame and estimate the ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor, nn

from endless_gym_agents.memories.layers import orthogonal


class PolicyHead(nn.Module):
    """The policy of a multi-discrete action, with independent branches."""

    def __init__(self, input_width: int, width: int, branches: Sequence[int]) -> None:
        """Make the head.

        Args:
            input_width: Size of the input vectors.
            width: Units of the hidden layer.
            branches: Number of choices of each branch.
        """
        super().__init__()
        self.hidden = nn.Sequential(orthogonal(nn.Linear(input_width, width)), nn.ReLU())
        # Small weights make the initial policy nearly uniform.
        self.branches = nn.ModuleList(orthogonal(nn.Linear(width, choices), 0.1) for choices in branches)

    def forward(self, x: Tensor) -> list[Tensor]:
        """The logits of each branch, a list of float32 (n, choices), for inputs float (n, input width)."""
        x = self.hidden(x)
        return [branch(x).float() for branch in self.branches]


class Perceptron(nn.Module):
    """Two fully connected layers, for example to estimate `info["ground_truth"]`."""

    def __init__(self, input_width: int, width: int, outputs: int, gain: float = math.sqrt(2)) -> None:
        """Make the head with `width` hidden units; `gain` scales the initial weights of the output layer."""
        super().__init__()
        self.layers = nn.Sequential(
            orthogonal(nn.Linear(input_width, width)), nn.ReLU(), orthogonal(nn.Linear(width, outputs), gain)
        )

    def forward(self, x: Tensor) -> Tensor:
        """float32 (n, outputs), for inputs float (n, input width)."""
        outputs: Tensor = self.layers(x)
        return outputs.float()


class ValueHead(Perceptron):
    """The state value: an estimate of the discounted return."""

    def __init__(self, input_width: int, width: int, gain: float) -> None:
        """Make the head with `width` hidden units; `gain` scales the initial weights of the output layer."""
        super().__init__(input_width, width, 1, gain)

    def forward(self, x: Tensor) -> Tensor:
        """The values, float32 (n,), for inputs float (n, input width)."""
        return super().forward(x).squeeze(-1)


class ReconstructionHead(nn.Module):
    """The mirror image of `AtariEncoder`, with transposed convolutions: reconstructs the observed frame."""

    def __init__(self, input_width: int, channels: int) -> None:
        """Make the head for frames with `channels` channels."""
        super().__init__()
        self.layers = nn.Sequential(
            *(orthogonal(nn.Linear(input_width, 64 * 7 * 7)), nn.ReLU(), nn.Unflatten(1, (64, 7, 7))),
            *(orthogonal(nn.ConvTranspose2d(64, 64, 3, stride=1)), nn.ReLU()),
            *(orthogonal(nn.ConvTranspose2d(64, 32, 4, stride=2)), nn.ReLU()),
            orthogonal(nn.ConvTranspose2d(32, channels, 8, stride=4)),
        )

    def forward(self, x: Tensor) -> Tensor:
        """The logits of the frame, float32 (n, channels, 84, 84), for inputs float (n, input width)."""
        logits: Tensor = self.layers(x)
        return logits.float()
