"""Dense layers: their initial weights, and their forward pass while acting."""

from __future__ import annotations

import math
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
