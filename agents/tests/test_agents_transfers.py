"""Copies between the host and a device."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from endless_gym_agents.training.transfers import HostCopy

CHECKS = ["copies", "early_release", "killed_engine", "closing", "kept_arrays", "rollouts", "training"]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("check", CHECKS)
def test_copies_to_another_device(check: str, tmp_path: Path) -> None:
    program = f"""
import sys

sys.path.append({str(Path(__file__).parent)!r})
import on_other_device

on_other_device.run({check!r}, {str(tmp_path)!r})
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]


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
