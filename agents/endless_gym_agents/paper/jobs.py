"""Runs many jobs, some at the same time, and stops them so that they can be resumed.

A job is a sequence of this package's programs, each a process on this machine or, with `jobs_ray`, on a Ray cluster. A file
lists all jobs with their state, so that a later call can resume what was interrupted and skip what is done.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, Any, Protocol

import torch

from endless_gym import _native
from endless_gym_agents.common import atomic, regular
from endless_gym_agents.common.command import on_stop_signals

#: Name of the file with the jobs and their state, in the folder of an experiment or a search.
LIST = "jobs.json"
#: The measurement of an environment's speed.
_SPEED = "endless-speed"
#: Module of each program of the package.
_MODULES = {
    "endless-train": "endless_gym_agents.training.train",
    "endless-eval": "endless_gym_agents.evaluation.protocol",
    "endless-search": "endless_gym_agents.paper.search",
    _SPEED: "endless_gym_agents.paper.experiments.stepping",
}
#: Environment variable with the id of the process that started a command.
_PARENT = "ENDLESS_GYM_PARENT"
#: Seconds between polls of the processes, and between lines of progress.
_POLL, _REPORT = 0.1, 60.0


class Process(Protocol):
    """The process of a job, here or on another machine."""

    def poll(self) -> int | None:
        """The exit status; None before the process has ended."""

    def send_signal(self, sig: int, /) -> None:
        """Send a signal, unless the process has ended."""


@dataclass(frozen=True)
class Machine:
    """The resources that jobs run on.

    Attributes:
        jobs: Number of jobs that run at the same time.
        gpus: Visible GPUs, as in `CUDA_VISIBLE_DEVICES`; empty for the CPU.
        device: Device of the agents, as for `endless-train`.
        nice: Added to the niceness of the processes, 0 to 19.
        job_cores: Cores of each job; 0 for its share of the cores of this machine.
    """

    jobs: int
    gpus: tuple[str, ...] = ()
    device: str = "auto"
    nice: int = 0
    job_cores: int = 0

    @property
    def engine_threads(self) -> int:
        """Threads per job that step the environments."""
        return self.job_cores or max(1, _native.cores() // self.jobs)

    def environment(self, slot: int) -> dict[str, str]:
        """Additional environment variables for the job in a slot."""
        added = {"OMP_NUM_THREADS": "1"}
        return added | {"CUDA_VISIBLE_DEVICES": self.gpus[slot % len(self.gpus)]} if self.gpus else added

    def start(self, command: Sequence[str], slot: int, lock: IO[str], log: IO[str]) -> Process:
        """Start a command as a process with its output in the log, which holds the lock as long as it lives."""
        return popen(command, self.nice, self.environment(slot), log, (lock.fileno(),))


class Job(Protocol):
    """A sequence of commands. Their output is in `FOLDER.log`, and `FOLDER.lock` is locked while they run."""

    @property
    def title(self) -> str:
        """Name of the job in the list."""

    @property
    def folder(self) -> Path:
        """Folder that the job writes."""

    def commands(self, machine: Machine) -> list[list[str]]:
        """The commands that are left, each a program of this package and its arguments."""

    def has_succeeded(self) -> bool:
        """Whether a command that has ended with status 0 has done all of its work."""
        return True

    def progress(self) -> str:
        """How far the job is, such as `at update 3 of 10`; empty if that is unknown, or nothing is done."""
        return ""


def machine(jobs: int, device: str, nice: int = 0) -> Machine:
    """The local machine with a number of jobs at the same time; 0 for one per GPU, or without GPUs one per core."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    count = torch.cuda.device_count() if device in ("auto", "cuda") else 0
    gpus = tuple(given.split(",")[:count]) if given else tuple(map(str, range(count)))
    return Machine(jobs or len(gpus) or _native.cores(), gpus, device, nice)


