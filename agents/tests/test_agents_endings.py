"""How runs end before their last update: divergence, signals, and other processes in the same folder."""

import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from agents_helpers import changed, settings

from endless_gym_agents import checkpoint, enjoy, protocol
from endless_gym_agents import train as training
from endless_gym_agents.command import STOP_SIGNALS
from endless_gym_agents.logs import read_progress
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


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_stops_a_run_after_its_update_with_a_checkpoint(number: signal.Signals, tmp_path: Path) -> None:
    before = [signal.getsignal(each) for each in STOP_SIGNALS]
    for attempt in range(3):
        # From another process, at any moment of an update. Schedulers and terminals may send several signals at once.
        sent = f"sleep {0.2 + 0.13 * attempt}; kill -{number.name[3:]} {os.getpid()}; kill -TERM {os.getpid()}"

        def begin(update: int, means: dict[str, float], sent: str = sent) -> bool:
            if update == 1:
                subprocess.Popen(["sh", "-c", sent])
            return False

        run = train(small("gru", tmp_path / str(attempt), updates=100_000), begin)
        rows = read_progress(run)
        assert 1 < len(rows) < 100_000
        assert checkpoint.load(run).update == rows[-1]["update"] == len(rows)
    assert [signal.getsignal(each) for each in STOP_SIGNALS] == before


def test_an_ignored_hang_up_stays_ignored(tmp_path: Path) -> None:
    """`nohup` ignores it."""

    def hang_up(update: int, means: dict[str, float]) -> bool:
        os.kill(os.getpid(), signal.SIGHUP)
        return False

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert len(read_progress(train(small("none", tmp_path / "run"), hang_up))) == 3
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_checkpoint_is_written_after_some_minutes(tmp_path: Path) -> None:
    saved = []
    given = replace(small("none", tmp_path / "run"), checkpoint_minutes=1e-9, keep_checkpoints=True)
    run = train(given, lambda update, means: saved.append(checkpoint.load(tmp_path / "run").update) or False)
    # At the third update, the checkpoint of the second is there; those that only the time asked for are not kept.
    assert saved == [0, 1, 2]
    assert [file.name for file in checkpoint.files(run)] == ["update-000000.pt", "update-000003.pt"]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["thread", "process"])
def test_a_run_whose_terminal_is_closed_writes_a_checkpoint(engine: str, tmp_path: Path) -> None:
    """A real terminal, whose end sends SIGHUP and refuses all later output."""
    run = tmp_path / "run"
    leader, follower = pty.openpty()
    arguments = f"--env MortarMayhem-Grid-v0 --preset quick --run {run} --threads 1 --environment.engine {engine}"
    process = subprocess.Popen(
        ["setsid", "--ctty", sys.executable, "-m", "endless_gym_agents.train", *arguments.split()],
        **dict.fromkeys(("stdin", "stdout", "stderr"), follower),
    )
    os.close(follower)
    end = time.monotonic() + 120
    while not (run / "progress.jsonl").exists() or len(read_progress(run)) < 2:
        assert process.poll() is None and time.monotonic() < end
        if select.select([leader], [], [], 0.05)[0]:
            os.read(leader, 65536)
    os.close(leader)
    assert process.wait(60) == 0
    assert checkpoint.load(run).update == len(read_progress(run)) < 2000


@pytest.mark.slow
def test_a_run_outlives_the_reader_of_its_output(tmp_path: Path) -> None:
    run = tmp_path / "run"
    arguments = f"--env MortarMayhem-Grid-v0 --preset quick --run {run} --threads 1 --ppo.updates 6 --ppo.steps 8"
    command = [sys.executable, "-m", "endless_gym_agents.train", *arguments.split()]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.wait(120) == 0
    assert checkpoint.load(run).update == len(read_progress(run)) == 6
