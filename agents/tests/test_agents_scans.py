"""Scans over whole sequences have the same results and gradients as plain loops."""

import pytest
import torch
from torch import Tensor

from endless_gym_agents.memories import scans

STEPS, ENVS = 37, 3


def resets() -> Tensor:
    drawn = torch.rand(STEPS, ENVS, generator=torch.Generator().manual_seed(1)) < 0.2
    drawn[:, 0] = False
    drawn[0, 1] = True
    return drawn


@pytest.mark.parametrize("dtype", [torch.float64, torch.complex128])
@pytest.mark.parametrize("form", [scans.sequential, scans.associative])
def test_a_linear_scan_equals_a_loop(form: object, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scans, "scan", form)
    torch.manual_seed(1)
    decay, inputs = (torch.randn(STEPS, ENVS, 4, dtype=dtype, requires_grad=True) for _ in range(2))
    state = torch.randn(ENVS, 4, dtype=dtype, requires_grad=True)
    states = scans.linear_scan(decay, inputs, state, resets())
    expected, h = [], state
    for a, b, reset in zip(decay, inputs, resets(), strict=True):
        h = a * torch.where(reset[:, None], 0.0, h) + b
        expected.append(h)
    torch.testing.assert_close(states, torch.stack(expected))
    weight = torch.randn_like(states)
    for one, other in zip(
        *(
            torch.autograd.grad((result * weight).sum().abs(), (decay, inputs, state))
            for result in (states, torch.stack(expected))
        ),
        strict=True,
    ):
        assert other.abs().max() > 0
        torch.testing.assert_close(one, other)
