"""The trials of a hyperparameter search, in an Optuna study that several processes may share.

The process that runs a trial holds a lock on a file in the search's folder. The operating system releases the lock when the
process ends for any reason, so other processes can find the trials of dead processes and resume them from their checkpoints.
The next trial is chosen under the study's lock.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import tyro
from rich.console import Console

from endless_gym_agents import atomic, checkpoint, ranges, tables
from endless_gym_agents.experiments.planning import flags
from endless_gym_agents.logs import read_progress
from endless_gym_agents.ranges import FromZero, Natural, Positive, Range
from endless_gym_agents.search_space import Choice, Space, single_changes, space, with_choices
from endless_gym_agents.settings import Settings, to_dict
from endless_gym_agents.train import choose_device

#: Files in the folder of a search: the Optuna study, the best settings, and the folder of the locks.
STUDY, BEST, LOCKS = "study.db", "best.json", "locks"
#: Seconds that a process waits for another process to finish writing to the study.
_WRITE_TIMEOUT = 60.0
#: User attributes of a trial: index of its single change, number of the trial that it resumes, folder of the run, and whether it
#: failed in a way that would recur.
_SINGLE, _RESUMES, _FOLDER, _FAILED = "single", "goes_on", "folder", "failed"


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
    """trials that run at the same time on this machine, each in its own process; 0 for one, in this process. With --ray, the
    limit for all machines together; 0 for as many as the resources permit"""
    max_failures: Natural = 3
    """largest number of killed workers that the search replaces; with --ray, largest number of times that it resumes a failed
    trial. A trial that failed more often is resumed when the command is repeated"""
    ray: str = ""
    """run the trials on Ray Tune. The flag alone starts Ray on this machine; with an address, the trials run on that cluster,
    whose machines must share the folder of the search"""
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
        reward: The last observed reward; None before the first episode has ended.
        pruned: Whether the trial should be pruned.
        reported: The last reported update.
    """

    trials: Trials
    asked: Any
    settings: Settings
    lock: IO[str]
    reward: float | None = None
    pruned: bool = False
    reported: int = 0

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
        self._tell("COMPLETE" if done else "PRUNED", self.reward if done else None)

    def interrupt(self) -> None:
        """Tell the study that the run was interrupted; another trial resumes it."""
        self._tell("FAIL")

    def postpone(self, reason: str) -> None:
        """Tell the study that the run failed. Another trial resumes it in a later call of the search; in this one it would fail
        again.
        """
        self.trials.say(f"trial {self.number} {reason}")
        self.trials.postponed.add(self.number)
        self._tell("FAIL")

    def fail(self, reason: str) -> None:
        """Tell the study that the run failed in a way that would recur; it is never resumed."""
        self.trials.say(f"trial {self.number} {reason}")
        self.asked.set_user_attr(_FAILED, True)
        self._tell("FAIL")

    def _tell(self, state: str, value: float | None = None) -> None:
        from optuna.trial import TrialState

        # Set the state before releasing the lock: a running trial without a lock counts as abandoned.
        self.trials.study.tell(self.number, value, state=TrialState[state])
        Path(self.lock.name).unlink(missing_ok=True)
        self.lock.close()


