"""GRU and LSTM layers with the equations and the parameters of `torch.nn.GRU` and `torch.nn.LSTM`.

While learning, native kernels compute them on the CPU, and loops over fused cells on CUDA. PyTorch's own layers know no resets
inside a sequence.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from endless_gym_agents.memories.fused import FusedGRU, FusedLSTM
from endless_gym_agents.memories.kernels import KernelGRU, KernelLSTM
from endless_gym_agents.memories.sequence_model import SequenceModel, State


class _Gated(SequenceModel):
    """Stacked layers with orthogonal weights and zero biases. `all_weights` are weights and biases of each, as in PyTorch."""

    #: Names of the parts of a layer's state.
    parts: Sequence[str]
    all_weights: Any

    def __init__(self, input_width: int, width: int, layers: int) -> None:
        """Make the layers."""
        # PyTorch's class follows in the method resolution order.
        super().__init__(input_width, width, layers)
        self.width = width
        self.state_shapes = {f"{part}{layer}": (width,) for layer in range(layers) for part in self.parts}
        for name, parameter in self.named_parameters():
            if "weight" in name:
                nn.init.orthogonal_(parameter, 2**0.5)
            else:
                nn.init.zeros_(parameter)

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        after: State = {}
        for layer, weights in enumerate(self.all_weights):
            names = [f"{part}{layer}" for part in self.parts]
            parts = self.cell(x, [state[name] for name in names], weights)
            x = parts[0]
            after |= zip(names, parts, strict=True)
        return x, after

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        if not (x.is_cuda or (x.device.type == "cpu" and self.native and x.dtype == torch.float32)):
            return super().sequence(x, state, resets)
        after: State = {}
        for layer, weights in enumerate(self.all_weights):
            names = [f"{part}{layer}" for part in self.parts]
            x, parts = self.layer(x, [state[name] for name in names], weights, resets)
            after |= zip(names, parts, strict=True)
        return x, after

    @abstractmethod
    def cell(self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        """One step of a layer: the parts of the state after it, of which the first is the output."""

    @abstractmethod
    def layer(
        self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor], resets: Tensor
    ) -> tuple[Tensor, Sequence[Tensor]]:
        """All steps of a layer: the outputs, and the parts of the state after the last step."""


class GRU(_Gated, nn.GRU):
    """The state of each layer is its output."""

    parts = ("h",)

    def cell(self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        return (torch.gru_cell(x, state[0], *weights),)

    def layer(
        self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor], resets: Tensor
    ) -> tuple[Tensor, Sequence[Tensor]]:
        weight_ih, weight_hh, bias_ih, bias_hh = weights
        layer = FusedGRU if x.is_cuda else KernelGRU
        y: Tensor = layer.apply(functional.linear(x, weight_ih, bias_ih), weight_hh, bias_hh, *state, resets)
        return y, (y[-1],)


class LSTM(_Gated, nn.LSTM):
    """The state of each layer is its output and its cell state."""

    parts = ("h", "c")

    def __init__(self, input_width: int, width: int, layers: int, forget_bias: float = 0.0) -> None:
        """Make the layers with an initial bias of the forget gates (Jozefowicz et al., 2015, recommend 1)."""
        super().__init__(input_width, width, layers)
        for _, _, bias, _ in self.all_weights:
            bias.data[width : 2 * width] = forget_bias

    def cell(self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor]) -> Sequence[Tensor]:
        return torch.lstm_cell(x, list(state), *weights)

    def layer(
        self, x: Tensor, state: Sequence[Tensor], weights: Sequence[Tensor], resets: Tensor
    ) -> tuple[Tensor, Sequence[Tensor]]:
        weight_ih, weight_hh, bias_ih, bias_hh = weights
        layer = FusedLSTM if x.is_cuda else KernelLSTM
        y, cell = layer.apply(functional.linear(x, weight_ih, bias_ih + bias_hh), weight_hh, *state, resets)
        return y, (y[-1], cell)
