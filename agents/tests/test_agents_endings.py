"""How runs end before their last update: divergence, signals, and other processes in the same folder."""

import errno
import json
import os
import pty
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from agents_helpers import changed, small

from endless_gym_agents.common.command import STOP_SIGNALS
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training import train as training
from endless_gym_agents.training.logs import MissingRow, read_progress
from endless_gym_agents.training.run_folder import RunInUse
from endless_gym_agents.training.train import parse, train


@pytest.mark.parametrize("agent", ["gru", "trxl", "none", "position", "stack", "lstm", "gtrxl"])
def test_a_run_that_diverges_stops_and_keeps_its_last_healthy_checkpoint(
    agent: str, tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(small(agent, tmp_path / "run", updates=1))
    before = (run / "checkpoints" / "last.pt").read_bytes()
    assert call(training.main, "--resume", run, "--ppo.updates", 9, "--ppo.learning-rate", 1e20) == 1
    error = capsys.readouterr().err
    assert error.startswith("endless-train: update 2 diverged: its "), error
    assert "try a smaller --ppo.learning-rate (now " in error and f"--resume {run}, which has" in error
    assert (run / "checkpoints" / "last.pt").read_bytes() == before
    assert len((run / "progress.jsonl").read_text().splitlines()) == 1
    train(parse(["--resume", str(run), "--ppo.updates", "2", "--ppo.learning-rate", "1e-4"]))
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["update"] for row in rows] == [1, 2]


@pytest.mark.parametrize("number", STOP_SIGNALS)
def test_a_signal_stops_a_run_after_its_update_with_a_checkpoint(
    number: signal.Signals, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
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
        assert f"{len(rows)} of 100000 updates done" in capsys.readouterr().out
    assert [signal.getsignal(each) for each in STOP_SIGNALS] == before


@pytest.mark.timeout(600)
def test_a_run_killed_at_any_call_that_changes_its_files_continues_with_one_command(tmp_path: Path) -> None:
    """Without hard links, as on some file systems."""
    library, tests = tmp_path / "kill_at.so", Path(__file__).parent
    source = tests.parents[1] / "tests/kill_at.c"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    given = {"LD_PRELOAD": str(library), "PYTHONPATH": f"{tests}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(
        [sys.executable, tests / "kills.py", tmp_path],
        env=os.environ | given,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    kills = [int(line.split()[0]) for line in done.stdout.splitlines() if line.endswith(" kills")]
    assert len(kills) == 2 and min(kills) > 20, kills


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EDQUOT])
def test_results_without_space_are_one_error_and_keep_the_former_file(error: int, tmp_path: Path) -> None:
    library, folder, work = tmp_path / "kill_at.so", tmp_path / "results", tmp_path / "work.py"
    source = Path(__file__).parents[2] / "tests/kill_at.c"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    folder.mkdir()
    work.write_text("""
import ctypes, itertools, os, sys
from pathlib import Path
from endless_gym_agents.common import atomic, command
from endless_gym_agents.training import run_folder

file = Path(sys.argv[1]) / "results.json"

def write():
    with run_folder.locked(file.parent):
        atomic.write(file, "new" * 10_000)

for number in itertools.count(1):
    file.write_text("former")
    ctypes.CDLL(None).kill_at(bytes(file.parent), number)
    status = command.run("endless-eval", write)
    ctypes.CDLL(None).kill_at(b"/nowhere", 0)
    assert os.listdir(file.parent) == [file.name], number
    if status == 0:
        break
    assert file.read_text() == "former", number
""")
    given = {"LD_PRELOAD": str(library), "KILL_ERROR": str(error)}
    done = subprocess.run([sys.executable, work, folder], env=os.environ | given, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) >= 5, lines
    assert all(f"[Errno {error}] {os.strerror(error)}: '{folder}" in line for line in lines), lines


def test_a_missing_row_is_an_error(tmp_path: Path) -> None:
    run = train(small("none", tmp_path / "run"))
    file = run / "progress.jsonl"
    one, two, three = rows = file.read_text().splitlines(keepends=True)
    for text, update in (
        ("", 1),
        (two + three, 1),
        (one + three, 2),
        (one + two[1:] + three, 2),
        ("".join(rows).strip(), 3),
    ):
        file.write_text(text)
        with pytest.raises(MissingRow, match=f"row of update {update}"):
            train(replace(small("none", tmp_path, updates=4), resume=str(run)))
        assert file.read_text() == text
    # Without its checkpoint, a run that has begun does not start again.
    file.write_text("".join(rows))
    (run / "checkpoints" / "last.pt").unlink()
    with pytest.raises(FileNotFoundError, match=r"no checkpoint .*last\.pt"):
        train(replace(small("none", tmp_path, updates=4), resume=str(run)))


def test_a_run_without_a_checkpoint_starts_again_from_its_settings(tmp_path: Path) -> None:
    weights = train(small("none", tmp_path / "weights", updates=1))
    given = replace(small("none", tmp_path / "run"), init_from=str(weights))
    run, expected = train(given), train(replace(given, run=str(tmp_path / "expected")))
    shutil.rmtree(run / "checkpoints")
    (run / "progress.jsonl").write_text("")
    with pytest.raises(FileExistsError, match=f"continue it with --resume {run}"):
        train(given)
    train(parse(["--resume", str(run)]))
    one, two = (checkpoint.load(each).agent.state_dict() for each in (run, expected))
    assert all(torch.equal(part, two[name]) for name, part in one.items())


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
    given = replace(given, checkpoint_interval=100)
    run = train(given, lambda update, means: saved.append(checkpoint.load(tmp_path / "run").update) or False)
    # At the third update, the checkpoint of the second is there; those that only the time asked for are not kept.
    assert saved == [0, 1, 2]
    assert [file.name for file in checkpoint.files(run)] == ["update-000000.pt", "update-000003.pt"]