class Trials:
    """The trials of a search, stored in an Optuna study that several processes may share.

    Attributes:
        arguments: The arguments.
        folder: Folder of the search.
        space: The search space.
        study: The Optuna study.
        end: Time after which no more trials begin, on the clock `time.monotonic`; infinity for no limit.
        postponed: Numbers of the failed trials that only a later call of the search resumes.
    """

    def __init__(self, arguments: SearchArguments, console: Console, end: float | None = None) -> None:
        """Open the study of the folder, or create it.

        Args:
            arguments: The arguments, validated.
            console: Where messages are printed.
            end: The `end` of the search that this process works for; by default `arguments.minutes` from now.

        Raises:
            ValueError: The study was created with other settings or parameters.
        """
        import optuna

        optuna.logging.set_verbosity(logging.ERROR)
        self.arguments, self.console, base = arguments, console, arguments.settings
        self.folder = Path(arguments.folder or f"searches/{base.env}/{base.agent_name}")
        limit = 60 * arguments.minutes if arguments.minutes else float("inf")
        self.end = time.monotonic() + limit if end is None else end
        self.postponed: set[int] = set()
        self.space: Space = space(arguments.settings, arguments.parameters)
        (self.folder / LOCKS).mkdir(parents=True, exist_ok=True)
        with self._locked():
            self.study = optuna.create_study(
                study_name="search",
                storage=optuna.storages.RDBStorage(
                    f"sqlite:///{self.folder / STUDY}", engine_kwargs={"connect_args": {"timeout": _WRITE_TIMEOUT}}
                ),
                load_if_exists=True,
                direction="maximize",
                pruner=_pruner(arguments),
            )
            initial = json.loads(json.dumps({"settings": to_dict(arguments.settings), "space": self.space}))
            if self.study.user_attrs.setdefault("begun", initial) != initial:
                raise ValueError(
                    f"the search in {self.folder} was started with other settings or parameters; repeat them, or use another "
                    "--folder"
                )
            self.study.set_user_attr("begun", initial)

    def say(self, text: str) -> None:
        """Print a line."""
        self.console.print(text, soft_wrap=True)

    def remaining(self) -> tuple[int, int]:
        """Number of trials that are done, and of those that no process has begun."""
        with self._locked():
            self._enqueue()
            states = [trial.state.name for trial in self.study.trials]
            return states.count("COMPLETE") + states.count("PRUNED"), self._left()

    def begin(self) -> Trial | None:
        """Begin the next trial: one that was interrupted, a single change, or a combination.

        Returns:
            The trial; None if none is left or the time is up.
        """
        import optuna

        if time.monotonic() >= self.end:
            return None
        with self._locked():
            self._enqueue()
            while self._left():
                # A different seed for each trial: processes must not propose the same, and a restarted search must not repeat its
                # earlier samples.
                seed = self.arguments.settings.seed + len(self.study.trials)
                self.study.sampler = optuna.samplers.TPESampler(seed=seed)
                asked = self.study.ask()
                lock = self._lock_of(asked.number)
                assert lock is not None, "no process but this one has the trial"
                choices: dict[str, Any] = {
                    name: asked.suggest_categorical(name, listed) for name, listed in self.space.items()
                }
                run = self.run_folder(asked.number, asked.user_attrs)
                settings = with_choices(self.arguments.settings, choices)
                trial = Trial(self, asked, replace(settings, run=str(run), stop_when_learnt=False), lock)
                self.say(f"trial {trial.number}: {self.changed(choices) or 'initial settings'}")
                try:
                    trial.settings = trial.settings.validated()
                except ValueError as error:
                    self.say(f"trial {trial.number} is invalid: {error}")
                    trial.pruned = True
                    trial.complete()
                    continue
                return trial
        return None

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        """Hold the lock of the study."""
        with (self.folder / LOCKS / "study").open("w") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _lock_of(self, number: int) -> IO[str] | None:
        """The locked file of a trial; None if another process has locked it. The caller must hold the lock of the study."""
        file = (self.folder / LOCKS / f"trial-{number:04d}").open("w")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            return None
        return file

    def _in_states(self, *states: str) -> list[Any]:
        from optuna.trial import TrialState

        found: list[Any] = self.study.get_trials(states=tuple(TrialState[state] for state in states))
        return found

    def _left(self) -> int:
        """Number of trials that no process has begun."""
        waiting = len(self._in_states("WAITING"))
        if self.arguments.stage == "single":
            return waiting
        combinations = sum(
            _SINGLE not in trial.user_attrs
            and (trial.state.name != "FAIL" or _FAILED in trial.user_attrs or trial.number in self.postponed)
            for trial in self.study.trials
        )
        return waiting + max(0, self.arguments.trials - combinations)

    def _enqueue(self) -> None:
        """Enqueue the interrupted trials, and the single changes that have not been tried."""
        from optuna.trial import TrialState

        for trial in self._in_states("RUNNING"):
            # Its process has ended.
            if (lock := self._lock_of(trial.number)) is not None:
                lock.close()
                self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)
                (self.folder / LOCKS / f"trial-{trial.number:04d}").unlink(missing_ok=True)
        resumed = {trial.user_attrs.get(_RESUMES) for trial in self.study.trials}
        for trial in self._in_states("FAIL"):
            folder = self.run_folder(trial.number, trial.user_attrs)
            # A trial that ran out of GPU memory would fail again.
            ended = trial.user_attrs.get(_FAILED) or trial.number in self.postponed
            if str(trial.number) not in resumed and trial.params and not ended:
                attributes = {_RESUMES: str(trial.number), _FOLDER: folder.name}
                if _SINGLE in trial.user_attrs:
                    attributes[_SINGLE] = trial.user_attrs[_SINGLE]
                self.study.enqueue_trial(trial.params, user_attrs=attributes)
        if self.arguments.stage != "combinations":
            known = {
                trial.user_attrs.get(_SINGLE)
                for trial in self.study.trials
                if trial.state is not TrialState.FAIL or trial.params
            }
            for number, change in enumerate(single_changes(self.space)):
                if number not in known:
                    self.study.enqueue_trial(change, user_attrs={_SINGLE: number})

    def run_folder(self, number: int, attributes: Mapping[str, Any]) -> Path:
        """Folder of the run of a trial with this number and these user attributes; a resumed trial uses its predecessor's."""
        name: str = attributes.get(_FOLDER, f"trial-{number:04d}")
        return self.folder / name

    def changed(self, choices: Mapping[str, Choice]) -> str:
        """The flags of `endless-train` for the choices that differ from the initial settings."""
        different = {
            name.replace("_", "-"): choice
            for name, choice in choices.items()
            if name in self.space and choice != self.space[name][0]
        }
        return " ".join(flags(different))

    def report(self) -> None:
        """Write the best settings and all trials to `best.json`, and print the ten best; does nothing if no trial is complete.

        The file is replaced atomically.
        """
        from optuna.trial import TrialState

        with self._locked():  # Other processes of the search write the same files.
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
            start = f"--env {settings.env} --preset {settings.preset}"
            start += "" if "--agent" in changed else f" --agent {settings.agent}"
            self.console.print(
                f"the best settings are in {self.folder / BEST}; as flags, in addition to your own:", soft_wrap=True
            )
            self.console.print(f"endless-train {start} {changed}".rstrip(), soft_wrap=True)


def resumable(settings: Settings) -> tuple[Settings, list[dict[str, Any]]]:
    """The settings with which a trial's run is resumed or started.

    Args:
        settings: Settings of the run, with its folder. The folder is removed if the run was interrupted before its first
            checkpoint.

    Returns:
        The settings, and the rows of `progress.jsonl` so far.
    """
    run = Path(settings.run)
    if (run / checkpoint.FOLDER / checkpoint.LAST).exists():
        return replace(settings, resume=settings.run), read_progress(run)
    if run.exists():
        shutil.rmtree(run)
    return settings, []


def _pruner(arguments: SearchArguments) -> Any:
    import optuna

    if arguments.pruner == "none":
        return optuna.pruners.NopPruner()
    if arguments.pruner == "asha":
        return optuna.pruners.SuccessiveHalvingPruner(min_resource=max(1, arguments.warm_up), reduction_factor=4)
    return optuna.pruners.PercentilePruner(
        arguments.percentile, n_startup_trials=arguments.startup_trials, n_warmup_steps=arguments.warm_up
    )
