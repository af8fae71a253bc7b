"""Dense layers: their initial weights, how they learn, and their forward pass while acting."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias, TypeVar

import torch
from torch import Tensor, nn

Layer = TypeVar("Layer", nn.Linear, nn.Conv2d, nn.ConvTranspose2d)
#: Bias (outputs,) and transposed weight (inputs, outputs) of a linear layer.
Affine: TypeAlias = tuple[Tensor, Tensor]


def orthogonal(layer: Layer, gain: float = math.sqrt(2)) -> Layer:
    """Initialise the layer's weights with a scaled orthogonal matrix, in place, and return the layer."""
    nn.init.orthogonal_(layer.weight, gain)
    return layer


def transposed(layer: nn.Module, dtype: torch.dtype) -> Affine:
    """Bias and transposed weight of a layer; the weight is contiguous, which a product with few rows needs to be fast."""
    assert isinstance(layer, nn.Linear)
    return layer.bias.detach().to(dtype), layer.weight.detach().t().to(dtype).contiguous()


def linear_relu(x: Tensor, layer: Affine) -> Tensor:
    """A linear layer followed by a ReLU, float (n, outputs), for inputs float (n, inputs)."""
    return torch.addmm(layer[0], x, layer[1]).relu_()


def undecayed(value: Tensor, learning_rate_factor: float = 1.0) -> nn.Parameter:
    """A parameter without weight decay, whose learning rate is the optimizer's times a factor."""
    parameter = nn.Parameter(value)
    parameter._no_weight_decay, parameter._learning_rate_factor = True, learning_rate_factor  # type: ignore[attr-defined]
    return parameter


def divided(channels: int, parts: int) -> int:
    """The number of channels of each part.

    Raises:
        ValueError: The channels cannot be divided.
    """
    if channels < parts or channels % parts:
        raise ValueError(
            f"{channels} channels cannot be divided by {parts}; choose another --recurrence.hidden-size or --agent-option"
        )
    return channels // parts


class FeedForward(nn.Module):
    """The gated feed-forward network that follows a layer in its block, W (f(U n) * V n) for normalised inputs n."""

    def __init__(self, norm: nn.Module, width: int, factor: float, activation: Callable[[Tensor], Tensor]) -> None:
        """Make the network with PyTorch's initial weights; `enter` has the rows of U, then those of V.

        Args:
            norm: Normalisation of the inputs.
            width: Size of inputs and outputs.
            factor: Number of rows of U, as a multiple of `width`; rounded up to a multiple of 16.
            activation: f.
        """
        super().__init__()
        self.norm, self.activation, inner = norm, activation, 16 * math.ceil(factor * width / 16)
        self.enter = nn.Linear(width, 2 * inner, bias=False)
        self.leave = nn.Linear(inner, width, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        one, other = self.enter(self.norm(x)).chunk(2, dim=-1)
        return self.leave(self.activation(one) * other)  # type: ignore[no-any-return]
