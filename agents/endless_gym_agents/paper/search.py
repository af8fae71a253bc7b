"""`endless-search`: the hyperparameter search of the paper.

The first stage tries every choice of the paper's table as a single change of the initial settings. The second stage tries
combinations proposed by a Tree-structured Parzen Estimator (TPE). After a warm-up, trials outside the best quarter of the
earlier trials are pruned. The objective is the mean reward of the last 100 training episodes.

The search can be interrupted and restarted at any time: the trials are stored in `study.journal` of the search's folder, and an
interrupted trial resumes from its checkpoint. Several processes may work on one folder; `--workers` starts them, on this machine
or, with `--ray`, on a Ray cluster.

```console
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --trials 50
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --workers 4
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --ray auto
```
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from endless_gym_agents.common import command
from endless_gym_agents.paper import jobs, jobs_ray
from endless_gym_agents.paper.search_study import SearchArguments, Trial, Trials, resumable
from endless_gym_agents.settings import PRESETS
from endless_gym_agents.training.ppo import Diverged
from endless_gym_agents.training.train import train


@dataclass(frozen=True)
class Worker(jobs.Job):
    """A job of `jobs` that runs trials, one after the other.

    Attributes:
        trials: The trials.
        given: The command-line arguments of the search.
        number: Number of the worker.
    """

    trials: Trials
    given: tuple[str, ...]
    number: int

    @property
    def title(self) -> str:
        """The name of the worker."""
        return f"worker {self.number}"

    @property
    def folder(self) -> Path:
        """What the names of its log and its lock begin with."""
        return self.trials.folder / f"worker-{self.number}"

    def commands(self, machine: jobs.Machine) -> list[list[str]]:
        """The search with these arguments in one process, for the rest of the time; nothing if the time is up."""
        left, settings = self.trials.end - time.monotonic(), self.trials.arguments.settings
        if left <= 0:
            return []
        own = ["--folder", str(self.trials.folder.resolve()), "--workers", "0", "--ray", ""]
        own += ["--minutes", str(left / 60)] if left < float("inf") else []
        threads = str(machine.engine_threads)
        own += [] if settings.threads else ["--threads", threads]
        own += [] if settings.environment.num_threads else ["--environment.num-threads", threads]
        return [["endless-search", *self.given, *own]]


def run_trial(trial: Trial) -> None:
    """Train with the settings of a trial, in this process.

    Raises:
        KeyboardInterrupt: The run was interrupted, with a checkpoint of its last update.
    """
    done = 0

    def watch(update: int, means: Mapping[str, Any]) -> bool:
        nonlocal done
        done = update
        # If the search itself was killed, its worker stops as if interrupted.
        return trial.observe(update, means.get("episode/reward")) or jobs.is_orphan()

    try:
        settings, rows = resumable(trial.settings)
        for row in rows:
            watch(row["update"], row)
        if not trial.pruned:
            train(settings, watch)
        if done < settings.ppo.updates and not trial.pruned:
            raise KeyboardInterrupt
    except torch.cuda.OutOfMemoryError:
        trial.fail("ran out of GPU memory")
    except Diverged:
        trial.fail("diverged")
    except BaseException:
        trial.interrupt()
        raise
    else:
        trial.complete()


def run_trials(trials: Trials) -> None:
    """Run trials in this process, one after the other, until none is left."""
    while (trial := trials.begin()) is not None:
        run_trial(trial)


def run_workers(trials: Trials, given: list[str]) -> None:
    """Run trials in several processes until none is left. A process that was killed is replaced, and its trial is resumed.

    Args:
        trials: The trials; the arguments say how many processes, and where.
        given: The command-line arguments of the search.

    Raises:
        KeyboardInterrupt: The search was interrupted by a signal. The workers have stopped, with checkpoints.
        ValueError: A worker failed, or there is no such cluster.
    """
    arguments = trials.arguments
    resources = (arguments.settings.device, 0, arguments.trial_cpus, arguments.trial_gpus)
    here = jobs.machine(arguments.workers, arguments.settings.device)
    connection = (
        jobs_ray.connected(arguments.ray, arguments.workers, *resources) if arguments.ray else nullcontext(here)
    )

    def progress() -> str:
        done, left = trials.remaining()
        return f"{done} trials done, {left} remaining"

    with connection as machine:
        runner = jobs.Runner(machine, trials.folder / jobs.LIST, trials.say, progress, retries=arguments.max_failures)
        # Another command with workers may work on the folder.
        workers = (Worker(trials, tuple(given), number) for number in itertools.count())
        free = (worker for worker in workers if not jobs.is_locked(Path(f"{worker.folder}.lock")))
        planned = list(itertools.islice(free, min(machine.jobs, trials.remaining()[1])))
        runner.run(planned)
    if runner.stopped:
        raise KeyboardInterrupt
    if runner.failed:
        logs = ", ".join(f"{worker.folder}.log" for worker in runner.failed)
        raise ValueError(
            f"{len(runner.failed)} of {len(planned)} workers failed, see {logs}; repeat the command to resume"
        )


def execute(arguments: SearchArguments, given: list[str]) -> None:
    """Run the search, and report the best settings so far, even if it is interrupted.

    Args:
        arguments: The arguments.
        given: The command-line arguments that they were parsed from.
    """
    arguments = arguments.validated()
    if arguments.ray:
        command.check_installed("--ray", "ray", "ray")
    trials = Trials(arguments, command.Terminal())
    done, left = trials.remaining()
    trials.say(f"{done} trials done, {left} remaining, in {trials.folder}; Ctrl-C stops the search")
    try:
        if left and (arguments.ray or arguments.workers > 1):
            run_workers(trials, given)
        elif left:
            run_trials(trials)
    finally:
        trials.report()


def parse(arguments: list[str]) -> SearchArguments:
    """Parse command-line arguments; the preset determines the defaults of the training flags."""
    chosen = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--preset", default="paper")
    preset = chosen.parse_known_args(arguments)[0].preset
    default = SearchArguments(settings=PRESETS.get(preset, PRESETS["paper"]))
    given = jobs_ray.with_address(arguments)
    return command.parse(SearchArguments, "endless-search", __doc__, given, default=default)


def main() -> int:
    """Entry point of the command `endless-search`; returns the exit status."""
    arguments = parse(sys.argv[1:])
    return command.run("endless-search", lambda: execute(arguments, sys.argv[1:]))


if __name__ == "__main__":
    sys.exit(main())
