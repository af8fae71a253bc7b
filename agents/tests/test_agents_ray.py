"""The hyperparameter search on Ray Tune."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import optuna
import psutil
import pytest
from agents_helpers import EXPERIMENT
from rich.console import Console

from endless_gym_agents import checkpoint, ray_session, search
from endless_gym_agents.search_study import Trials
from endless_gym_agents.settings import Settings
from endless_gym_agents.train import train

pytest.importorskip("ray")
pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parent / "ray_search.py"
#: A small run with an engine process and a checkpoint after each update.
SMALL = "--preset quick --env MortarMayhem-Grid-v0 --agent gru --environment.num-envs 4 --environment.engine process"
SMALL += " --ppo.steps 16 --ppo.minibatches 1 --checkpoint-interval 1 --recurrence.hidden-size 16"
#: A trainer that is killed after the end of its engine, while it holds an observation in shared memory.
KILLED = """
import os, signal, endless_gym
envs = endless_gym.serve("MortarMayhem-Grid-v0", num_envs=1)
observation, _ = envs.reset()
envs.close()
os.kill(os.getpid(), signal.SIGKILL)
"""
SEARCH = [*SMALL.split(), "--parameters", "ppo.epochs", "--stage", "single"]


@contextlib.contextmanager
def started(folder: Path, *command: str | Path) -> Iterator[subprocess.Popen[bytes]]:
    """Start a program in the folder, with its output in the file `output`; on exit, kill all processes of its session.

    Ray's processes are in the session of the program, so they are killed, too.
    """
    with (folder / "output").open("w") as output:
        process = subprocess.Popen(
            [*command],
            cwd=folder,
            env=os.environ | {"CUDA_VISIBLE_DEVICES": ""},
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    try:
        yield process
    finally:
        for left in _session(process.pid):
            with contextlib.suppress(psutil.Error):
                left.kill()
        process.wait()


def wait_for_updates(process: subprocess.Popen[bytes], folder: Path, *runs: Path) -> None:
    """Wait until each run has completed two updates."""
    while not all((run / "progress.jsonl").exists() and len(_rows(run)) >= 2 for run in runs):
        assert process.poll() is None, (folder / "output").read_text()
        time.sleep(0.01)


def test_search_on_ray(tmp_path: Path, ray_folder: str, segments: Callable[[], set[str]]) -> None:
    """The worst trial is pruned, and the one whose process is killed resumes from its checkpoint.

    The path of the interpreter has a space.
    """
    spaced = tmp_path / "with a space"
    folder_of_environments = Path(sys.executable).parents[2]
    spaced.symlink_to(folder_of_environments)
    python = spaced / Path(sys.executable).relative_to(folder_of_environments)
    pruning = ["--period", "1", "--warm-up", "4", "--startup-trials", "1", "--ppo.updates", "6"]
    with started(tmp_path, python, SCRIPT, *SEARCH, "--folder", "search", *pruning, "--ray", "--workers", "2") as ran:
        assert ran.wait(280) == 0, (tmp_path / "output").read_text()
        assert not segments()
        assert not _left_by(ray_folder)
    folder = tmp_path / "search"
    study = optuna.load_study(study_name="search", storage=f"sqlite:///{folder / 'study.db'}")
    ended = [(trial.params["ppo.epochs"], trial.state.name, trial.value) for trial in study.trials]
    # The trial whose process was killed is still a single trial: Tune resumed it.
    assert ended == [(3, "COMPLETE", 1.0), (2, "PRUNED", 0.5), (4, "COMPLETE", 2.0)]
    reported = [list(trial.intermediate_values) for trial in study.trials]
    assert reported == [[1, 2, 3, 4, 5]] * 3
    # Nothing is reported at the last update; the pruned trial has not reached it.
    assert len(_rows(folder / "trial-0001")) == 5
    assert json.loads((folder / "best.json").read_text())["settings"]["ppo"]["epochs"] == 4
    assert (folder / "threads").read_text() == "1 1"

    # The rows up to the checkpoint are those of the killed process, with its times.
    before = (folder / "killed").read_text().splitlines()
    rows = _rows(folder / "trial-0000")
    assert [json.loads(row)["update"] for row in rows] == [1, 2, 3, 4, 5, 6]
    assert len(before) == 3
    assert (rows[:2], rows[2] == before[2]) == (before[:2], False)

    assert [file.name for file in (folder / "locks").iterdir()] == ["study"]


def test_an_interrupted_search_on_ray_leaves_nothing_and_resumes(
    tmp_path: Path, ray_folder: str, segments: Callable[[], set[str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in a terminal signals all processes of the group."""
    given = [*SEARCH, "--folder", str(tmp_path / "search"), "--ppo.updates", "100000"]
    runs = [tmp_path / "search" / f"trial-000{number}" for number in (0, 1)]
    program = [sys.executable, "-m", "endless_gym_agents.search"]
    with started(tmp_path, *program, *given, "--ray", "--workers", "2") as process:
        wait_for_updates(process, tmp_path, *runs)
        os.killpg(process.pid, signal.SIGINT)
        assert process.wait(60) == 130, (tmp_path / "output").read_text()
        # The engines end on their own after their trainers.
        assert not psutil.wait_procs(_session(process.pid), timeout=30)[1]
    assert "endless-search: stopped" in (tmp_path / "output").read_text()
    assert not _left_by(ray_folder)
    assert not segments()

    # Without Ray, for one more update.
    def one_more(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        return train(given, lambda update, means: watch(update, means) or True)

    monkeypatch.setattr(search, "train", one_more)
    before = [checkpoint.load(run).update for run in runs]
    trials = Trials(search.parse(given), Console(quiet=True))
    assert trials.remaining() == (0, 3)
    for _ in range(3):  # the third trial first, since it was not interrupted
        with pytest.raises(KeyboardInterrupt):
            search.run_trials(trials)
    for run, done in zip(runs, before, strict=True):
        assert checkpoint.load(run).update == done + 1
        assert [json.loads(row)["update"] for row in _rows(run)] == list(range(1, done + 2))


def test_the_end_of_ray_removes_shared_memory_of_killed_trainers(
    tmp_path: Path, ray_folder: str, segments: Callable[[], set[str]]
) -> None:
    with ray_session.connected("local"):
        assert subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path).returncode == -signal.SIGKILL
        assert segments()
    assert not segments()


