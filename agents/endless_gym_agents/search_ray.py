"""A hyperparameter search whose trials run on Ray Tune, on this machine or on a cluster.

Tune starts the trials, and restarts them after failures. As without Ray, the study, in the process of the search, chooses the
trials and decides which are pruned. A search can therefore be continued with or without Ray.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from endless_gym_agents import ray_session
from endless_gym_agents.ppo import Diverged
from endless_gym_agents.search_study import Trial, Trials, resumable
from endless_gym_agents.search_workers import output_of, with_threads
from endless_gym_agents.settings import from_dict, to_dict

#: Trains a run, as `endless_gym_agents.train.train`.
Trainer = Callable[..., Path]

#: Name of the folder with Tune's own files, in the folder of the search.
TUNE = "tune"


def run_on_ray(trials: Trials, trainer: Trainer) -> None:
    """Run trials on Ray Tune until none is left.

    Args:
        trials: The trials; `arguments.ray` is `local` or the address of a cluster.
        trainer: Trains a run.

    Raises:
        KeyboardInterrupt: The search was interrupted. The trials resume from their last checkpoints.
        ValueError: There is no such cluster, or a trial failed too often.
    """
    arguments = trials.arguments
    # The runs write their own logs, and Tune would treat Ctrl-C as the end of the search.
    quiet = {"TUNE_DISABLE_AUTO_CALLBACK_LOGGERS": "1", "TUNE_DISABLE_SIGINT_HANDLER": "1", "RAY_AIR_NEW_OUTPUT": "0"}
    for name, value in quiet.items():
        os.environ.setdefault(name, value)
    study = _Study(trials)
    try:
        # Otherwise Ray would kill the engine together with its trainer. The engine must outlive the trainer to remove their
        # shared memory.
        with ray_session.connected(arguments.ray, spare_children=True):
            _tune(study, trainer, ray_session.gpus(arguments.trial_gpus, arguments.settings.device))
    finally:
        # Only after Ray has stopped, since another process may begin the trials from here on.
        study.interrupt()
    if study.failed:
        numbers = ", ".join(map(str, study.failed))
        raise ValueError(
            f"trials {numbers} failed more than {arguments.max_failures} times; see the logs in {trials.folder}, and repeat the "
            "command to resume them"
        )


def _tune(study: _Study, trainer: Trainer, gpus: float) -> None:
    """Run the trials of the study with Tune."""
    from ray import tune
    from ray.tune.schedulers import FIFOScheduler, TrialScheduler
    from ray.tune.search import Searcher

    class Proposals(Searcher):  # type: ignore[misc]
        """Passes the study's trials to Tune, and tells the study how they end."""

        def suggest(self, trial_id: str) -> Any:
            return study.begin(trial_id) or Searcher.FINISHED

        def on_trial_complete(self, trial_id: str, result: dict[str, Any] | None = None, error: bool = False) -> None:
            study.end(trial_id, error)

        def save(self, checkpoint_path: str) -> None:
            """Do nothing: the study is already stored."""

        def restore(self, checkpoint_path: str) -> None:
            """Do nothing: the study is already stored."""

    class Pruning(FIFOScheduler):  # type: ignore[misc]
        """Stops the trials that the study prunes."""

        def on_trial_result(self, tune_controller: Any, trial: Any, result: dict[str, Any]) -> str:
            is_pruned = study.observe(trial.trial_id, result)
            decision: str = TrialScheduler.STOP if is_pruned else TrialScheduler.CONTINUE
            return decision

    arguments = study.trials.arguments
    tuner = tune.Tuner(
        tune.with_resources(
            _trainable(trainer, arguments.period, arguments.trial_cpus), {"cpu": arguments.trial_cpus, "gpu": gpus}
        ),
        tune_config=tune.TuneConfig(
            search_alg=Proposals(), scheduler=Pruning(), num_samples=-1, max_concurrent_trials=arguments.workers or None
        ),
        run_config=tune.RunConfig(
            name=time.strftime("%Y%m%d-%H%M%S"),
            storage_path=str((study.trials.folder / TUNE).resolve()),
            failure_config=tune.FailureConfig(max_failures=arguments.max_failures),
            verbose=0,
        ),
    )
    tuner.fit()


def _trainable(trainer: Trainer, period: int, cpus: int) -> Callable[[dict[str, Any]], None]:
    """The function that a Ray process calls to train a trial; after a failure, another process calls it again."""

    def run(config: dict[str, Any]) -> None:
        from ray import tune

        given = from_dict(config["settings"])
        last, reward, done = given.ppo.updates, None, 0

        def watch(update: int, means: Mapping[str, Any]) -> bool:
            nonlocal reward, done
            done, reward = update, means.get("episode/reward", reward)
            # Each report waits until the search has read the previous one.
            if update % period == 0 and reward is not None and update < last:
                tune.report({"update": update, "reward": reward})
            return False

        with output_of(given):
            settings, rows = resumable(given)
            for row in rows:
                watch(row["update"], row)
            end = "done"
            try:
                if done < last:
                    trainer(with_threads(settings, cpus), watch)
            except torch.cuda.OutOfMemoryError:
                end = "ran out of GPU memory"
            except Diverged:
                end = "diverged"
        tune.report({"update": done, "reward": reward, "end": end})

    return run


class _Study:
    """The trials that Tune runs, by Tune's ids.

    Attributes:
        trials: The trials of the search.
        failed: Numbers of the trials that exceeded the limit of failures.
    """

    def __init__(self, trials: Trials) -> None:
        self.trials = trials
        self.failed: list[int] = []
        self._active: dict[str, Trial] = {}
        self._ended: dict[str, str] = {}

    def __getstate__(self) -> dict[str, Any]:
        # Tune pickles its arguments to restore a search from its own files; this search is restored from the study instead.
        return {}

    def begin(self, tune_id: str) -> dict[str, Any] | None:
        """The configuration of the next trial; None if none is left."""
        trial = self.trials.begin()
        if trial is None:
            return None
        self._active[tune_id] = trial
        settings = to_dict(trial.settings)
        # Ray's processes have other working directories.
        return {"settings": settings | {"run": str(Path(trial.settings.run).resolve())}}

    def observe(self, tune_id: str, result: Mapping[str, Any]) -> bool:
        """Record a result, and return whether the trial should be pruned."""
        if "end" in result:
            self._ended[tune_id] = result["end"]
        return self._active[tune_id].observe(result["update"], result["reward"])

    def end(self, tune_id: str, is_error: bool) -> None:
        """Tell the study how a trial ended."""
        trial, ended = self._active.pop(tune_id), self._ended.pop(tune_id, "")
        if is_error:
            self.failed.append(trial.number)
            trial.postpone(f"failed; its log is {trial.settings.run}.log")
        elif ended not in ("", "done"):
            trial.fail(ended)
        elif trial.pruned or ended:
            trial.complete()
        else:
            trial.interrupt()

    def interrupt(self) -> None:
        """Mark the trials that are still active as interrupted."""
        for trial in self._active.values():
            trial.interrupt()
        self._active.clear()
