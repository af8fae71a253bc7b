"""Copies between the host and a device; `on_other_device.py` checks them on a stand-in for one."""

from types import SimpleNamespace

import pytest
import torch

from endless_gym_agents.training.transfers import HostCopy


def test_copy_waits_on_the_stream_of_its_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """An event recorded without a stream belongs to the current device, which need not be the tensor's."""
    calls = []
    done = SimpleNamespace(record=calls.append, synchronize=lambda: calls.append("wait"))
    copy = HostCopy((2,), torch.long, torch.device("cpu"))
    monkeypatch.setattr(copy, "_module", SimpleNamespace(current_stream=lambda device: f"stream of {device}"))
    monkeypatch.setattr(copy, "_done", done)
    copy.start(torch.tensor([3, 4]))
    copy.wait()
    assert calls == ["stream of cpu", "wait"]
    assert copy.array.tolist() == [3, 4]
