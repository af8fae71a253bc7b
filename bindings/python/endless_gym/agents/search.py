"""`endless-search`: the hyperparameter search of the paper.

The first stage tries every choice of the paper's table as a single change of the initial settings. The second stage tries
combinations proposed by a Tree-structured Parzen Estimator (TPE). After a warm-up, trials outside the best quarter of the
earlier trials are pruned. The objective is the mean reward of the last 100 training episodes.

The search can be interrupted and restarted at any time: the trials are stored in `study.db` of the search's folder, and an
interrupted trial resumes from its checkpoint. Only one search at a time may use a folder.

```console
endless-search --env MortarMayhem-v0 --agent trxl --ppo.updates 5000 --trials 50
```
"""

from __future__ import annotations

import argparse
import json
import logging
import shutil
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from endless_gym.agents import checkpoint, command
from endless_gym.agents.logs import read_progress
from endless_gym.agents.search_space import Choice, Space, single_changes, space, with_choices
from endless_gym.agents.settings import PRESETS, Settings, to_dict
from endless_gym.agents.train import choose_device, train

#: Files in the folder of a search: the Optuna study, and the best settings.
STUDY, BEST = "study.db", "best.json"
#: User attributes of a trial: index of its single change, and number of the interrupted trial that it resumes.
_SINGLE, _RESUMES = "single", "goes_on"


@dataclass(frozen=True)
class SearchArguments:
    """Arguments of `endless-search`; the flags of `endless-train` set the initial settings of the trials."""

    folder: str = ""
    """folder of the search, with the study and the runs of the trials; empty for searches/ENV/AGENT"""
    stage: Literal["both", "single", "combinations"] = "both"
    """single: single changes; combinations: combinations proposed by the TPE; both: first single changes, then combinations"""
    trials: int = 50
    """total number of combinations; the trials with single changes are additional"""
    parameters: tuple[str, ...] = ()
    """parameters to search, such as ppo.epochs; empty for all of the paper's table"""
    percentile: float = 25.0
    """a trial is pruned if it is not among this best percentage of the trials at the same update"""
    warm_up: int = 2000
    """updates before a trial can be pruned"""
    startup_trials: int = 5
    """trials that must be complete before a trial can be pruned"""
    period: int = 50
    """updates between two pruning decisions"""
    minutes: float = 0.0
    """start no more trials after this time; 0 for no limit"""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    """initial settings of the trials"""

    def directory(self) -> Path:
        """Folder of the search, with the default resolved."""
        return Path(self.folder or f"searches/{self.settings.env}/{self.settings.agent}")

    def validated(self) -> SearchArguments:
        """These arguments, validated.

        Raises:
            ValueError: A value is out of range, or a combination is not supported.
        """
        settings = self.settings.validated()
        choose_device(settings.device)
        numbers = {"trials": self.trials, "warm-up": self.warm_up, "startup-trials": self.startup_trials}
        for name, number in numbers.items():
            if number < 0:
                raise ValueError(f"--{name} must be 0 or more, got {number}")
        if self.period < 1:
            raise ValueError(f"--period must be 1 or more, got {self.period}")
        if not 0 < self.percentile <= 100:
            raise ValueError(f"--percentile must be greater than 0 and at most 100, got {self.percentile}")
        if settings.run or settings.resume:
            raise ValueError("--run and --resume are not supported: the search names its runs; use --folder")
        if settings.time_limit or settings.target_reward is not None:
            raise ValueError(
                "--time-limit and --target-reward are not supported: trials are compared at the same updates"
            )
        return self


