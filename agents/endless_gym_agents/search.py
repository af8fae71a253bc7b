"""`endless-search`: the hyperparameter search of the paper.

The first stage tries every choice of the paper's table as a single change of the initial settings. The second stage tries
combinations proposed by a Tree-structured Parzen Estimator (TPE). After a warm-up, trials outside the best quarter of the
earlier trials are pruned. The objective is the mean reward of the last 100 training episodes.

The search can be interrupted and restarted at any time: the trials are stored in `study.db` of the search's folder, and an
interrupted trial resumes from its checkpoint. Several processes of a machine may work on one folder; `--workers` starts them.
`--ray` runs the trials on Ray Tune, on this machine or on a cluster.

```console
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --trials 50
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --workers 4
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --ray auto
```
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections.abc import Mapping
from typing import Any

import torch

from endless_gym_agents import command, ray_session, search_ray, search_workers
from endless_gym_agents.ppo import Diverged
from endless_gym_agents.search_study import SearchArguments, Trial, Trials, resumable
from endless_gym_agents.settings import PRESETS, Settings
from endless_gym_agents.train import train


def run_trial(trial: Trial, settings: Settings) -> None:
    """Train with the settings of a trial, in this process.

    Args:
        trial: The trial.
        settings: Its settings, possibly with other numbers of threads.

    Raises:
        KeyboardInterrupt: The run was interrupted, with a checkpoint of its last update.
    """
    parent = multiprocessing.parent_process()
    done = 0

    def watch(update: int, means: Mapping[str, Any]) -> bool:
        nonlocal done
        done = update
        # If the search itself was killed, its worker stops as if interrupted.
        return trial.observe(update, means.get("episode/reward")) or not (parent is None or parent.is_alive())

    try:
        settings, rows = resumable(settings)
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


def run_trials(trials: Trials, threads: int | None = None) -> None:
    """Run trials in this process, one after the other, until none is left.

    Args:
        trials: The trials.
        threads: Threads of the agent and of the environments where the settings choose none, if several processes run trials;
            the output of each trial then goes to its log. None for one process.
    """
    while (trial := trials.begin()) is not None:
        if threads is None:
            run_trial(trial, trial.settings)
        else:
            with search_workers.output_of(trial.settings):
                run_trial(trial, search_workers.with_threads(trial.settings, threads))


def execute(arguments: SearchArguments) -> None:
    """Run the search, and report the best settings so far, even if it is interrupted."""
    arguments = arguments.validated()
    if arguments.ray:
        # Tune imports pyarrow, which Ray alone does not install.
        ray_session.check_installed("pyarrow")
    trials = Trials(arguments, command.Terminal())
    done, left = trials.remaining()
    trials.say(f"{done} trials done, {left} remaining, in {trials.folder}; Ctrl-C stops the search")
    try:
        if not left:
            return
        if arguments.ray:
            search_ray.run_on_ray(trials, train)
        elif arguments.workers > 1:
            search_workers.run_workers(trials, run_trials)
        else:
            run_trials(trials)
    finally:
        trials.report()


def parse(arguments: list[str]) -> SearchArguments:
    """Parse command-line arguments; the preset determines the defaults of the training flags."""
    chosen = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--preset", default="paper")
    preset = chosen.parse_known_args(arguments)[0].preset
    default = SearchArguments(settings=PRESETS.get(preset, PRESETS["paper"]))
    given = ray_session.with_address(arguments)
    return command.parse(SearchArguments, "endless-search", __doc__, given, default=default)


def main() -> int:
    """Entry point of the command `endless-search`; returns the exit status."""
    arguments = parse(sys.argv[1:])
    return command.run("endless-search", lambda: execute(arguments))


if __name__ == "__main__":
    sys.exit(main())
