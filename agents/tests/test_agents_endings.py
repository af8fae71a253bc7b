"""How runs end before their last update: divergence, signals, and other processes in the same folder."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from agents_helpers import changed, settings

from endless_gym_agents import checkpoint, enjoy, protocol
from endless_gym_agents import train as training
from endless_gym_agents.settings import Settings
from endless_gym_agents.train import parse, train


def small(agent: str, run: Path, **ppo: Any) -> Settings:
    given = settings(agent, env="MortarMayhem-Grid-v0", run=str(run), threads=1)
    environment = {"num_envs": 4, "option": ("command_count=[1, 2]",)}
    return changed(given, environment=environment, ppo={"steps": 16, "minibatches": 2, "updates": 3} | ppo)


@pytest.mark.parametrize("agent", ["none", "position", "stack", "gru", "lstm", "trxl", "gtrxl"])
def test_a_run_that_diverges_stops_and_keeps_its_last_healthy_checkpoint(
    agent: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(small(agent, tmp_path / "run", updates=1))
    before = (run / "checkpoints" / "last.pt").read_bytes()
    arguments = f"endless-train --resume {run} --ppo.updates 9 --ppo.learning-rate 1e20"
    monkeypatch.setattr(sys, "argv", arguments.split())
    assert training.main() == 1
    error = capsys.readouterr().err
    assert error.startswith("endless-train: update 2 diverged: its "), error
    assert "try a smaller --ppo.learning-rate (now " in error and f"--resume {run}, which has" in error
    assert (run / "checkpoints" / "last.pt").read_bytes() == before
    assert len((run / "progress.jsonl").read_text().splitlines()) == 1
    train(parse(["--resume", str(run), "--ppo.updates", "2", "--ppo.learning-rate", "1e-4"]))
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == [1, 2]


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_weights_that_are_not_finite_are_refused(
    value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(small("gru", tmp_path / "run", updates=1))
    file = run / "checkpoints" / "last.pt"
    state = torch.load(file)
    state["model"]["body.0.bias"][3] = value
    torch.save(state, file)
    with pytest.raises(ValueError, match=r"last\.pt has weights that are not finite, in body\.0\.bias"):
        checkpoint.load(run)
    for program, arguments in ((training, "--resume"), (protocol, "--last"), (enjoy, "--device cpu")):
        monkeypatch.setattr(sys, "argv", ["program", *arguments.split(), str(run)])
        assert program.main() == 1
        assert "not finite" in capsys.readouterr().err