def shown(command: Sequence[str], machine: Machine, slot: int = 0) -> str:
    """A command line for a shell, with its environment variables."""
    variables = " ".join(f"{name}={value}" for name, value in machine.environment(slot).items())
    if command[0] == _SPEED:  # Not an installed program.
        command = ["python", "-m", _MODULES[_SPEED], *command[1:]]
    return f"{variables} nice -n {machine.nice} {shlex.join(command)}"


def popen(
    command: Sequence[str], nice: int, environment: Mapping[str, str], log: IO[str], inherited: Sequence[int] = ()
) -> subprocess.Popen[bytes]:
    """Start a command of the package as a process of this machine.

    Args:
        command: A program of the package and its arguments.
        nice: Added to the niceness, 0 to 19.
        environment: Additional environment variables.
        log: Where its output goes.
        inherited: File descriptors that it inherits.
    """
    lowered = ["nice", "-n", str(nice)] if nice and shutil.which("nice") else []
    return subprocess.Popen(
        [*lowered, sys.executable, "-m", _MODULES[command[0]], *command[1:]],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, **environment, _PARENT: str(os.getpid())},
        pass_fds=inherited,
        # Ctrl-C in the terminal reaches only this process, which forwards it.
        start_new_session=True,
    )


def is_orphan() -> bool:
    """Whether this process was started by `popen`, and the process that called it has ended."""
    return os.environ.get(_PARENT, str(os.getppid())) != str(os.getppid())


def try_lock(file: Path) -> IO[str] | None:
    """A locked file, created if necessary; None if another process has locked it.

    The operating system releases the lock when the process and those that inherit the open file have closed it or ended.
    """
    opened = file.open("w")
    try:
        fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        opened.close()
        return None
    return opened


def is_locked(file: Path) -> bool:
    """Whether a process has locked a file, which is created if necessary."""
    if (lock := try_lock(file)) is not None:
        lock.close()
    return lock is None


@contextlib.contextmanager
def locked(file: Path) -> Iterator[None]:
    """Hold the lock of a file, created if necessary; waits until no other process holds it."""
    with file.open("w") as opened:
        fcntl.flock(opened, fcntl.LOCK_EX)
        yield


def listed(file: Path) -> dict[str, dict[str, Any]]:
    """The jobs of a list by title: `state`, which is waiting, running, done, stopped or failed; `left`, the number of commands
    that are not done; and `log`.
    """
    return dict(json.loads(regular.text(file))) if file.exists() else {}


def _list(file: Path, entries: Mapping[str, dict[str, Any]]) -> None:
    """Change entries of a list that other processes may change at the same time."""
    with locked(file.with_suffix(".lock")):
        known = listed(file)
        for title, entry in entries.items():
            known[title] = known.get(title, {}) | entry
        atomic.write(file, json.dumps(known, indent=1) + "\n")


@dataclass
class _Active:
    """A job that is running in a slot, with the commands that follow; `signals` counts those sent to its process."""

    job: Job
    slot: int
    lock: IO[str]
    log: IO[str]
    commands: list[list[str]]
    process: Process
    begun: float = field(default_factory=time.monotonic)
    signals: int = 0


class Runner:
    """Runs jobs; Ctrl-C, SIGTERM and SIGHUP stop the running ones after their update, with checkpoints.

    Attributes:
        failed: Jobs whose last command failed.
    """

    def __init__(
        self,
        machine: Machine,
        file: Path,
        say: Callable[[str], None],
        progress: Callable[[], str],
        ended: Callable[[Any], None] = lambda job: None,
        retries: int = 0,
    ) -> None:
        """Make a runner.

        Args:
            machine: What the jobs run on.
            file: The list of the jobs and their state. It may have other jobs, too.
            say: Called with each line of progress.
            progress: Returns a line with the progress of all jobs.
            ended: Called with each job that is done.
            retries: How often jobs that fail, or are killed, begin again, all together.
        """
        self.machine, self.file, self.say, self.progress, self.ended = machine, file, say, progress, ended
        self.retries = retries
        self.failed: list[Job] = []
        self._waiting: deque[Job] = deque()
        self._active: list[_Active] = []
        self._signals = 0

    @property
    def stopped(self) -> bool:
        """Whether a signal has stopped the jobs."""
        return self._signals > 0

    def run(self, planned: Sequence[Job]) -> None:
        """Run the jobs, in this order."""
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self._waiting.extend(planned)
        _list(self.file, {job.title: {"state": "waiting", "log": f"{job.folder.resolve()}.log"} for job in planned})
        said = time.monotonic()
        with on_stop_signals(self._count):
            try:
                while self._active or (self._waiting and not self.stopped):
                    taken = {active.slot for active in self._active}
                    for slot in sorted(set(range(self.machine.jobs)) - taken):
                        while self._waiting and not self.stopped and not self._start(self._waiting.popleft(), slot):
                            pass
                    time.sleep(_POLL)
                    for active in list(self._active):
                        if active.signals < self._signals:  # also one that started while the signal came
                            active.signals += 1
                            active.process.send_signal(signal.SIGINT)
                        self._look(active)
                    if time.monotonic() - said > _REPORT:
                        said = time.monotonic()
                        self.say(self.progress())
            finally:
                for active in self._active:
                    active.process.send_signal(signal.SIGKILL)

    def _start(self, job: Job, slot: int) -> bool:
        """Start the first command of a job; false if another process is running or has completed it."""
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        lock = try_lock(Path(f"{job.folder}.lock"))
        if lock is None:
            self.say(f"{job.title}: another process is running it")
            return False
        commands = job.commands(self.machine)
        if not commands:
            lock.close()
            return False
        progress = job.progress()
        self.say(f"{job.title}: {f'resumed {progress}' if progress else 'started'}")
        log = Path(f"{job.folder}.log").open("a")  # noqa: SIM115
        process = self._spawn(commands[0], slot, lock, log)
        self._active.append(_Active(job, slot, lock, log, commands[1:], process))
        _list(self.file, {job.title: {"state": "running", "left": len(commands)}})
        return True

    def _spawn(self, command: list[str], slot: int, lock: IO[str], log: IO[str]) -> Process:
        print(f"$ {shlex.join(command)}", file=log, flush=True)
        return self.machine.start(command, slot, lock, log)

    def _look(self, active: _Active) -> None:
        """If a job's process has ended, start its next command, or the same again, or finish the job."""
        status, job = active.process.poll(), active.job
        if status is None:
            return
        is_done = status == 0 and job.has_succeeded()
        following = active.commands
        if not is_done and not self.stopped:
            following = job.commands(self.machine) if self.retries else []
            self.retries -= bool(following)
            again = ", started again" if following else ""
            self.say(f"{job.title}: failed with status {status}{again}; the log is {job.folder}.log")
        if following and not self.stopped:
            command, *active.commands = following
            _list(self.file, {job.title: {"left": len(following)}})
            active.process = self._spawn(command, active.slot, active.lock, active.log)
            return
        self._active.remove(active)
        left = len(active.commands) + (not is_done)
        state = "stopped" if left and self.stopped else "failed" if left else "done"
        _list(self.file, {job.title: {"state": state, "left": left}})
        if state == "done":
            self.ended(job)
            self.say(f"{job.title}: done after {(time.monotonic() - active.begun) / 60:.1f} minutes")
        elif state == "stopped":
            self.say(f"{job.title}: stopped {job.progress()}".rstrip())
        else:
            self.failed.append(job)
        active.log.close()
        active.lock.close()

    def _count(self, number: int, frame: FrameType | None) -> None:
        if self.stopped and number != signal.SIGINT:
            return  # Only another Ctrl-C stops the jobs at once.
        again = ", now without waiting for the end of an update" if self.stopped else ""
        self._signals += 1
        self.say(f"stopping {len(self._active)} jobs with checkpoints{again or '; press Ctrl-C again to stop at once'}")
