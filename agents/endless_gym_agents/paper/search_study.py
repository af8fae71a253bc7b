"""The trials of a hyperparameter search, in an Optuna study that several processes may share.

The process that runs a trial holds a lock on a file in the search's folder. The operating system releases the lock when the
process ends for any reason, so other processes can find the trials of dead processes, which are still running in the study, and
resume them from their checkpoints. The next trial is chosen under the lock of the folder.
"""

from __future__ import annotations

import fcntl
import json
import logging
import shlex
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import tyro
from rich.console import Console

from endless_gym_agents.common import atomic, command, ranges, tables
from endless_gym_agents.common.ranges import FromZero, Natural, Positive, Range
from endless_gym_agents.paper import jobs
from endless_gym_agents.paper.search_space import STUDY, Choice, Space, single_changes, space, with_choices
from endless_gym_agents.settings import Settings, to_dict
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.train import choose_device

#: Files in the folder of a search: the best settings, and the folder of the locks.
BEST, LOCKS = "best.json", "locks"
#: User attribute of the trials that are single changes.
_SINGLE = "single"


@dataclass(frozen=True)
class SearchArguments:
    """Arguments of `endless-search`; the flags of `endless-train` set the initial settings of the trials."""

    folder: str = ""
    """folder of the search, with the study and the runs of the trials; empty for searches/ENV/AGENT"""
    stage: Literal["both", "single", "combinations"] = "both"
    """single: single changes; combinations: combinations proposed by the TPE; both: first single changes, then combinations"""
    trials: Natural = 50
    """total number of combinations; the trials with single changes are additional"""
    parameters: tuple[str, ...] = ()
    """parameters to search, such as ppo.epochs; empty for all of the paper's table"""
    pruner: Literal["percentile", "asha", "none"] = "percentile"
    """when a trial is pruned. percentile: when it falls behind the complete trials, as in the paper; asha (asynchronous
    successive halving): when it is not in the best quarter of the trials that have reached the update --warm-up, 4 or 16 times
    that, and so on; none: never"""
    percentile: Annotated[float, Range(0, 100, is_open=True)] = 25.0
    """a trial is pruned if it is not among this best percentage of the trials at the same update"""
    warm_up: Natural = 2000
    """updates before a trial can be pruned"""
    startup_trials: Natural = 5
    """trials that must be complete before the pruner percentile prunes"""
    period: Positive = 50
    """updates between two pruning decisions"""
    minutes: FromZero = 0.0
    """minutes after which no more trials start and no workers are replaced; 0 for no limit"""
    workers: Natural = 0
    """trials that run at the same time, each in its own process; 0 for one, in this process. With --ray, on all machines
    together; 0 for as many as the resources permit"""
    max_failures: Natural = 3
    """largest number of failed or killed workers that the search replaces; a new worker resumes their trials"""
    ray: str = ""
    """run the trials on Ray. The flag alone starts Ray on this machine; with an address, the trials run on that cluster, whose
    machines must share the folder of the search"""
    trial_cpus: Positive = 1
    """with --ray: CPU cores of a trial"""
    trial_gpus: Annotated[float | None, Range(0)] = None
    """with --ray: GPUs of a trial; by default 1 if the cluster has any and the device is not `cpu`"""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    """initial settings of the trials"""

    def validated(self) -> SearchArguments:
        """These arguments, validated.

        Raises:
            ValueError: A value is out of range, or a combination is not supported.
        """
        ranges.check(self)
        settings = self.settings.validated()
        if not self.ray:  # The devices of other machines are not known here.
            choose_device(settings.device)
        if settings.run or settings.resume:
            raise ValueError("--run and --resume are not supported: the search names its runs; use --folder")
        if settings.time_limit or settings.target_reward is not None:
            raise ValueError(
                "--time-limit and --target-reward are not supported: trials are compared at the same updates"
            )
        return self