class Trials:
    """The trials of a search, stored in an Optuna study.

    Attributes:
        arguments: The arguments.
        folder: Folder of the search.
        space: The search space.
        study: The Optuna study.
    """

    def __init__(self, arguments: SearchArguments, console: Console) -> None:
        """Open the study of the folder, or create it.

        Args:
            arguments: The arguments, validated.
            console: Where messages are printed.

        Raises:
            ValueError: The study was created with other settings or parameters.
        """
        import optuna

        optuna.logging.set_verbosity(logging.ERROR)
        self.arguments, self.console, self.folder = arguments, console, arguments.directory()
        self.space: Space = space(arguments.settings, arguments.parameters)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.study = optuna.create_study(
            study_name="search",
            storage=f"sqlite:///{self.folder / STUDY}",
            load_if_exists=True,
            direction="maximize",
            pruner=optuna.pruners.PercentilePruner(
                arguments.percentile, n_startup_trials=arguments.startup_trials, n_warmup_steps=arguments.warm_up
            ),
        )
        initial = json.loads(json.dumps({"settings": to_dict(arguments.settings), "space": self.space}))
        if self.study.user_attrs.setdefault("begun", initial) != initial:
            raise ValueError(
                f"the search in {self.folder} was started with other settings or parameters; repeat them, or use another --folder"
            )
        self.study.set_user_attr("begun", initial)
        # A restarted search must not repeat the samples of its first part.
        self.study.sampler = optuna.samplers.TPESampler(seed=arguments.settings.seed + len(self.study.trials))

    def run(self) -> None:
        """Run all remaining trials."""
        from optuna.trial import TrialState

        self._enqueue()
        finished = [trial for trial in self.study.trials if trial.state in (TrialState.COMPLETE, TrialState.PRUNED)]
        combinations = sum(_SINGLE not in trial.user_attrs for trial in finished)
        waiting = [trial for trial in self.study.trials if trial.state is TrialState.WAITING]
        remaining = len(waiting)
        if self.arguments.stage != "single":
            queued = sum(_SINGLE not in trial.user_attrs for trial in waiting)
            remaining += max(0, self.arguments.trials - combinations - queued)
        text = f"{len(finished)} trials done, {remaining} remaining, in {self.folder}; Ctrl-C stops the search"
        self.console.print(text, soft_wrap=True)
        if remaining:
            seconds = self.arguments.minutes * 60 or None
            self.study.optimize(self.objective, remaining, timeout=seconds, catch=(torch.cuda.OutOfMemoryError,))

    def _enqueue(self) -> None:
        """Enqueue the interrupted trials, and the single changes that have not been tried."""
        from optuna.trial import TrialState

        for trial in self.study.get_trials(states=(TrialState.RUNNING,)):
            self.study.tell(trial.number, state=TrialState.FAIL)
        resumed = {trial.user_attrs.get(_RESUMES) for trial in self.study.trials}
        for trial in self.study.get_trials(states=(TrialState.FAIL,)):
            folder = self.run_folder(trial.number, trial.user_attrs)
            # A trial that ran out of GPU memory would fail again.
            if str(trial.number) not in resumed and trial.params and not trial.user_attrs.get("failed"):
                attributes = {_RESUMES: str(trial.number), "folder": folder.name}
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
        name: str = attributes.get("folder", f"trial-{number:04d}")
        return self.folder / name

    def objective(self, trial: Any) -> float:
        """Train with the choices of a trial: the objective of the Optuna study.

        Args:
            trial: An `optuna.Trial`.

        Returns:
            The mean reward of the last 100 training episodes.

        Raises:
            optuna.TrialPruned: The trial was pruned, its settings are invalid, or no episode has ended.
            KeyboardInterrupt: The run was interrupted.
        """
        import optuna

        choices = {name: trial.suggest_categorical(name, listed) for name, listed in self.space.items()}
        run = self.run_folder(trial.number, trial.user_attrs)
        settings = replace(with_choices(self.arguments.settings, choices), run=str(run))
        changed = self.changed(choices)
        self.console.print(f"[bold]trial {trial.number}[/]: {changed or 'initial settings'}", soft_wrap=True)
        try:
            settings = settings.validated()
        except ValueError as error:
            self.console.print(f"trial {trial.number} is invalid: {error}", soft_wrap=True)
            raise optuna.TrialPruned from error

        reward: float | None = None
        done, last, pruned = 0, settings.ppo.updates, False

        def watch(update: int, means: Mapping[str, Any]) -> bool:
            nonlocal reward, done, pruned
            done, reward = update, means.get("episode/reward", reward)
            if update % self.arguments.period == 0 and reward is not None and update < last:
                trial.report(reward, update)
                pruned = trial.should_prune()
            return pruned

        if (run / checkpoint.FOLDER / checkpoint.LAST).exists():
            settings = replace(settings, resume=str(run))
            for row in read_progress(run):
                watch(row["update"], row)
        elif run.exists():
            shutil.rmtree(run)  # The run was interrupted before its first checkpoint.
        try:
            if not pruned:
                train(settings, watch)
        except torch.cuda.OutOfMemoryError:
            trial.set_user_attr("failed", True)
            raise
        if pruned:
            self.console.print(f"trial {trial.number} is pruned", soft_wrap=True)
            raise optuna.TrialPruned
        if done < last:
            raise KeyboardInterrupt
        if reward is None:
            self.console.print(f"trial {trial.number}: no episode has ended; increase --ppo.updates", soft_wrap=True)
            raise optuna.TrialPruned
        return reward

    def changed(self, choices: Mapping[str, Choice]) -> str:
        """The flags of `endless-train` for the choices that differ from the initial settings."""
        flags = []
        for name, choice in choices.items():
            if name in self.space and choice != self.space[name][0]:
                flag = name.replace("_", "-")
                if isinstance(choice, bool):
                    group, _, entry = flag.rpartition(".")
                    flags.append(f"--{flag}" if choice else f"--{group}.no-{entry}")
                else:
                    flags.append(f"--{flag} {choice}")
        return " ".join(flags)

    def report(self) -> None:
        """Write the best settings and all trials to `best.json`, and print the ten best; does nothing if no trial is complete."""
        from optuna.trial import TrialState

        done = self.study.get_trials(states=(TrialState.COMPLETE,))
        done.sort(key=lambda trial: -(trial.value or 0.0))
        pruned = len(self.study.get_trials(states=(TrialState.PRUNED,)))
        if not done:
            return
        table = Table(title=f"{len(done)} trials complete, {pruned} pruned", title_justify="left", box=box.SIMPLE)
        for name in ("trial", "reward", "changes"):
            table.add_column(name, justify="left" if name == "changes" else "right")
        for trial in done[:10]:
            table.add_row(str(trial.number), f"{trial.value:.4f}", self.changed(trial.params) or "none")
        self.console.print(table)
        best = to_dict(with_choices(self.arguments.settings, done[0].params))
        trials = [
            {"trial": trial.number, "state": trial.state.name, "reward": trial.value, "choices": trial.params}
            for trial in self.study.trials
        ]
        found = {"reward": done[0].value, "trial": done[0].number, "settings": best, "trials": trials}
        (self.folder / BEST).write_text(json.dumps(found, indent=1) + "\n")
        settings, changed = self.arguments.settings, self.changed(done[0].params)
        start = f"--env {settings.env} --preset {settings.preset}"
        start += "" if "--agent" in changed else f" --agent {settings.agent}"
        self.console.print(
            f"the best settings are in {self.folder / BEST}; as flags, in addition to your own:", soft_wrap=True
        )
        self.console.print(f"endless-train {start} {changed}".rstrip(), soft_wrap=True)


def execute(arguments: SearchArguments) -> None:
    """Run the search, and report the best settings so far, also if it is interrupted."""
    trials = Trials(arguments.validated(), Console(highlight=False))
    try:
        trials.run()
    finally:
        trials.report()


def parse(arguments: list[str]) -> SearchArguments:
    """Parse command-line arguments; the preset determines the defaults of the training flags."""
    chosen = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--preset", default="paper")
    preset = chosen.parse_known_args(arguments)[0].preset
    default = SearchArguments(settings=PRESETS.get(preset, PRESETS["paper"]))
    text = command.description(__doc__)
    return tyro.cli(SearchArguments, prog="endless-search", description=text, args=arguments, default=default)


def main() -> int:
    """Entry point of the command `endless-search`; returns the exit status."""
    arguments = parse(sys.argv[1:])
    return command.run("endless-search", lambda: execute(arguments))


if __name__ == "__main__":
    sys.exit(main())