@pytest.mark.parametrize("interval", [1, 2, 100])
def test_a_run_ends_within_its_time_limit(interval: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With simulated time: an update takes 10 seconds, the second 15, to save 3, and to load 4."""
    seconds, save, load, learn = 0.0, checkpoint.save, checkpoint.load, training.learn

    def passes(duration: float, result: Any = None) -> Any:
        nonlocal seconds
        seconds += duration
        return result

    monkeypatch.setattr(training, "time", SimpleNamespace(monotonic=lambda: seconds))
    monkeypatch.setattr(checkpoint, "save", lambda *given: passes(3, save(*given)))
    monkeypatch.setattr(checkpoint, "load", lambda *given: passes(4, load(*given)))
    monkeypatch.setattr(training, "learn", lambda *given: passes(15 if given[4] == 1 else 10, learn(*given)))
    given = small("none", tmp_path / "run", updates=99)
    run = train(replace(given, time_limit=1.0, checkpoint_interval=interval))
    assert seconds == {1: 47, 2: 44, 100: 51}[interval]
    assert checkpoint.load(run).update == len(read_progress(run)) == (4 if interval == 100 else 3)
    seconds = 0.0
    train(parse(["--resume", str(run), "--time-limit", "1"]))
    assert seconds == {1: 56, 2: 53, 100: 47}[interval]


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
    while len(read_progress(run)) < 2:
        assert process.poll() is None and time.monotonic() < end
        if select.select([leader], [], [], 0.05)[0]:
            os.read(leader, 65536)
    os.close(leader)
    assert process.wait(60) == 0
    assert checkpoint.load(run).update == len(read_progress(run)) < 2000


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


def in_the_meantime(start: Callable[[], object]) -> Callable[[int, dict[str, float]], bool]:
    """A function for `train` that starts something else after the first update."""

    def watch(update: int, means: dict[str, float]) -> bool:
        if update == 1:
            start()
        return False

    return watch


def test_a_second_process_cannot_train_in_the_folder_of_a_run(tmp_path: Path) -> None:
    run = tmp_path / "run"
    refused = pytest.raises(RunInUse, match=rf"{run} is in use by process {os.getpid()} on .* since 20\d\d-")

    def start() -> None:
        # A lock belongs to the open file, so one in this process stands for one in another.
        with refused:
            train(changed(small("gru", run), ppo={"learning_rate": 1e-3}))
        with refused:
            train(replace(small("gru", run), resume=str(run)))

    train(small("gru", run), in_the_meantime(start))
    train(replace(small("gru", run, updates=5), resume=str(run)), in_the_meantime(start))
    assert [row["update"] for row in read_progress(run)] == [1, 2, 3, 4, 5]
    assert not (run / "lock").exists()


def test_runs_that_start_in_the_same_second_have_different_folders(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(time, "strftime", lambda *_: "20260102-030405")
    others: list[Path] = []
    given = replace(small("none", tmp_path), run="")
    first = train(given, in_the_meantime(lambda: others.extend(train(given) for _ in range(2))))
    name = "runs/MortarMayhem-Grid-v0/none-1-20260102-030405"
    assert [str(run) for run in (first, *others)] == [name, f"{name}-2", f"{name}-3"]
    assert all(len(read_progress(run)) == 3 for run in (first, *others))


def test_a_run_that_cannot_start_leaves_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="colour"):
        train(changed(small("none", tmp_path / "run"), environment={"option": ("colour=1",)}))
    assert not (tmp_path / "run").exists()


def test_processes_started_at_once_train_in_their_own_folders_or_fail(tmp_path: Path) -> None:
    """Two learning rates without a folder, and the same folder twice."""
    common = "--env MortarMayhem-Grid-v0 --preset quick --threads 1 --ppo.steps 16 --ppo.updates"

    def started(arguments: str) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "endless_gym_agents.train", *arguments.split()]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        return subprocess.Popen(command, cwd=tmp_path, text=True, **quiet)

    rates = ("0.001", "0.002")
    learning = [started(f"{common} 8 --ppo.learning-rate {rate}") for rate in rates]
    assert [process.wait(200) for process in learning] == [0, 0]
    runs = sorted((tmp_path / "runs" / "MortarMayhem-Grid-v0").iterdir())
    assert sorted(checkpoint.read_settings(run).ppo.learning_rate for run in runs) == list(map(float, rates))
    assert all([row["update"] for row in read_progress(run)] == list(range(1, 9)) for run in runs)
    processes = [started(f"{common} 100000 --run same") for _ in range(2)]
    end = time.monotonic() + 200
    while not (ended := [process for process in processes if process.poll() is not None]):
        assert time.monotonic() < end
        time.sleep(0.1)
    (refused,) = ended
    assert refused.stderr is not None
    assert "same is in use by process" in refused.stderr.read()
    (other,) = (process for process in processes if process is not refused)
    other.send_signal(signal.SIGTERM)
    assert (refused.returncode, other.wait(60)) == (1, 0)
    rows = read_progress(tmp_path / "same")
    assert [row["update"] for row in rows] == list(range(1, len(rows) + 1))
