"""The layers over packed sequences, native and not, have the same outputs and gradients as PyTorch's layers."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence

from endless_gym import _native
from endless_gym_agents.memories.kernels import KernelGRU, KernelMinGRU
from endless_gym_agents.memories.recurrence import packed_layers


def batches() -> list[tuple[int, list[int]]]:
    """Hidden sizes and numbers of sequences per step; the shapes are random, and some sequences have one step."""
    draws = np.random.default_rng(1)
    shapes = [(1, [1]), (33, [1]), (7, [3, 1]), (128, [8] * 32)]
    for _ in range(12):
        lengths = [1, *draws.integers(1, 30, draws.integers(1, 20)).tolist()]
        sizes = [sum(length > t for length in lengths) for t in range(max(lengths))]
        shapes.append((int(draws.integers(1, 70)), sizes))
    return shapes


def min_gru(inputs: Tensor, hidden: Tensor, sizes: list[int]) -> Tensor:
    """The equations of minGRU in PyTorch."""
    outputs = []
    for x in inputs.split(sizes):
        z, candidate = x[:, : hidden.shape[1]].sigmoid(), x[:, hidden.shape[1] :]
        hidden = (1 - z) * hidden[: len(x)] + z * candidate
        outputs.append(hidden)
    return torch.cat(outputs)


def check(named: dict[str, Tensor], output: Tensor, expected: Tensor) -> None:
    """Compare outputs, and the gradients of all tensors for a random gradient of the outputs."""
    torch.testing.assert_close(output, expected, rtol=1e-5, atol=1e-5)
    weight = torch.randn_like(output) / len(output) ** 0.5
    gradients, references = (
        torch.autograd.grad((result * weight).sum(), list(named.values())) for result in (output, expected)
    )
    for name, gradient, reference in zip(named, gradients, references, strict=True):
        assert reference.abs().max() > 0, name
        torch.testing.assert_close(
            gradient, reference, rtol=1e-5, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}"
        )


@pytest.mark.parametrize("shape", batches(), ids=str)
@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
@pytest.mark.parametrize("native", [False, True])
def test_layers_equal_those_of_pytorch(
    native: bool, kind: type[nn.GRU] | type[nn.LSTM], shape: tuple[int, list[int]]
) -> None:
    width, sizes = shape
    torch.manual_seed(1)
    layers = kind(5, width, num_layers=2)
    x = torch.randn(sum(sizes), 5, requires_grad=True)
    hidden = torch.randn(2 if kind is nn.LSTM else 1, 2, sizes[0], width)
    expected, _ = layers(PackedSequence(x, torch.tensor(sizes)), hidden[0] if kind is nn.GRU else tuple(hidden))
    output = packed_layers(x, layers.all_weights, hidden, sizes, native)
    check({"x": x, **dict(layers.named_parameters())}, output, expected.data)


@pytest.mark.parametrize("shape", batches(), ids=str)
def test_min_gru_equals_its_equations(shape: tuple[int, list[int]]) -> None:
    width, sizes = shape
    torch.manual_seed(1)
    hidden = torch.randn(sizes[0], width, requires_grad=True)
    inputs = torch.randn(sum(sizes), 2 * width, requires_grad=True)
    output, expected = KernelMinGRU.apply(inputs, hidden, sizes), min_gru(inputs, hidden, sizes)
    check({"inputs": inputs, "hidden": hidden}, output, expected)


def test_gradients_are_the_same_when_they_are_computed_twice() -> None:
    inputs = torch.randn(5, 6, requires_grad=True)
    output = KernelGRU.apply(inputs, torch.randn(6, 2), torch.randn(6), torch.randn(3, 2), [3, 2]).sum()
    first, second = (torch.autograd.grad(output, inputs, retain_graph=True)[0] for _ in range(2))
    torch.testing.assert_close(first, second, rtol=0, atol=0)


def test_arrays_of_other_shapes_or_sizes_are_refused() -> None:
    def forward(
        inputs: int = 5, saved: int = 10, sizes: tuple[int, ...] = (3, 2), resets: tuple[bool, ...] = ()
    ) -> None:
        shapes = (inputs, 6), (6, 2), (6,), (3, 2), (5, saved), (5, 2)
        arrays = [np.zeros(shape, np.float32) for shape in shapes]
        _native.gru_forward(*arrays[:4], sizes, resets, *arrays[4:])

    forward()
    with pytest.raises(ValueError, match=r"inputs must have the shape \[5, 6\], got \[4, 6\]"):
        forward(inputs=4)
    with pytest.raises(ValueError, match=r"saved must have the shape \[5, 10\], got \[5, 9\]"):
        forward(saved=9)
    with pytest.raises(ValueError, match="the sizes must not increase"):
        forward(sizes=(2, 3))
    with pytest.raises(ValueError, match="with 4 sequences, got"):
        forward(sizes=(4, 1))
    with pytest.raises(ValueError, match="one reset for each of 5 steps or none, got 1"):
        forward(resets=(True,))
    with pytest.raises(TypeError, match="contiguous"):
        strided = np.zeros((5, 12), np.float32)[:, ::2]
        others = [np.zeros(shape, np.float32) for shape in ((6, 2), (6,), (3, 2), (5, 10), (5, 2))]
        _native.gru_forward(strided, *others[:3], (3, 2), (), *others[3:])
