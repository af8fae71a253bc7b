"""From observations to the vectors that the memory takes.

An observation is a dict of tensors, keyed as the environments' spaces are: `visual_observation` uint8 (n, 84, 84, channels),
`features` and `vector_observation` float32 (n, k).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TypeVar

import torch
from torch import Tensor, nn

Observation = dict[str, Tensor]
#: Shapes of one environment's observation, by key.
Shapes = Mapping[str, tuple[int, ...]]

FRAME = "visual_observation"

Layer = TypeVar("Layer", nn.Linear, nn.Conv2d, nn.ConvTranspose2d)


def orthogonal(layer: Layer, gain: float = math.sqrt(2)) -> Layer:
    """The layer with orthogonal weights."""
    nn.init.orthogonal_(layer.weight, gain)
    return layer


#: Frames that a processor convolves at a time: what lies between two layers then stays in its cache, which saves a quarter of the
#: time.
FRAMES_IN_PIECE = 128


class AtariEncoder(nn.Module):
    """The convolutions of the Atari agents: frames uint8 (n, 84, 84, channels) to features (n, 3136)."""

    width = 64 * 7 * 7

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.convolutions = nn.Sequential(
            *(orthogonal(nn.Conv2d(channels, 32, 8, stride=4)), nn.ReLU()),
            *(orthogonal(nn.Conv2d(32, 64, 4, stride=2)), nn.ReLU()),
            *(orthogonal(nn.Conv2d(64, 64, 3, stride=1)), nn.ReLU()),
            nn.Flatten(),
        )

    def forward(self, frames: Tensor) -> Tensor:
        if frames.device.type == "cpu" and len(frames) > FRAMES_IN_PIECE and not torch.compiler.is_compiling():
            return torch.cat([self(piece) for piece in frames.split(FRAMES_IN_PIECE)])
        # The permuted view of frames with their channels last is PyTorch's channels_last format: nothing is copied but the
        # conversion to float.
        x: Tensor = self.convolutions(frames.permute(0, 3, 1, 2).float() / 255.0)
        return x


class Encoder(nn.Module):
    """Encodes every part of an observation and concatenates: (n, width)."""

    def __init__(self, shapes: Shapes, vector_width: int) -> None:
        super().__init__()
        self.vectors = [key for key in shapes if key != FRAME]
        self.frames = AtariEncoder(shapes[FRAME][-1]) if FRAME in shapes else None
        entries = sum(shapes[key][0] for key in self.vectors)
        self.vector = nn.Sequential(orthogonal(nn.Linear(entries, vector_width)), nn.ReLU()) if entries else None
        self.width = (AtariEncoder.width if self.frames else 0) + (vector_width if self.vector else 0)

    def forward(self, observation: Observation) -> Tensor:
        parts = []
        if self.frames is not None:
            parts.append(self.frames(observation[FRAME]))
        if self.vector is not None:
            parts.append(self.vector(torch.cat([observation[key] for key in self.vectors], dim=-1)))
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)
