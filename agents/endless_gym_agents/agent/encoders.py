"""The encoder: from observations to the input vectors of the memory.

An observation is a dict of tensors with the keys of the observation space: `visual_observation` uint8 (n, 84, 84, channels),
`features` and `vector_observation` float32 (n, k).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym_agents.memories.layers import orthogonal

#: An observation of n environments, by key.
Observation = dict[str, Tensor]
#: Shapes of one environment's observation, by key, without the batch dimension.
Shapes = Mapping[str, tuple[int, ...]]

#: Key of the frames in an observation.
FRAME = "visual_observation"

#: Frames per chunk on the CPU. The activations between a chunk's layers then stay in the CPU's cache, which saves a quarter of
#: the time.
FRAMES_PER_CHUNK = 128


class AtariEncoder(nn.Module):
    """The convolutional network of DQN (Mnih et al., 2015) without its fully connected layers."""

    #: Size of the output vectors.
    width = 64 * 7 * 7

    def __init__(self, channels: int) -> None:
        """Make the network for frames with `channels` channels."""
        super().__init__()
        self.convolutions = nn.Sequential(
            *(orthogonal(nn.Conv2d(channels, 32, 8, stride=4)), nn.ReLU()),
            *(orthogonal(nn.Conv2d(32, 64, 4, stride=2)), nn.ReLU()),
            *(orthogonal(nn.Conv2d(64, 64, 3, stride=1)), nn.ReLU()),
            nn.Flatten(),
        )

    def forward(self, frames: Tensor) -> Tensor:
        """Encode frames, uint8 (n, 84, 84, channels), as float (n, 3136)."""
        if frames.device.type == "cpu" and len(frames) > FRAMES_PER_CHUNK:
            return torch.cat([self(chunk) for chunk in frames.split(FRAMES_PER_CHUNK)])
        # The permuted view already has PyTorch's channels_last memory format; the conversion is the only copy, and bfloat16 holds
        # every byte exactly. Dividing the weights of the first convolution by 255 costs less than dividing the frames.
        first = self.convolutions[0]
        assert isinstance(first, nn.Conv2d)
        dtype = torch.get_autocast_dtype(frames.device.type) if torch.is_autocast_enabled(frames.device.type) else None
        x = frames.permute(0, 3, 1, 2).to(dtype or torch.float32)
        x = functional.conv2d(x, first.weight / 255.0, first.bias, first.stride)
        for layer in self.convolutions[1:]:
            x = layer(x)
        return x


class Encoder(nn.Module):
    """Encodes frames with `AtariEncoder` and all vectors with one fully connected layer, and concatenates both."""

    def __init__(self, shapes: Shapes, vector_width: int) -> None:
        """Make the encoder.

        Args:
            shapes: Shapes of one environment's observation; the vectors are concatenated in this order.
            vector_width: Units of the fully connected layer.

        Raises:
            ValueError: The frames are not of 84 x 84 pixels.
        """
        super().__init__()
        if FRAME in shapes and shapes[FRAME][:2] != (84, 84):
            raise ValueError(f"frames must be of 84 x 84 pixels without an --encoder of your own, got {shapes[FRAME]}")
        self.vectors = [key for key in shapes if key != FRAME]
        self.frames = AtariEncoder(shapes[FRAME][-1]) if FRAME in shapes else None
        entries = sum(shapes[key][0] for key in self.vectors)
        self.vector = nn.Sequential(orthogonal(nn.Linear(entries, vector_width)), nn.ReLU()) if entries else None
        self.width = (AtariEncoder.width if self.frames else 0) + (vector_width if self.vector else 0)

    def forward(self, observation: Observation) -> Tensor:
        """Encode an observation of n environments as float (n, width)."""
        parts = []
        if self.frames is not None:
            parts.append(self.frames(observation[FRAME]))
        if self.vector is not None:
            parts.append(self.vector(torch.cat([observation[key] for key in self.vectors], dim=-1)))
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)


class OwnEncoder(Encoder):
    """An encoder of your own: a `torch.nn.Module` made by `Class(shapes, **options)`, with the options of `--encoder-option`.

    Its `forward(observation)` encodes an observation of n environments as float (n, width). It must treat each environment's
    observation by itself, since equal frames are encoded once.
    """

    def __init__(self, make: type[nn.Module], shapes: Shapes, options: dict[str, Any]) -> None:
        """Make the encoder, and encode a blank observation to learn its width.

        Args:
            make: The class.
            shapes: Shapes of one environment's observation.
            options: Further arguments of the class.

        Raises:
            ValueError: The class does not take these arguments, or does not encode such an observation.
        """
        nn.Module.__init__(self)
        self.vectors, self.frames, self.vector = [], None, None
        try:
            self.own = make(dict(shapes), **options)
        except TypeError as error:
            raise ValueError(f"{make.__name__} cannot be made of shapes and --encoder-option: {error}") from error
        blank = {
            key: torch.zeros((2, *shape), dtype=torch.uint8 if key == FRAME else torch.float32)
            for key, shape in shapes.items()
        }
        try:
            with torch.no_grad():
                encoded = self.own.eval()(blank)
        except (RuntimeError, ValueError, TypeError, KeyError) as error:
            raise ValueError(f"{make.__name__} cannot encode an observation of {dict(shapes)}: {error}") from error
        self.own.train()
        if not isinstance(encoded, Tensor) or encoded.dim() != 2 or len(encoded) != 2:
            got = tuple(encoded.shape) if isinstance(encoded, Tensor) else type(encoded).__name__
            raise ValueError(f"{make.__name__} must encode n observations as a tensor (n, width), got {got} for n = 2")
        self.width = encoded.shape[1]

    def forward(self, observation: Observation) -> Tensor:
        encoded: Tensor = self.own(observation)
        return encoded