@dataclass
class Trial:
    """A trial that this process has begun, with its lock.

    Attributes:
        trials: The trials of the search.
        asked: The `optuna.Trial`.
        settings: Settings of its run, validated.
        lock: The locked file of the trial.
        reported: The last reported update; 0 before the first.
        reward: The last observed reward; None before the first episode has ended.
        pruned: Whether the trial should be pruned.
    """

    trials: Trials
    asked: Any
    settings: Settings
    lock: IO[str]
    reported: int
    reward: float | None = None
    pruned: bool = False

    @property
    def number(self) -> int:
        """Number of the trial in the study."""
        return int(self.asked.number)

    def observe(self, update: int, reward: float | None) -> bool:
        """Record the mean reward at an update.

        Args:
            update: Number of the update. Updates that a resumed trial repeats are not reported again.
            reward: Mean reward of the last 100 episodes; None if no episode has ended.

        Returns:
            Whether the trial should be pruned.
        """
        self.reward = self.reward if reward is None else reward
        is_due = update % self.trials.arguments.period == 0 and self.reported < update < self.settings.ppo.updates
        if is_due and self.reward is not None:
            self.asked.report(self.reward, update)
            self.reported = update
            self.pruned = self.asked.should_prune()
        return self.pruned

    def complete(self) -> None:
        """Tell the study that the run is done or pruned."""
        if self.pruned:
            self.trials.say(f"trial {self.number} is pruned")
        elif self.reward is None:
            self.trials.say(f"trial {self.number}: no episode has ended; increase --ppo.updates")
        done = not self.pruned and self.reward is not None
        self._end("COMPLETE" if done else "PRUNED", self.reward if done else None)

    def interrupt(self) -> None:
        """Release the trial, which is not done; a process resumes it from its last checkpoint."""
        self.lock.close()

    def fail(self, reason: str) -> None:
        """Tell the study that the run failed in a way that would recur; it is never resumed."""
        self.trials.say(f"trial {self.number} {reason}")
        self._end("FAIL")

    def _end(self, state: str, value: float | None = None) -> None:
        with self.trials.locked():
            self.trials.end_trial(self.number, self.lock, state, value)


class _JournalLock:
    """The lock under which Optuna appends to a journal.

    Optuna's own one would stay for 30 seconds after a process was killed, and a part of a line that a process wrote before it
    was killed, or before the disk was full, would make the journal unreadable. That part is cut off.
    """

    def __init__(self, journal: Path) -> None:
        self._journal = journal
        self._opened: IO[bytes] | None = None

    def acquire(self) -> bool:
        """Lock the journal, and wait until no other process has locked it."""
        self._opened = opened = self._journal.open("rb+")
        fcntl.flock(opened, fcntl.LOCK_EX)
        end = opened.seek(0, 2)
        opened.seek(max(0, end - (1 << 20)))  # A line is much shorter.
        opened.truncate(end - len(opened.read().rpartition(b"\n")[2]))
        return True

    def release(self) -> None:
        """Release the lock."""
        if self._opened is not None:
            self._opened.close()


