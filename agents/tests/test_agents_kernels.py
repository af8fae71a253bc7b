"""The native kernels have the same outputs and gradients as PyTorch's layers."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence

from endless_gym import _native
from endless_gym_agents.kernels import KernelGRU, KernelLSTM, KernelMinGRU


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
@pytest.mark.parametrize("kind", ["gru", "lstm", "mingru"])
def test_outputs_and_gradients_equal_those_of_pytorch(kind: str, shape: tuple[int, list[int]]) -> None:
    width, sizes = shape
    torch.manual_seed(1)
    parts = 2 if kind == "lstm" else 1
    states = [torch.randn(sizes[0], width, requires_grad=True) for _ in range(parts)]
    if kind == "mingru":
        inputs = torch.randn(sum(sizes), 2 * width, requires_grad=True)
        output, expected = KernelMinGRU.apply(inputs, *states, sizes), min_gru(inputs, *states, sizes)
        return check({"inputs": inputs, "hidden": states[0]}, output, expected)
    layer = (nn.LSTM if kind == "lstm" else nn.GRU)(5, width)
    x = torch.randn(sum(sizes), 5, requires_grad=True)
    weight_ih, weight_hh, bias_ih, bias_hh = layer.all_weights[0]
    hidden = [state.unsqueeze(0) for state in states]
    expected = layer(PackedSequence(x, torch.tensor(sizes)), tuple(hidden) if kind == "lstm" else hidden[0])[0].data
    if kind == "lstm":
        inputs = nn.functional.linear(x, weight_ih, bias_ih + bias_hh)
        output = KernelLSTM.apply(inputs, weight_hh, *states, sizes)
    else:
        output = KernelGRU.apply(nn.functional.linear(x, weight_ih, bias_ih), weight_hh, bias_hh, *states, sizes)
    check(
        {"x": x, **{f"state {i}": state for i, state in enumerate(states)}, **dict(layer.named_parameters())},
        output,
        expected,
    )


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
