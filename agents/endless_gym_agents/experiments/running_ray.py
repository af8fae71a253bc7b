"""Runs the commands of jobs on Ray: each job is an actor that starts its process on a machine of the cluster, and signals it.

Progress, locks and the order of jobs are handled by `running`, in the process of the command, so experiments can be continued
with or without Ray.
"""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

from endless_gym_agents.experiments import running


class RayRunner(running.Runner):
    """Runs jobs on a connected Ray; Ctrl-C, SIGTERM and SIGHUP stop the running ones after their update, with checkpoints."""

    def __init__(
        self, machine: running.Machine, say: Callable[[str], None], keep_checkpoints: bool = False, gpus: float = 0.0
    ) -> None:
        """Make a runner; as `Runner`, with `machine.job_cores` CPU cores and `gpus` GPUs that Ray reserves for each job."""
        super().__init__(machine, say, keep_checkpoints)
        self._gpus = gpus

    def _begin(self, command: list[str], slot: int, lock: IO[str], log: IO[str]) -> running.Process:
        return _RayProcess(command, self.machine, self._gpus, Path(log.name))


def jobs_that_fit(job_cpus: int, gpus: float) -> int:
    """Number of jobs with these CPU cores and GPUs that the connected Ray can run at the same time, at least 1."""
    import ray

    there = ray.cluster_resources()
    fitting = there.get("CPU", 0.0) // job_cpus
    if gpus:
        fitting = min(fitting, there.get("GPU", 0.0) // gpus)
    return max(1, int(fitting))


class _RayProcess:
    """A process that an actor starts as soon as Ray has the resources."""

    def __init__(self, command: Sequence[str], machine: running.Machine, gpus: float, log: Path) -> None:
        import ray

        # One call waits for the end of the process, another sends signals.
        made = ray.remote(num_cpus=machine.job_cores, num_gpus=gpus, max_concurrency=2)(_Host)  # type: ignore[call-overload]
        self._host: Any = made.remote()
        self._ready: Any = self._host.ready.remote()
        self._end: Any = self._host.run.remote(list(command), machine.nice, machine.environment(0), str(log.resolve()))
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

    def run(self, command: Sequence[str], nice: int, environment: dict[str, str], log: str) -> int:
        """Run a command to its end, and return its exit status."""
        with open(log, "a") as output:
            # Ray blocks SIGINT in its processes, and a child inherits the mask of the thread that starts it.
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
            self._process = running.popen(command, nice, environment, output)
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            return self._process.wait()

    def send_signal(self, number: int) -> None:
        """Send a signal to the command, unless it has ended."""
        if self._process is not None:
            self._process.send_signal(number)
