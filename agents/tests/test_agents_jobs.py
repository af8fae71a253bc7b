"""The runner of many jobs, here and on Ray: kills, interruptions and resumption of searches and experiments."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import psutil
import pytest
from agents_helpers import EXPERIMENT, progress, same
from rich.console import Console

from endless_gym_agents.paper import jobs, jobs_ray, search
from endless_gym_agents.paper.experiments import definitions, planning
from endless_gym_agents.paper.search_study import Trials
from endless_gym_agents.settings import Settings
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.train import train

#: Where jobs run, as flags.
WHERE = pytest.mark.parametrize("where", [(), ("--ray",)], ids=["here", "ray"])
#: Starts a program of the package.
Program = Callable[..., contextlib.AbstractContextManager["subprocess.Popen[bytes]"]]
#: A small run with a checkpoint after each update.
SMALL = "--preset quick --env MortarMayhem-Grid-v0 --agent gru --environment.num-envs 4 --ppo.steps 16"
SMALL += " --ppo.minibatches 1 --checkpoint-interval 1 --recurrence.hidden-size 16 --seed 1 --threads 1"
SMALL += " --environment.num-threads 1"
SEARCH = [*SMALL.split(), "--parameters", "ppo.epochs", "--stage", "single", "--period", "1", "--pruner", "none"]
#: A trainer that is killed after the end of its engine, while it holds an observation in shared memory.
KILLED = """
import os, signal, endless_gym
envs = endless_gym.serve("MortarMayhem-Grid-v0", num_envs=1)
observation, _ = envs.reset()
envs.close()
os.kill(os.getpid(), signal.SIGKILL)
"""


@dataclass(frozen=True)
class Training:
    """A job that trains a small agent until it is stopped."""

    folder: Path
    title: str = "training"

    def commands(self, machine: jobs.Machine) -> list[list[str]]:
        return [["endless-train", *SMALL.split(), "--run", str(self.folder), "--ppo.updates", "100000"]]

    def has_succeeded(self) -> bool:
        return True

    def progress(self) -> str:
        return ""


def runner(folder: Path, said: list[str], machine: jobs.Machine, retries: int = 0) -> jobs.Runner:
    return jobs.Runner(machine, folder / jobs.LIST, said.append, lambda: "", retries=retries)


@pytest.fixture
def program(
    tmp_path: Path, where: Sequence[str], request: pytest.FixtureRequest, segments: Callable[[], set[str]]
) -> Program:
    """Starts a program of the package in the folder, with its output in the file `output`.

    At the end of its block no process and no shared memory of it may be left; the path of Ray's interpreter has a space.
    """
    ray_folder, python = "", Path(sys.executable)
    if where:
        pytest.importorskip("ray")
        ray_folder = request.getfixturevalue("ray_folder")
        (tmp_path / "with a space").symlink_to(python.parents[2])
        python = tmp_path / "with a space" / python.relative_to(python.parents[2])

    def left() -> list[psutil.Process]:
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error):
                if process.cwd() == str(tmp_path) or (ray_folder and ray_folder in " ".join(process.cmdline())):
                    found.append(process)
        return found

    @contextlib.contextmanager
    def started(name: str, *given: str) -> Iterator["subprocess.Popen[bytes]"]:
        with (tmp_path / "output").open("w") as output:
            process = subprocess.Popen(
                [python, "-m", f"endless_gym_agents.paper.{name}", *given, *where],
                cwd=tmp_path,
                env=os.environ | {"CUDA_VISIBLE_DEVICES": ""},
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        try:
            yield process
            # The engines end on their own after their trainers.
            assert not psutil.wait_procs(left(), timeout=60)[1]
            assert not segments()
        finally:
            for one in left():
                with contextlib.suppress(psutil.Error):
                    one.kill()
            process.kill()
            process.wait()

    return started


def wait_for_updates(process: "subprocess.Popen[bytes]", count: int, *runs: Path) -> None:
    """Wait until each run has completed so many updates."""
    while not all(len(read_progress(run)) >= count for run in runs):
        assert process.poll() is None, process.returncode
        time.sleep(0.01)


def trainer(run: Path) -> psutil.Process:
    """The process that trains in a folder, which its lock names."""
    (number,) = re.findall(r"process (\d+)", (run / "lock").read_text())
    return psutil.Process(int(number))


def values(folder: Path) -> dict[int, tuple[str, float | None, dict[int, float]]]:
    """State, final and intermediate rewards of the trials of a search, by their number of epochs."""
    study = Trials(search.parse([*SEARCH, "--ppo.updates", "20", "--folder", str(folder)]), Console(quiet=True)).study
    return {
        trial.params["ppo.epochs"]: (trial.state.name, trial.value, trial.intermediate_values) for trial in study.trials
    }


@WHERE
def test_workers_of_a_search_resume_only_the_trial_of_a_killed_one(
    where: Sequence[str], tmp_path: Path, program: Program
) -> None:
    """All trials end as in a search in one process."""
    given = [*SEARCH, "--ppo.updates", "20"]
    search.run_trials(Trials(search.parse([*given, "--folder", str(tmp_path / "through")]), Console(quiet=True)))
    runs = [tmp_path / "shared" / f"trial-000{number}" for number in range(3)]
    with program("search", *given, "--folder", "shared", "--workers", "2") as process:
        # The other worker may start when this trial has ended.
        wait_for_updates(process, 3, runs[0])
        killed = trainer(runs[0])
        killed.suspend()
        before = (runs[0] / "progress.jsonl").read_text().splitlines()
        killed.kill()
        assert process.wait(280) == 0, (tmp_path / "output").read_text()
    assert len(before) < 20, "the trial ended before it was killed"
    assert values(tmp_path / "shared") == values(tmp_path / "through")
    assert {state for state, _, _ in values(tmp_path / "shared").values()} == {"COMPLETE"}
    # The rows up to the last checkpoint are those of the killed process, with its times.
    for run in runs:
        assert [row["update"] for row in read_progress(run)] == list(range(1, 21))
    rows = (runs[0] / "progress.jsonl").read_text().splitlines()
    assert rows[: len(before) - 1] == before[:-1]
    listed = jobs.listed(tmp_path / "shared" / jobs.LIST)
    assert [job["state"] for job in listed.values()] == ["done", "done"]
    assert [len(re.findall("^\\$ ", Path(job["log"]).read_text(), re.MULTILINE)) for job in listed.values()].count(
        2
    ) == 1
    assert [file.name for file in (tmp_path / "shared" / "locks").iterdir()] == ["study"]


@WHERE
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_stop_with_their_search(
    number: signal.Signals, where: Sequence[str], tmp_path: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in a terminal signals all processes of the group. Even if the search is killed, its workers stop."""
    flags = f"--ppo.updates 100000 --environment.engine process --folder {tmp_path / 'search'}"
    given = [*SEARCH, *flags.split()]
    runs = [tmp_path / "search" / f"trial-000{number}" for number in (0, 1)]
    with program("search", *given, "--workers", "2") as process:
        wait_for_updates(process, 2, *runs)
        os.killpg(process.pid, number)
        assert process.wait(60) == (130 if number == signal.SIGINT else -number), (tmp_path / "output").read_text()
    if number == signal.SIGINT or not where:  # Ray kills what runs in a cluster that ends.
        for run in runs:
            assert checkpoint.load(run).update == read_progress(run)[-1]["update"]
    if number == signal.SIGINT:
        assert "endless-search: stopped" in (tmp_path / "output").read_text()
        listed = jobs.listed(tmp_path / "search" / jobs.LIST)
        assert [job["state"] for job in listed.values()] == ["stopped", "stopped"]

    # In this process, for one more update.
    def one_more(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        return train(given, lambda update, means: watch(update, means) or True)

    monkeypatch.setattr(search, "train", one_more)
    before = [checkpoint.load(run).update for run in runs]
    trials = Trials(search.parse(given), Console(quiet=True))
    assert trials.remaining() == (0, 3)
    for _ in range(2):  # the third trial first, since it was not interrupted
        with pytest.raises(KeyboardInterrupt):
            search.run_trials(trials)
    assert trials.remaining() == (0, 3)
    first, done = runs[0], before[0]
    trial = trials.begin()
    assert trial is not None
    assert trial.settings.run == str(first)
    assert checkpoint.load(first).update == done + 1
    assert [row["update"] for row in read_progress(first)] == list(range(1, done + 2))


@WHERE
def test_stopped_runs_of_an_experiment_equal_uninterrupted_ones(
    where: Sequence[str], tmp_path: Path, program: Program
) -> None:
    """A run that was killed, and then stopped by Ctrl-C, is completed; repeating the command then runs nothing."""
    (own,) = EXPERIMENT["runs"]
    flags = own["flags"] | {"environment.engine": "process"}
    (tmp_path / "mine.json").write_text(json.dumps(EXPERIMENT | {"runs": [own | {"flags": flags}]}))

    def reproduced(out: str, update: int = 0, number: int = 0) -> str:
        run = tmp_path / out / "runs" / "MortarMayhem-Grid-v0" / "gru" / "seed-1"
        given = ["mine.json", "--out", out, "--device", "cpu", "--nice", "0", "--jobs", "1"]
        with program("reproduce", *given) as process:
            if update:
                wait_for_updates(process, update, run)
            if number == signal.SIGKILL:
                trainer(run).kill()
            elif number:
                os.killpg(process.pid, number)
            assert process.wait(250) == {0: 0, signal.SIGKILL: 1, signal.SIGINT: 130}[number], (
                tmp_path / "output"
            ).read_text()
        return (tmp_path / "output").read_text()

    assert "failed with status -9" in reproduced("stopped", 2, signal.SIGKILL)
    run, through = (
        tmp_path / out / "runs" / "MortarMayhem-Grid-v0" / "gru" / "seed-1" for out in ("stopped", "through")
    )
    text = reproduced("stopped", 4, signal.SIGINT)
    done = checkpoint.load(run).update
    assert 4 <= done < 6
    assert f"stopped at update {done} of 6" in text
    assert f"resumed at update {done} of 6" in reproduced("stopped")
    reproduced("through")
    assert len(progress(run)) == 6
    assert progress(run) == progress(through)
    assert same(*(checkpoint.load(each).state["model"] for each in (run, through)))
    tables = [tmp_path / out / "mine" / "table.csv" for out in ("stopped", "through")]
    assert tables[0].read_text() == tables[1].read_text()
    assert "1 of 1 runs are done" in (tmp_path / "stopped" / "mine" / "README.md").read_text()
    before = os.stat(run / "progress.jsonl").st_mtime_ns
    again = reproduced("stopped")
    assert "1 of 1 jobs done" in again
    assert not re.search("started|resumed|Ray instance", again)
    assert os.stat(run / "progress.jsonl").st_mtime_ns == before
    # What was removed is done again.
    (job,) = planning.jobs_of(definitions.load(str(tmp_path / "mine.json")), tmp_path / "stopped", 1)
    assert job.state() == "done"
    (run / "evaluation.json").unlink()
    assert [line[0] for line in job.commands(jobs.Machine(1))] == ["endless-eval"]
    shutil.rmtree(run)
    assert job.state() == "not started"


def test_the_end_of_ray_removes_shared_memory_of_killed_trainers(
    tmp_path: Path, ray_folder: str, segments: Callable[[], set[str]]
) -> None:
    pytest.importorskip("ray")
    with jobs_ray.connected("local") as machine:
        assert machine.jobs >= 1
        assert subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path).returncode == -signal.SIGKILL
        assert segments()
    assert not segments()


