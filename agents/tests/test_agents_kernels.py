"""GRU and LSTM layers, native and fused, and minGRU have the outputs and gradients of PyTorch's operations, with resets."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from other_device import REPLACED
from torch import Tensor

from endless_gym import _native
from endless_gym_agents.memories import fused
from endless_gym_agents.memories.gated import GRU, LSTM
from endless_gym_agents.memories.mingru import MinGRU
from endless_gym_agents.memories.sequence_model import SequenceModel

#: Steps, sequences and hidden size; sequences are divided among threads.
SHAPES = [(1, 1, 1), (1, 3, 33), (32, 8, 128), (5, 9, 7), (29, 1, 12), (3, 17, 40)]


def fused_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compute the layers as on CUDA, but for the fused cells themselves."""
    monkeypatch.setattr(fused, "aten", SimpleNamespace(**REPLACED))
    monkeypatch.setattr("endless_gym_agents.memories.gated.KernelGRU", fused.FusedGRU)
    monkeypatch.setattr("endless_gym_agents.memories.gated.KernelLSTM", fused.FusedLSTM)


def results(
    layers: SequenceModel, sequence: Any, x: Tensor, state: dict[str, Tensor], resets: Tensor
) -> dict[str, Tensor]:
    """Outputs, the state after the last step, and the gradients of everything for a random gradient of the outputs."""
    x, state = x.clone().requires_grad_(), {name: part.clone().requires_grad_() for name, part in state.items()}
    outputs, after = sequence(layers, x, state, resets)
    named = {"x": x, **state, **dict(layers.named_parameters())}
    weight = torch.randn(outputs.shape, generator=torch.Generator().manual_seed(2)) / outputs.numel() ** 0.5
    gradients = torch.autograd.grad((outputs * weight).sum(), list(named.values()), retain_graph=True)
    again = torch.autograd.grad((outputs * weight).sum(), list(named.values()))
    assert all(map(torch.equal, gradients, again))
    after = {f"{name} after": part.detach() for name, part in after.items()}
    return {"outputs": outputs.detach(), **after, **dict(zip(named, gradients, strict=True))}


@pytest.mark.parametrize("resetting", [False, True])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("kind", ["gru", "lstm", "mingru", "fused gru", "fused lstm"])
def test_layers_equal_the_loop_over_their_steps(
    kind: str, shape: tuple[int, int, int], resetting: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, sequences, width = shape
    torch.manual_seed(1)
    if "fused" in kind:
        fused_layers(monkeypatch)
    layers = MinGRU(5, width) if kind == "mingru" else {"gru": GRU, "lstm": LSTM}[kind.split()[-1]](5, width, 2)
    given = (
        torch.randn(steps, sequences, 5),
        {name: torch.randn(sequences, *shape) for name, shape in layers.state_shapes.items()},
        (torch.rand(steps, sequences) < 0.3) & resetting,
    )
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    expected = results(layers, SequenceModel.sequence, *given)
    torch.testing.assert_close(results(layers, type(layers).sequence, *given), expected, rtol=1e-5, atol=1e-6)


def test_arrays_of_other_shapes_are_refused() -> None:
    def forward(columns: int = 6, saved: int = 10, resets: int = 6) -> None:
        shapes = (6, columns), (6, 2), (6,), (3, 2), (6, saved), (6, 2)
        arrays = [np.zeros(shape, np.float32) for shape in shapes]
        _native.gru_forward(*arrays[:4], np.zeros(resets, bool), *arrays[4:])

    forward()
    with pytest.raises(ValueError, match=r"inputs must have the shape \[6, 6\], got \[6, 5\]"):
        forward(columns=5)
    with pytest.raises(ValueError, match=r"saved must have the shape \[6, 10\], got \[6, 9\]"):
        forward(saved=9)
    with pytest.raises(ValueError, match="reset"):
        forward(resets=5)
    with pytest.raises(TypeError, match="contiguous"):
        strided = np.zeros((6, 12), np.float32)[:, ::2]
        others = [np.zeros(shape, np.float32) for shape in ((6, 2), (6,), (3, 2), (6, 10), (6, 2))]
        _native.gru_forward(strided, *others[:3], np.zeros(6, bool), *others[3:])


def test_pytorch_has_the_fused_cells_as_expected() -> None:
    """They run on CUDA only; a version of PyTorch that changes them fails here."""
    found = [str(getattr(torch.ops.aten, name).default._schema) for name in REPLACED if "thnn" in name]
    assert found == [
        "aten::_thnn_fused_gru_cell(Tensor input_gates, Tensor hidden_gates, Tensor hx, Tensor? input_bias=None, "
        "Tensor? hidden_bias=None) -> (Tensor, Tensor)",
        "aten::_thnn_fused_gru_cell_backward(Tensor grad_hy, Tensor workspace, bool has_bias) -> "
        "(Tensor, Tensor, Tensor, Tensor, Tensor)",
        "aten::_thnn_fused_lstm_cell(Tensor input_gates, Tensor hidden_gates, Tensor cx, Tensor? input_bias=None, "
        "Tensor? hidden_bias=None) -> (Tensor, Tensor, Tensor)",
        "aten::_thnn_fused_lstm_cell_backward_impl(Tensor? grad_hy, Tensor? grad_cy, Tensor cx, Tensor cy, "
        "Tensor workspace, bool has_bias) -> (Tensor, Tensor, Tensor)",
    ]