class Trials:
    """The trials of a search, stored in an Optuna study that several processes may share.

    Attributes:
        arguments: The arguments.
        folder: Folder of the search.
        space: The search space.
        study: The Optuna study.
        end: Time after which no more trials begin, on the clock `time.monotonic`; infinity for no limit.
    """

    def __init__(self, arguments: SearchArguments, console: Console) -> None:
        """Open the study of the folder, or create it.

        Args:
            arguments: The arguments, validated.
            console: Where messages are printed.

        Raises:
            ModuleNotFoundError: Optuna is not installed.
            ValueError: The study was created with other settings or parameters.
        """
        command.check_installed("the search", "optuna")
        import optuna
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(logging.ERROR)
        self.arguments, self.console, base = arguments, console, arguments.settings
        self.folder = Path(arguments.folder or f"searches/{command.folder_name(base.env)}/{base.agent_name}")
        self.end = time.monotonic() + (60 * arguments.minutes if arguments.minutes else float("inf"))
        self.space: Space = space(base, arguments.parameters)
        (self.folder / LOCKS).mkdir(parents=True, exist_ok=True)
        journal = self.folder / STUDY
        with self.locked():
            backend = JournalFileBackend(str(journal), _JournalLock(journal))  # type: ignore[arg-type]
            self.study = optuna.create_study(
                study_name="search",
                storage=optuna.storages.JournalStorage(backend),
                load_if_exists=True,
                direction="maximize",
                pruner=_pruner(arguments),
            )
            # The numbers of threads depend on the machine and on the number of workers.
            same = replace(base, threads=0, environment=replace(base.environment, num_threads=0))
            initial = json.loads(json.dumps({"settings": to_dict(same), "space": self.space}))
            if "begun" not in self.study.user_attrs:
                self.study.set_user_attr("begun", initial)
            elif self.study.user_attrs["begun"] != initial:
                raise ValueError(
                    f"the search in {self.folder} was started with other settings or parameters; repeat them, or use another "
                    "--folder"
                )
            if arguments.stage != "combinations":
                for change in single_changes(self.space):
                    self.study.enqueue_trial(change, user_attrs={_SINGLE: True}, skip_if_exists=True)

    def say(self, text: str) -> None:
        """Print a line."""
        self.console.print(text, soft_wrap=True)

    def locked(self) -> AbstractContextManager[None]:
        """Hold the lock of the folder."""
        return jobs.locked(self.folder / LOCKS / "study")

    def remaining(self) -> tuple[int, int]:
        """Number of trials that are done, and of those that no process has begun, or whose process has ended."""
        with self.locked():
            interrupted = [lock for number in self._numbers("RUNNING") if (lock := self._lock_of(number)) is not None]
            for lock in interrupted:
                lock.close()
            return len(self._numbers("COMPLETE", "PRUNED")), len(interrupted) + self._new()

    def begin(self) -> Trial | None:
        """Begin the next trial: a single change, one that was interrupted, or a combination.

        Returns:
            The trial; None if none is left or the time is up.
        """
        if time.monotonic() >= self.end:
            return None
        with self.locked():
            while (found := self._next()) is not None:
                asked, lock = found
                choices: dict[str, Any] = {
                    name: asked.suggest_categorical(name, listed) for name, listed in self.space.items()
                }
                run = str(self.folder / f"trial-{asked.number:04d}")
                settings = replace(with_choices(self.arguments.settings, choices), run=run, stop_when_learnt=False)
                self.say(f"trial {asked.number}: {self.changed(choices) or 'initial settings'}")
                try:
                    settings = settings.validated()
                except ValueError as error:
                    self.say(f"trial {asked.number} is invalid: {error}")
                    self.end_trial(asked.number, lock, "PRUNED")
                    continue
                reported = self.study.trials[asked.number].intermediate_values
                return Trial(self, asked, settings, lock, max(reported, default=0))
        return None

    def end_trial(self, number: int, lock: IO[str], state: str, value: float | None = None) -> None:
        """Tell the study how a trial has ended, and release its lock. The caller must hold the lock of the folder."""
        from optuna.trial import TrialState

        self.study.tell(number, value, state=TrialState[state])
        Path(lock.name).unlink()
        lock.close()

    def _next(self) -> tuple[Any, IO[str]] | None:
        """The next `optuna.Trial` with its lock; None if none is left. The caller must hold the lock of the folder."""
        import optuna

        # A different seed for each trial: processes must not propose the same, and a restarted search must not repeat its
        # earlier samples.
        self.study.sampler = optuna.samplers.TPESampler(seed=self.arguments.settings.seed + len(self.study.trials))
        if not self._numbers("WAITING"):
            for trial in self.study.trials:
                if trial.state.name == "RUNNING" and (lock := self._lock_of(trial.number)) is not None:
                    return optuna.trial.Trial(self.study, trial._trial_id), lock
        if not self._new():
            return None
        asked = self.study.ask()
        lock = self._lock_of(asked.number)
        assert lock is not None, "no process but this one has the trial"
        return asked, lock

    def _lock_of(self, number: int) -> IO[str] | None:
        """The locked file of a trial; None if another process has locked it. The caller must hold the lock of the folder."""
        return jobs.try_lock(self.folder / LOCKS / f"trial-{number:04d}")

    def _numbers(self, *states: str) -> list[int]:
        """Numbers of the trials in these states."""
        return [trial.number for trial in self.study.trials if trial.state.name in states]

    def _new(self) -> int:
        """Number of trials that no process has begun."""
        waiting = len(self._numbers("WAITING"))
        combinations = sum(_SINGLE not in trial.user_attrs for trial in self.study.trials)
        return waiting + (0 if self.arguments.stage == "single" else max(0, self.arguments.trials - combinations))

    def changed(self, choices: Mapping[str, Choice]) -> str:
        """The flags of `endless-train` for the choices that differ from the initial settings."""
        different = {
            name.replace("_", "-"): choice
            for name, choice in choices.items()
            if name in self.space and choice != self.space[name][0]
        }
        return " ".join(command.flags(different))

    def report(self) -> None:
        """Write the best settings and all trials to `best.json`, and print the ten best; does nothing if no trial is complete.

        The file is replaced atomically.
        """
        from optuna.trial import TrialState

        with self.locked():  # Other processes of the search write the same files.
            done = self.study.get_trials(states=(TrialState.COMPLETE,))
            done.sort(key=lambda trial: -(trial.value or 0.0))
            pruned = len(self.study.get_trials(states=(TrialState.PRUNED,)))
            if not done:
                return
            title = f"{len(done)} trials complete, {pruned} pruned"
            table = tables.table(title, {"trial": True, "reward": True, "changes": False})
            for trial in done[:10]:
                table.add_row(str(trial.number), f"{trial.value:.4f}", self.changed(trial.params) or "none")
            tables.show(table, self.console)
            best = to_dict(with_choices(self.arguments.settings, done[0].params))
            trials = [
                {"trial": trial.number, "state": trial.state.name, "reward": trial.value, "choices": trial.params}
                for trial in self.study.trials
            ]
            found = {"reward": done[0].value, "trial": done[0].number, "settings": best, "trials": trials}
            atomic.write(self.folder / BEST, json.dumps(found, indent=1) + "\n")
            settings, changed = self.arguments.settings, self.changed(done[0].params)
            start = f"--env {shlex.quote(settings.env)} --preset {settings.preset}"
            start += "" if "--agent" in changed else f" --agent {settings.agent}"
            self.console.print(
                f"the best settings are in {self.folder / BEST}; as flags, in addition to your own:", soft_wrap=True
            )
            self.console.print(f"endless-train {start} {changed}".rstrip(), soft_wrap=True)


def resumable(settings: Settings) -> tuple[Settings, list[dict[str, Any]]]:
    """The settings with which a trial's run, in its folder, is resumed or started, and the rows of `progress.jsonl` so far."""
    run = Path(settings.run)
    if (run / checkpoint.SETTINGS).exists():
        settings = replace(settings, resume=settings.run)
    return settings, read_progress(run)


def _pruner(arguments: SearchArguments) -> Any:
    import optuna

    if arguments.pruner == "none":
        return optuna.pruners.NopPruner()
    if arguments.pruner == "asha":
        return optuna.pruners.SuccessiveHalvingPruner(min_resource=max(1, arguments.warm_up), reduction_factor=4)
    return optuna.pruners.PercentilePruner(
        arguments.percentile, n_startup_trials=arguments.startup_trials, n_warmup_steps=arguments.warm_up
    )