def test_an_experiment_on_ray_is_stopped_and_resumed(
    tmp_path: Path, ray_folder: str, segments: Callable[[], set[str]]
) -> None:
    """Ctrl-C stops the run after an update, with a checkpoint; the same command then completes it, and then does nothing."""
    (own,) = EXPERIMENT["runs"]
    runs = [own | {"flags": own["flags"] | {"environment.engine": "process"}}]
    (tmp_path / "mine.json").write_text(json.dumps(EXPERIMENT | {"runs": runs}))
    run = tmp_path / "out" / "runs" / "MortarMayhem-Grid-v0" / "gru" / "seed-1"
    program = [sys.executable, "-m", "endless_gym_agents.reproduce", "mine.json", "--out", "out", "--device", "cpu"]

    def reproduced(is_interrupted: bool) -> str:
        with started(tmp_path, *program, "--ray", "--jobs", "1", "--nice", "0") as process:
            if is_interrupted:
                wait_for_updates(process, tmp_path, run)
                os.killpg(process.pid, signal.SIGINT)
            assert process.wait(250) == (130 if is_interrupted else 0), (tmp_path / "output").read_text()
        assert not _left_by(ray_folder)
        assert not segments()
        return (tmp_path / "output").read_text()

    text, done = reproduced(True), len(_rows(run))
    assert f"stopped at update {done} of 6" in text
    assert 2 <= done < 6
    assert checkpoint.load(run).update == done
    assert f"resumed at update {done} of 6" in reproduced(False)
    assert [json.loads(row)["update"] for row in _rows(run)] == [1, 2, 3, 4, 5, 6]
    assert "1 of 1 runs are done" in (tmp_path / "out" / "mine" / "README.md").read_text()
    again = reproduced(False)
    assert "1 of 1 jobs done" in again
    assert "Ray instance" not in again


def _left_by(ray_folder: str) -> list[str]:
    """The command lines of Ray's remaining processes."""
    return [" ".join(line) for line in map(_command_line, psutil.process_iter()) if ray_folder in " ".join(line)]


def _rows(run: Path) -> list[str]:
    return (run / "progress.jsonl").read_text().splitlines()


def _session(session: int) -> list[psutil.Process]:
    """The processes of a session."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(ProcessLookupError):
            if os.getsid(process.pid) == session:
                found.append(process)
    return found


def _command_line(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []
