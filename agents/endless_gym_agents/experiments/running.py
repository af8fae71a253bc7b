"""Runs the commands of jobs in parallel, each in a separate process, and stops them so that they can be resumed."""

from __future__ import annotations

import fcntl
import os
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import IO, Protocol

import torch

from endless_gym import _native
from endless_gym_agents import atomic, checkpoint
from endless_gym_agents.clock import duration
from endless_gym_agents.command import on_stop_signals
from endless_gym_agents.experiments import planning
from endless_gym_agents.experiments.planning import Job

#: The measurement of an environment's speed.
_SPEED = "endless-speed"
#: Module of each program of the package.
_MODULES = {
    "endless-train": "endless_gym_agents.train",
    "endless-eval": "endless_gym_agents.protocol",
    "endless-search": "endless_gym_agents.search",
    _SPEED: "endless_gym_agents.experiments.stepping",
}
#: Seconds between polls of the processes, and between estimates of the remaining time.
_POLL, _REPORT = 0.1, 60.0


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
    nice: int = 19
    job_cores: int = 0

    @property
    def engine_threads(self) -> int:
        """Threads per job that step the environments."""
        return self.job_cores or max(1, _native.cores() // self.jobs)

    def environment(self, slot: int) -> dict[str, str]:
        """Additional environment variables for the job in a slot."""
        added = {"OMP_NUM_THREADS": "1"}
        return added | {"CUDA_VISIBLE_DEVICES": self.gpus[slot % len(self.gpus)]} if self.gpus else added


def machine(jobs: int, device: str, nice: int = 19) -> Machine:
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


class Process(Protocol):
    """The process of a job, here or on another machine."""

    def poll(self) -> int | None:
        """The exit status; None before the process has ended."""

    def send_signal(self, sig: int, /) -> None:
        """Send a signal, unless the process has ended."""


@dataclass
class _Active:
    """A job that is running in a slot."""

    job: Job
    slot: int
    lock: IO[str]
    commands: list[list[str]]
    log: IO[str]
    process: Process
    begun: float = field(default_factory=time.monotonic)


class Runner:
    """Runs jobs; Ctrl-C, SIGTERM and SIGHUP stop the running ones after their update, with checkpoints.

    Attributes:
        failed: Jobs whose command failed.
        stopped: Whether the work was interrupted.
    """

    def __init__(self, machine: Machine, say: Callable[[str], None], keep_checkpoints: bool = False) -> None:
        """Make a runner.

        Args:
            machine: What the jobs run on.
            say: Called with each line of progress.
            keep_checkpoints: Keep all checkpoints of evaluated runs, not only the last.
        """
        self.machine, self.say, self.keep_checkpoints = machine, say, keep_checkpoints
        self._active: list[_Active] = []
        self.failed: list[Job] = []
        self.stopped = False

    def run(self, planned: Sequence[Job]) -> None:
        """Run the jobs that are not done."""
        waiting = [job for job in planned if job.state() != "done"]
        said = time.monotonic()
        with on_stop_signals(self._stop):
            try:
                while self._active or (waiting and not self.stopped):
                    taken = {active.slot for active in self._active}
                    for slot in sorted(set(range(self.machine.jobs)) - taken):
                        while waiting and not self.stopped and not self._start(waiting.pop(0), slot):
                            pass
                    time.sleep(_POLL)
                    for active in list(self._active):
                        self._look(active)
                    if time.monotonic() - said > _REPORT:
                        said = time.monotonic()
                        self.say(left(planned, self.machine.jobs))
            finally:
                for active in self._active:
                    active.process.send_signal(signal.SIGKILL)

    def _start(self, job: Job, slot: int) -> bool:
        """Start the first command of a job; false if another process is running or has completed it."""
        job.folder.parent.mkdir(parents=True, exist_ok=True)
        # The job's process inherits the open file, so the lock holds while either process lives.
        lock = Path(f"{job.folder}.lock").open("w")  # noqa: SIM115
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            self.say(f"{job.title}: another process is running it")
            return False
        resumed = job.state() == "interrupted"
        if not resumed and job.updates and (job.folder / checkpoint.SETTINGS).exists():
            shutil.rmtree(job.folder)  # The run was killed before its first checkpoint.
        job.folder.mkdir(exist_ok=True)
        commands = planning.commands(job, self.machine.device, self.machine.engine_threads)
        if not commands:  # Another process has completed it since.
            lock.close()
            return False
        done = job.updates_done()
        self.say(f"{job.title}: " + (f"resumed at update {done} of {job.updates}" if resumed else "started"))
        log = Path(f"{job.folder}.log").open("a")  # noqa: SIM115
        process = self._spawn(commands[0], slot, lock, log)
        self._active.append(_Active(job, slot, lock, commands[1:], log, process))
        return True

    def _spawn(self, command: list[str], slot: int, lock: IO[str], log: IO[str]) -> Process:
        print(f"$ {shlex.join(command)}", file=log, flush=True)
        return self._begin(command, slot, lock, log)

    def _begin(self, command: list[str], slot: int, lock: IO[str], log: IO[str]) -> Process:
        """Start a command as a process."""
        return popen(command, self.machine.nice, self.machine.environment(slot), log, (lock.fileno(),))

    def _look(self, active: _Active) -> None:
        """If a job's process has ended, start its next command or finish the job."""
        status = active.process.poll()
        if status is None:
            return
        if status == 0 and active.commands and not self.stopped:
            active.process = self._spawn(active.commands.pop(0), active.slot, active.lock, active.log)
            return
        self._active.remove(active)
        job, minutes = active.job, (time.monotonic() - active.begun) / 60
        if status == 0 and job.experiment.kind == "search":
            atomic.write(job.folder / planning.FINISHED, "{}\n")
        if job.state() == "done":
            if job.experiment.kind == "curves" and not self.keep_checkpoints:
                for file in (job.folder / checkpoint.FOLDER).glob("update-*.pt"):
                    file.unlink()
            self.say(f"{job.title}: done after {minutes:.1f} minutes")
        elif self.stopped:
            self.say(
                f"{job.title}: stopped" + (f" at update {job.updates_done()} of {job.updates}" if job.updates else "")
            )
        else:
            self.failed.append(job)
            self.say(f"{job.title}: failed with status {status}; the log is {job.folder}.log")
        active.log.close()
        active.lock.close()

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.stopped and number != signal.SIGINT:
            return  # Only another Ctrl-C stops the jobs at once.
        again = ", now without waiting for the end of an update" if self.stopped else ""
        self.stopped = True
        self.say(f"stopping {len(self._active)} jobs with checkpoints{again or '; press Ctrl-C again to stop at once'}")
        for active in self._active:
            active.process.send_signal(signal.SIGINT)


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
    lowered = ["nice", "-n", str(nice)] if shutil.which("nice") else []
    return subprocess.Popen(
        [*lowered, sys.executable, "-m", _MODULES[command[0]], *command[1:]],
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=subprocess.STDOUT,
        env={**os.environ, **environment},
        pass_fds=inherited,
        # Ctrl-C in the terminal reaches only this process, which forwards it.
        start_new_session=True,
    )


def left(planned: Sequence[Job], side_by_side: int) -> str:
    """One line with the progress of the jobs and the estimated remaining time."""
    states = [job.state() for job in planned]
    trained, total = sum(min(job.updates_done(), job.updates) for job in planned), sum(job.updates for job in planned)
    text = f"{states.count('done')} of {len(planned)} jobs done, {states.count('interrupted')} begun"
    if total:
        text += f", {trained:,} of {total:,} updates"
        seconds = planning.remaining_seconds(planned, side_by_side)
        evaluated = [planning.evaluation_seconds(job) is not None for job in planned if job.experiment.kind == "curves"]
        if trained < total and seconds is None:
            text += "; time unknown before the first update"
        elif seconds:
            text += f"; the rest takes {duration(seconds)}" + (
                ", and its evaluation" if evaluated and not any(evaluated) else ""
            )
    return text
