"""Runs the jobs of `jobs` on Ray, on this machine or on a cluster: each command is an actor that starts it as a process on a
machine of the cluster, and signals it.

Progress, locks and the order of the jobs stay in the process of the runner, so jobs can be continued with or without Ray.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from endless_gym import running_engines
from endless_gym_agents.paper import jobs

#: Size of a local Ray's object store in bytes; small, since jobs share only a few numbers.
_STORE = 100_000_000


def with_address(arguments: Sequence[str]) -> list[str]:
    """Command-line arguments in which `--ray` has an address: `local` if none was given."""
    given = list(arguments)
    if "--ray" in given:
        after = given.index("--ray") + 1
        if after == len(given) or given[after].startswith("-"):
            given.insert(after, "local")
    return given


@dataclass(frozen=True)
class Cluster(jobs.Machine):
    """The machines of a connected Ray, as `Machine`.

    Attributes:
        job_gpus: GPUs that Ray reserves for each job, beside `job_cores` CPU cores.
    """

    job_gpus: float = 0.0

    def start(self, command: Sequence[str], slot: int, lock: IO[str], log: IO[str]) -> jobs.Process:
        """Start a command as soon as Ray has the resources. Only this process holds the lock."""
        return _RayProcess(command, self, Path(log.name))


@contextmanager
def connected(
    address: str, side_by_side: int = 0, device: str = "auto", nice: int = 0, cores: int = 1, gpus: float | None = None
) -> Iterator[Cluster]:
    """Connect this process to Ray for the `with` block. A local Ray ends with the block.

    Args:
        address: `local` to start Ray on this machine, or the address of a cluster.
        side_by_side: Number of jobs that run at the same time; 0 for as many as the resources permit.
        device: Device of the agents.
        nice: Added to the niceness of the processes.
        cores: CPU cores of a job.
        gpus: GPUs of a job; None for 1 if Ray has any and the device is not `cpu`, else 0.

    Raises:
        ValueError: There is no such cluster.
    """
    import ray

    given: dict[str, Any] = {"address": address, "log_to_driver": False}
    if address == "local":
        given |= {"include_dashboard": False, "object_store_memory": _STORE}
        if (quoted := shlex.quote(sys.executable)) != sys.executable:
            # Ray starts its processes through a shell and does not quote the interpreter's path.
            given["runtime_env"] = {"py_executable": quoted}
    try:
        ray.init(**given)
    except ConnectionError as error:
        raise ValueError(f"--ray must be the address of a Ray cluster, got `{address}`: {error}") from None
    try:
        there = ray.cluster_resources()
        if gpus is None:
            gpus = 1.0 if device != "cpu" and there.get("GPU") else 0.0
        fitting = there.get("CPU", 0.0) // cores
        if gpus:
            fitting = min(fitting, there.get("GPU", 0.0) // gpus)
        yield Cluster(side_by_side or max(1, int(fitting)), (), device, nice, cores, gpus)
    finally:
        ray.shutdown()
        # Ray kills trainers that take long to stop. Listing the engines removes the shared memory of dead processes.
        running_engines()


class _RayProcess:
    """A process that an actor starts as soon as Ray has the resources."""

    def __init__(self, command: Sequence[str], machine: Cluster, log: Path) -> None:
        import ray

        # One call waits for the end of the process, another sends signals.
        resources: dict[str, Any] = {"num_cpus": machine.job_cores, "num_gpus": machine.job_gpus, "max_concurrency": 2}
        host: Any = ray.remote(**resources)(_Host)
        self._host: Any = host.remote()
        self._ready: Any = self._host.ready.remote()
        self._end: Any = self._host.run.remote(
            list(command), machine.nice, machine.environment(0), str(log.resolve()), os.getcwd()
        )
        self._status: int | None = None

    def poll(self) -> int | None:
        import ray

        if self._status is None and _is_there(self._end):
            try:
                self._status = int(ray.get(self._end))
            except ray.exceptions.RayError:  # The machine or the actor died.
                self._status = -signal.SIGKILL
            ray.kill(self._host)  # releases its resources
        return self._status

    def send_signal(self, sig: int, /) -> None:
        import ray

        if self._status is not None:
            return
        if _is_there(self._ready):
            self._host.send_signal.remote(int(sig))
        else:  # Still waiting for resources.
            ray.kill(self._host)
            self._status = -sig


def _is_there(reference: Any) -> bool:
    import ray

    return bool(ray.wait([reference], timeout=0)[0])


class _Host:
    """The actor of a job, and the parent of its process, which ends with the actor."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def ready(self) -> None:
        """Return as soon as the actor runs."""

    def run(self, command: Sequence[str], nice: int, environment: dict[str, str], log: str, folder: str) -> int:
        """Run a command in a folder, if this machine has it, to its end, and return its exit status."""
        if os.path.isdir(folder):
            os.chdir(folder)
        with open(log, "a") as output:
            # Ray blocks SIGINT in its processes, and a child inherits the mask of the thread that starts it.
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            self._process = jobs.popen(command, nice, environment, output)
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            return self._process.wait()

    def send_signal(self, number: int) -> None:
        """Send a signal to the command as soon as it has started, unless it has ended."""
        while self._process is None:
            time.sleep(0.01)
        self._process.send_signal(number)
