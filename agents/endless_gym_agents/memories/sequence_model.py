"""What a recurrent memory computes: one step for acting, whole sequences for learning.

Shapes: T steps of B environments. A state is a tree of tensors: a dict of float32 tensors (B, ...) by name, which are 0 when an
episode starts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeAlias

import torch
from torch import Tensor, nn

#: The state of B environments, float32 (B, ...) each.
State: TypeAlias = dict[str, Tensor]


def restarted(state: State, resets: Tensor) -> State:
    """The state with zeros for the environments that start an episode, bool (B,)."""
    return {name: part.masked_fill(resets.view(-1, *[1] * (part.dim() - 1)), 0.0) for name, part in state.items()}


class SequenceModel(nn.Module, ABC):
    """A recurrent layer, made by `Class(input_width, width, **options)` with `--recurrence.hidden-size` and `--agent-option`."""

    #: Size of the outputs.
    width: int
    #: Shape of each tensor of the state, without the batch dimension.
    state_shapes: dict[str, tuple[int, ...]]
    #: Whether the layer computes a change of its normalised input, x + layer(norm(x)), instead of new features.
    residual = False
    #: What follows such a layer in its block, x + feed_forward(x), and normalises x itself; a layer need not have it.
    feed_forward: nn.Module
    #: Whether native kernels may compute the layer on the CPU.
    native = True

    def input_norm(self) -> nn.Module:
        """A new normalisation of vectors of `width`, for residual layers."""
        return nn.RMSNorm(self.width, eps=1e-5)

    def stacked(self, layers: int) -> None:
        """Adapt the initial weights to the number of layers of the stack, once. This default does not."""

    @abstractmethod
    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        """Compute one step.

        Args:
            x: Inputs, float32 (B, input width).
            state: State before the step.

        Returns:
            The outputs, float32 (B, width), and the state after the step. The given state must not be written.
        """

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        """Compute T steps, with gradients. This default repeats `step`; a scan over all steps at once is faster.

        Args:
            x: Inputs, float32 (T, B, input width).
            state: State before the first step.
            resets: Whether each step is the first of an episode, which starts with the state 0, bool (T, B).

        Returns:
            The outputs, float32 (T, B, width), and the state after the last step.
        """
        outputs = []
        for inputs, restarts in zip(x, resets, strict=True):
            y, state = self.step(inputs, restarted(state, restarts))
            outputs.append(y)
        return torch.stack(outputs), state


class Cell(SequenceModel):
    """A layer around a cell of your own: a `torch.nn.Module` that computes one step.

    The cell is made by `Class(input_width, hidden_size, **options)`, with `--recurrence.hidden-size` and `--agent-option`. Its
    `forward(x, state)` takes inputs float32 (B, input width) and states float32 (B, state width), and returns the outputs
    (B, width) and the next states. Its attributes `width` and `state_width` are the hidden size by default. An episode starts
    with the state 0.
    """

    def __init__(self, cell: nn.Module, hidden_size: int) -> None:
        """Wrap a cell that was made with `hidden_size`."""
        super().__init__()
        self.cell = cell
        self.width = int(getattr(cell, "width", hidden_size))
        self.state_shapes = {"state": (int(getattr(cell, "state_width", hidden_size)),)}

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        y, after = self.cell(x, state["state"])
        return y, {"state": after}


class Stack(SequenceModel):
    """Layers of one kind, one after another. Residual layers have a normalised input, and so has what follows the last one."""

    def __init__(
        self, make: type[SequenceModel], input_width: int, width: int, layers: int, options: dict[str, Any]
    ) -> None:
        """Make the layers.

        Raises:
            ValueError: A residual layer whose inputs do not have its width.
        """
        super().__init__()
        self.layers: list[SequenceModel] = nn.ModuleList()  # type: ignore[assignment]
        for _ in range(layers):
            self.layers.append(make(input_width, width, **options))
            if make.residual and input_width != self.layers[-1].width:
                raise ValueError(
                    f"{make.__name__} needs inputs of its width {self.layers[-1].width}, got {input_width}; add "
                    "--recurrence.embedding"
                )
            self.layers[-1].stacked(layers)
            input_width = self.layers[-1].width
        self.width = input_width
        norms = [*self.layers, self.layers[-1]] if make.residual else []
        self.norms: list[nn.Module] = nn.ModuleList(layer.input_norm() for layer in norms)  # type: ignore[assignment]
        self.state_shapes = {
            f"{number}.{name}": shape
            for number, layer in enumerate(self.layers)
            for name, shape in layer.state_shapes.items()
        }

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        return self._run(x, state, None)

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        return self._run(x, state, resets)

    def _run(self, x: Tensor, state: State, resets: Tensor | None) -> tuple[Tensor, State]:
        after: State = {}
        for number, layer in enumerate(self.layers):
            before = {name: state[f"{number}.{name}"] for name in layer.state_shapes}
            inputs = self.norms[number](x) if self.norms else x
            y, changed = layer.step(inputs, before) if resets is None else layer.sequence(inputs, before, resets)
            x = x + y if self.norms else y
            if hasattr(layer, "feed_forward"):
                x = x + layer.feed_forward(x)
            after |= {f"{number}.{name}": part for name, part in changed.items()}
        return self.norms[-1](x) if self.norms else x, after
