"""Several workers of a hyperparameter search on this machine, each a process that runs one trial after the other."""

from __future__ import annotations

import contextlib
import dataclasses
import multiprocessing
import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import connection
from types import FrameType
from typing import Any

from endless_gym_agents import command
from endless_gym_agents.experiments import running
from endless_gym_agents.search_study import SearchArguments, Trials
from endless_gym_agents.settings import Settings

#: Runs trials until none is left, each with a number of threads.
Work = Callable[[Trials, int | None], None]


def with_threads(settings: Settings, threads: int) -> Settings:
    """The settings with this number of threads for the agent and for the environments, where they choose none."""
    environment = settings.environment
    environment = dataclasses.replace(environment, num_threads=environment.num_threads or threads)
    return dataclasses.replace(settings, threads=settings.threads or threads, environment=environment)


@contextlib.contextmanager
def output_of(settings: Settings) -> Iterator[None]:
    """Redirect printed output and the traceback of an error to a log next to the folder of a run.

    Several runs may print at the same time, and Ray does not show the output of its processes.
    """
    with open(f"{settings.run}.log", "a") as log, contextlib.redirect_stdout(log):
        try:
            yield
        except Exception:
            traceback.print_exc(file=log)
            raise


def run_workers(trials: Trials, work: Work) -> None:
    """Run trials in several processes until none is left. A process that was killed is replaced, and its trial is resumed.

    Args:
        trials: The trials; `arguments.workers` is the number of processes.
        work: What a process does; a function that can be pickled.

    Raises:
        KeyboardInterrupt: The search was interrupted by a signal. The workers have stopped, with checkpoints.
        ValueError: A worker failed.
    """
    arguments, context = trials.arguments, multiprocessing.get_context("spawn")
    machine = running.machine(arguments.workers, arguments.settings.device)
    alive: dict[int, Any] = {}
    stopped, replaced, failed = False, 0, 0

    def start(slot: int) -> None:
        process = context.Process(
            target=_worker, args=(arguments, trials.end, machine, slot, work), name=f"endless-search-{slot}"
        )
        process.start()
        alive[slot] = process
        if stopped:  # while the process was starting, so `stop` did not signal it
            os.kill(alive[slot].pid, signal.SIGINT)

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        if stopped and number != signal.SIGINT:
            return  # Only another Ctrl-C stops the workers at once.
        stopped = True
        for process in alive.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGINT)

    trials.say(f"{arguments.workers} workers; the output of a trial is in {trials.folder}/trial-NNNN.log")
    with command.on_stop_signals(stop):
        try:
            for slot in range(min(arguments.workers, trials.remaining()[1])):
                if not stopped:
                    start(slot)
            while alive:
                connection.wait([process.sentinel for process in alive.values()])
                for slot, process in list(alive.items()):
                    if process.exitcode is None:
                        continue
                    del alive[slot]
                    status: int = process.exitcode
                    process.close()
                    in_time = time.monotonic() < trials.end
                    if status < 0 and not stopped and in_time and replaced < arguments.max_failures:
                        replaced += 1
                        trials.say(f"a worker was killed by signal {-status}; its trial is resumed")
                        start(slot)
                    elif status and not stopped:
                        failed += 1
        finally:
            for process in alive.values():
                process.kill()
    if stopped:
        raise KeyboardInterrupt
    if failed:
        raise ValueError(f"{failed} of {arguments.workers} workers failed; repeat the command to resume their trials")


def _worker(arguments: SearchArguments, end: float, machine: running.Machine, slot: int, work: Work) -> None:
    """The main function of a worker; `end` is `Trials.end` of the search, on a clock that all processes of a machine share."""
    # Ctrl-C in the terminal reaches only the search, which forwards it.
    os.setsid()
    if machine.gpus and arguments.settings.device in ("auto", "cuda"):
        os.environ["CUDA_VISIBLE_DEVICES"] = machine.gpus[slot % len(machine.gpus)]
    trials = Trials(arguments, command.Terminal(file=sys.stdout), end)
    sys.exit(command.run("endless-search", lambda: work(trials, machine.engine_threads)))