def test_a_signal_while_a_job_starts_stops_it(tmp_path: Path) -> None:
    class Interrupting(jobs.Machine):
        def start(self, command: Sequence[str], slot: int, lock: IO[str], log: IO[str]) -> jobs.Process:
            process = super().start(command, slot, lock, log)
            os.kill(os.getpid(), signal.SIGINT)
            return process

    said: list[str] = []
    some = [Training(tmp_path / name, title=name) for name in ("a", "b")]
    made = runner(tmp_path, said, Interrupting(2))
    made.run(some)
    assert made.stopped
    assert [job["state"] for job in jobs.listed(tmp_path / jobs.LIST).values()] == ["stopped", "waiting"]
    assert said == ["a: started", "stopping 0 jobs with checkpoints; press Ctrl-C again to stop at once", "a: stopped"]


def test_a_job_that_fails_is_started_again_a_number_of_times(tmp_path: Path) -> None:
    class Failing(jobs.Machine):
        def start(self, command: Sequence[str], slot: int, lock: IO[str], log: IO[str]) -> jobs.Process:
            return subprocess.Popen(["false"])

    said: list[str] = []
    job = Training(tmp_path / "a")
    made = runner(tmp_path, said, Failing(1), retries=2)
    made.run([job])
    assert made.failed == [job]
    failed, log = "training: failed with status 1", f"; the log is {tmp_path / 'a'}.log"
    assert said == ["training: started", *2 * [f"{failed}, started again{log}"], f"{failed}{log}"]
    assert (tmp_path / "a.log").read_text().count("$ endless-train") == 3


def test_a_job_of_another_process_is_left_alone(tmp_path: Path) -> None:
    said: list[str] = []
    lock = jobs.try_lock(tmp_path / "a.lock")
    assert lock is not None
    runner(tmp_path, said, jobs.Machine(1)).run([Training(tmp_path / "a")])
    assert said == ["training: another process is running it"]
    lock.close()
    assert not jobs.is_locked(tmp_path / "a.lock")


def test_each_job_gets_a_gpu() -> None:
    machine = jobs.Machine(4, ("0", "3"))
    assert [machine.environment(slot)["CUDA_VISIBLE_DEVICES"] for slot in range(4)] == ["0", "3", "0", "3"]
    assert jobs.Machine(2).environment(0) == {"OMP_NUM_THREADS": "1"}
