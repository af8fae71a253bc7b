"""The hyperparameter search on Ray Tune."""

import contextlib
import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import optuna
import psutil
import pytest

pytestmark = pytest.mark.slow

SCRIPT = Path(__file__).parent / "ray_search.py"


def test_search_on_ray(
    tmp_path: Path, ray_folder: str, libraries_python: str, segments: Callable[[], set[str]]
) -> None:
    """The worst trial is pruned, and the one whose process is killed resumes from its checkpoint."""
    environments = ["--environment.num-envs", "4", "--environment.engine", "process", "--agent", "gru"]
    sizes = ["--ppo.steps", "16", "--ppo.minibatches", "1", "--ppo.updates", "6", "--checkpoint-interval", "1"]
    sizes += ["--recurrence.hidden-size", "16"]
    searched = ["--env", "MortarMayhem-Grid-v0", "--parameters", "ppo.epochs", "--stage", "single"]
    pruning = ["--period", "1", "--warm-up", "4", "--startup-trials", "1"]
    command = ["--preset", "quick", "--folder", "search", *environments, *sizes, *searched, *pruning]
    # Ray's processes are in the session of the search, which can be ended as a whole.
    with subprocess.Popen(
        [libraries_python, SCRIPT, *command, "--ray", "--workers", "2"],
        cwd=tmp_path,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as ran:
        try:
            output, _ = ran.communicate(timeout=280)
        except BaseException:
            _kill_session(ran.pid)
            raise
    assert ran.returncode == 0, output
    folder = tmp_path / "search"
    study = optuna.load_study(study_name="search", storage=f"sqlite:///{folder / 'study.db'}")
    ended = [(trial.params["ppo.epochs"], trial.state.name, trial.value) for trial in study.trials]
    # Also the trial whose process was killed is one trial: Tune resumed it.
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
    assert not segments()
    assert not [process for process in psutil.process_iter() if ray_folder in " ".join(_command_line(process))]


def _rows(run: Path) -> list[str]:
    return (run / "progress.jsonl").read_text().splitlines()


def _kill_session(session: int) -> None:
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if os.getsid(process.pid) == session:
                process.kill()


def _command_line(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []
