"""`endless-search`: the paper's search for hyperparameters.

First every choice of the paper's table is tried by itself, all else as in the settings that the search starts from. Then a
Tree-structured Parzen Estimator tries combinations. Runs that fall behind the best quarter of those before them are stopped, but
not before they are warm. What is compared is the mean reward of the last 100 training episodes.

The search can be stopped and started again at any time: its trials are in the folder's `study.db`, and a trial that was stopped
goes on from its checkpoint. One search at a time works in a folder.

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

STUDY, BEST = "study.db", "best.json"
#: Attributes of a trial: that it tries one choice by itself, and the folder of the run that it goes on with.
_SINGLE, _GOES_ON = "single", "goes_on"


@dataclass(frozen=True)
class Search:
    """How to search; all flags of `endless-train` set what each trial starts from."""

    folder: str = ""
    """the search's folder, with its study and the trials' runs; empty for searches/ENV/AGENT"""
    stage: Literal["both", "single", "combinations"] = "both"
    """single: every choice by itself; combinations: those that the estimator proposes; both: one after the other"""
    trials: int = 50
    """combinations that are tried, in all; the single choices come on top"""
    parameters: tuple[str, ...] = ()
    """search only these, such as ppo.epochs; empty for all of the paper's table"""
    percentile: float = 25.0
    """a trial is stopped when it is not among this best percentage of the trials at the same update"""
    warm_up: int = 2000
    """updates before a trial may be stopped"""
    startup_trials: int = 5
    """trials that have to be done before any may be stopped"""
    period: int = 50
    """updates between two looks at a trial"""
    minutes: float = 0.0
    """begin no further trial after this time; 0 for no limit"""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    """what each trial starts from"""

    def place(self) -> Path:
        """The search's folder."""
        return Path(self.folder or f"searches/{self.settings.env}/{self.settings.agent}")

    def checked(self) -> Search:
        """The search, once nothing speaks against it.

        Raises:
            ValueError: A number or a combination is not possible.
        """
        settings = self.settings.checked()
        choose_device(settings.device)
        if self.trials < 0 or self.period < 1 or self.warm_up < 0 or self.startup_trials < 0:
            raise ValueError("--trials, --warm-up and --startup-trials are 0 or more, --period is 1 or more")
        if not 0 < self.percentile <= 100:
            raise ValueError(f"--percentile is {self.percentile}; give more than 0 and at most 100")
        if settings.run or settings.resume:
            raise ValueError("a search names its runs itself; give --folder in place of --run and --resume")
        if settings.time_limit or settings.target_reward is not None:
            raise ValueError("trials are compared at the same updates; drop --time-limit and --target-reward")
        return self


class Trials:
    """The trials of a search, in its study."""

    def __init__(self, given: Search, console: Console) -> None:
        """Open a folder's study, or begin one.

        Raises:
            ValueError: The folder's study was begun with other settings.
        """
        import optuna

        optuna.logging.set_verbosity(logging.ERROR)
        self.given, self.console, self.folder = given, console, given.place()
        self.space: Space = space(given.settings, given.parameters)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.study = optuna.create_study(
            study_name="search",
            storage=f"sqlite:///{self.folder / STUDY}",
            load_if_exists=True,
            direction="maximize",
            pruner=optuna.pruners.PercentilePruner(
                given.percentile, n_startup_trials=given.startup_trials, n_warmup_steps=given.warm_up
            ),
        )
        begun = json.loads(json.dumps({"settings": to_dict(given.settings), "space": self.space}))
        if self.study.user_attrs.setdefault("begun", begun) != begun:
            raise ValueError(
                f"the search in {self.folder} was begun with other settings or parameters; repeat those, or give another --folder"
            )
        self.study.set_user_attr("begun", begun)
        # The estimator's draws follow from the seed, and go on with other ones when a search goes on.
        self.study.sampler = optuna.samplers.TPESampler(seed=given.settings.seed + len(self.study.trials))

    def run(self) -> None:
        """Run all trials that are still to be run."""
        from optuna.trial import TrialState

        self._take_up()
        finished = [trial for trial in self.study.trials if trial.state in (TrialState.COMPLETE, TrialState.PRUNED)]
        combinations = sum(_SINGLE not in trial.user_attrs for trial in finished)
        waiting = [trial for trial in self.study.trials if trial.state is TrialState.WAITING]
        left = len(waiting)
        if self.given.stage != "single":
            begun = sum(_SINGLE not in trial.user_attrs for trial in waiting)
            left += max(0, self.given.trials - combinations - begun)
        text = f"{len(finished)} trials are done, {left} are to be run, in {self.folder}; Ctrl-C stops"
        self.console.print(text, soft_wrap=True)
        if left:
            seconds = self.given.minutes * 60 or None
            self.study.optimize(self.objective, left, timeout=seconds, catch=(torch.cuda.OutOfMemoryError,))

    def _take_up(self) -> None:
        """Put trials that were stopped, and single choices that were never tried, into the queue."""
        from optuna.trial import TrialState

        for trial in self.study.get_trials(states=(TrialState.RUNNING,)):
            self.study.tell(trial.number, state=TrialState.FAIL)
        goes_on = {trial.user_attrs.get(_GOES_ON) for trial in self.study.trials}
        for trial in self.study.get_trials(states=(TrialState.FAIL,)):
            folder = self.run_folder(trial.number, trial.user_attrs)
            # One that failed by itself, for want of memory, would fail again.
            if str(trial.number) not in goes_on and trial.params and not trial.user_attrs.get("failed"):
                attributes = {_GOES_ON: str(trial.number), "folder": folder.name}
                if _SINGLE in trial.user_attrs:
                    attributes[_SINGLE] = trial.user_attrs[_SINGLE]
                self.study.enqueue_trial(trial.params, user_attrs=attributes)
        if self.given.stage != "combinations":
            known = {
                trial.user_attrs.get(_SINGLE)
                for trial in self.study.trials
                if trial.state is not TrialState.FAIL or trial.params
            }
            for number, change in enumerate(single_changes(self.space)):
                if number not in known:
                    self.study.enqueue_trial(change, user_attrs={_SINGLE: number})

    def run_folder(self, number: int, attributes: Mapping[str, Any]) -> Path:
        """Of a trial's run; one that goes on has its predecessor's."""
        name: str = attributes.get("folder", f"trial-{number:04d}")
        return self.folder / name

    def objective(self, trial: Any) -> float:
        """Train with a trial's choices.

        Returns:
            The mean reward of the last 100 training episodes.
        """
        import optuna

        choices = {name: trial.suggest_categorical(name, listed) for name, listed in self.space.items()}
        run = self.run_folder(trial.number, trial.user_attrs)
        settings = replace(with_choices(self.given.settings, choices), run=str(run))
        changed = self.changed(choices)
        self.console.print(f"[bold]trial {trial.number}[/]: {changed or 'as it starts'}", soft_wrap=True)
        try:
            settings.checked()
        except ValueError as error:
            self.console.print(f"trial {trial.number} is not possible: {error}", soft_wrap=True)
            raise optuna.TrialPruned from error

        reward: float | None = None
        seen, last, behind = 0, settings.ppo.updates, False

        def watch(update: int, means: Mapping[str, Any]) -> bool:
            nonlocal reward, seen, behind
            seen, reward = update, means.get("episode/reward", reward)
            if update % self.given.period == 0 and reward is not None and update < last:
                trial.report(reward, update)
                behind = trial.should_prune()
            return behind

        if (run / checkpoint.FOLDER / checkpoint.LAST).exists():
            settings = replace(settings, resume=str(run))
            for row in read_progress(run):
                watch(row["update"], row)
        elif run.exists():
            shutil.rmtree(run)  # It was stopped before its first checkpoint.
        try:
            if not behind:
                train(settings, watch)
        except torch.cuda.OutOfMemoryError:
            trial.set_user_attr("failed", True)
            raise
        if behind:
            self.console.print(f"trial {trial.number} falls behind and is stopped", soft_wrap=True)
            raise optuna.TrialPruned
        if seen < last:
            raise KeyboardInterrupt
        if reward is None:
            self.console.print(f"trial {trial.number}: no episode has ended; give more --ppo.updates", soft_wrap=True)
            raise optuna.TrialPruned
        return reward

    def changed(self, choices: Mapping[str, Choice]) -> str:
        """The flags that make the difference to where the search starts."""
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
        """Write the best settings and all trials to `best.json`, and show the best ones; nothing if none is done."""
        from optuna.trial import TrialState

        done = self.study.get_trials(states=(TrialState.COMPLETE,))
        done.sort(key=lambda trial: -(trial.value or 0.0))
        pruned = len(self.study.get_trials(states=(TrialState.PRUNED,)))
        if not done:
            return
        drawn = Table(
            title=f"{len(done)} trials to the end, {pruned} stopped early", title_justify="left", box=box.SIMPLE
        )
        for name in ("trial", "reward", "what is different"):
            drawn.add_column(name, justify="left" if name == "what is different" else "right")
        for trial in done[:10]:
            drawn.add_row(str(trial.number), f"{trial.value:.4f}", self.changed(trial.params) or "nothing")
        self.console.print(drawn)
        best = to_dict(with_choices(self.given.settings, done[0].params))
        trials = [
            {"trial": trial.number, "state": trial.state.name, "reward": trial.value, "choices": trial.params}
            for trial in self.study.trials
        ]
        found = {"reward": done[0].value, "trial": done[0].number, "settings": best, "trials": trials}
        (self.folder / BEST).write_text(json.dumps(found, indent=1) + "\n")
        settings, changed = self.given.settings, self.changed(done[0].params)
        start = f"--env {settings.env} --preset {settings.preset}"
        start += "" if "--agent" in changed else f" --agent {settings.agent}"
        self.console.print(f"the best settings are in {self.folder / BEST}; beside your own flags:", soft_wrap=True)
        self.console.print(f"endless-train {start} {changed}".rstrip(), soft_wrap=True)


def work(given: Search) -> None:
    """Search, and tell what is best so far, also when stopped."""
    trials = Trials(given.checked(), Console(highlight=False))
    try:
        trials.run()
    finally:
        trials.report()


def parse(arguments: list[str]) -> Search:
    """A search from the command line; the preset gives the defaults of the training's flags."""
    chosen = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chosen.add_argument("--preset", default="paper")
    preset = chosen.parse_known_args(arguments)[0].preset
    default = Search(settings=PRESETS.get(preset, PRESETS["paper"]))
    text = command.description(__doc__)
    return tyro.cli(Search, prog="endless-search", description=text, args=arguments, default=default)


def main() -> int:
    """The command `endless-search`."""
    given = parse(sys.argv[1:])
    return command.run("endless-search", lambda: work(given))


if __name__ == "__main__":
    sys.exit(main())
