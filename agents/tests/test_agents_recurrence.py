"""The layers over packed sequences have the same outputs and gradients as PyTorch's layers."""

import pytest
import torch
from torch import nn
from torch.nn.utils.rnn import PackedSequence

from endless_gym_agents.recurrence import packed_layers

LENGTHS = (9, 9, 6, 3, 1)
SIZES = [sum(length > t for length in LENGTHS) for t in range(max(LENGTHS))]


@pytest.mark.parametrize("layers", [1, 2])
@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
@pytest.mark.parametrize("native", [False, True])
def test_outputs_and_gradients_equal_those_of_pytorch(
    native: bool, kind: type[nn.GRU] | type[nn.LSTM], layers: int
) -> None:
    torch.manual_seed(1)
    recurrent = kind(5, 7, layers)
    x = torch.randn(sum(LENGTHS), 5, requires_grad=True)
    hidden = torch.randn(2 if kind is nn.LSTM else 1, layers, len(LENGTHS), 7)
    output = packed_layers(x, recurrent.all_weights, hidden, SIZES, native)
    expected, _ = recurrent(PackedSequence(x, torch.tensor(SIZES)), hidden[0] if kind is nn.GRU else tuple(hidden))
    torch.testing.assert_close(output, expected.data, rtol=0, atol=1e-6)
    weight = torch.randn_like(output)
    named = {"x": x, **dict(recurrent.named_parameters())}
    gradients, references = (
        torch.autograd.grad((result * weight).sum(), list(named.values())) for result in (output, expected.data)
    )
    for name, gradient, reference in zip(named, gradients, references, strict=True):
        assert reference.abs().max() > 0, name
        torch.testing.assert_close(
            gradient, reference, rtol=1e-5, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}"
        )
