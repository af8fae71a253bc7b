"""The search for hyperparameters: its space, its order, its pruning, and that it goes on where it was stopped."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from agents_helpers import settings
from rich.console import Console

from endless_gym.agents import search
from endless_gym.agents.search import Search, Trials, parse
from endless_gym.agents.search_space import single_changes, space, value, with_choices
from endless_gym.agents.settings import PRESETS, Settings
from endless_gym.agents.train import train

QUIET = Console(quiet=True)


def small(folder: Path, **changes: Any) -> Search:
    given = settings("gru", env="MortarMayhem-Grid-v0", threads=1, checkpoint_interval=100)
    environment = replace(given.environment, num_envs=4, option=("command_count=[1]",))
    ppo = replace(given.ppo, steps=16, minibatches=1, updates=3)
    start = replace(given, environment=environment, ppo=ppo)
    return replace(Search(str(folder), parameters=("ppo.epochs",), trials=1, period=1, settings=start), **changes)


def states(trials: Trials) -> list[str]:
    return [trial.state.name for trial in trials.study.trials]


def test_the_space_is_the_paper_s_table() -> None:
    gru, trxl = (space(replace(PRESETS["paper"], agent=agent)) for agent in ("gru", "trxl"))
    assert gru["ppo.learning_rate"] == (2.75e-4, 2.0e-4, 3.0e-4, 3.5e-4)
    assert gru["recurrence.hidden_size"] == (512, 256, 384)
    assert trxl["transformer.initialisation"] == ("xavier", "orthogonal", "kaiming", "tfixup")
    assert "transformer.layers" not in gru
    assert "recurrence.layers" not in trxl
    # The table has 8 parameters for all with 16 other choices; 4 with 5 for recurrence; 5 with 10 for the Transformer-XL.
    assert (len(gru), len(single_changes(gru))) == (12, 1 + 16 + 5)
    assert (len(trxl), len(single_changes(trxl))) == (13, 1 + 16 + 10)
    rebuilt = replace(PRESETS["paper"], ppo=replace(PRESETS["paper"].ppo, reconstruction_coefficient=0.1))
    assert space(rebuilt)["ppo.reconstruction_coefficient"] == (0.1, 0.5, 1.0)
    # Every single choice makes settings that can be trained.
    for agent, choices in (("gru", gru), ("trxl", trxl)):
        for change in single_changes(choices):
            with_choices(replace(PRESETS["paper"], agent=agent), change).checked()


def test_each_choice_is_tried_by_itself() -> None:
    base = PRESETS["quick"]
    choices = space(base, ("ppo.epochs", "ppo.max-gradient-norm", "agent"))
    start, *changes = single_changes(choices)
    assert with_choices(base, start) == base
    different = [[name for name in change if change[name] != start[name]] for change in changes]
    assert all(len(names) == 1 for names in different)
    assert len(changes) == 2 + 3 + 1
    lstm = with_choices(base, {"agent": "lstm", "ppo.epochs": 4})
    assert (value(lstm, "agent"), lstm.ppo.epochs, lstm.ppo.gamma) == ("lstm", 4, base.ppo.gamma)


def test_a_search_from_end_to_end(tmp_path: Path) -> None:
    """The choices one by one, then a combination; started again, nothing is left to do; wanted more, there is."""
    first = Trials(small(tmp_path, stage="single"), QUIET)
    first.run()
    assert [trial.params["ppo.epochs"] for trial in first.study.trials] == [3, 2, 4]
    second = Trials(small(tmp_path), QUIET)
    second.run()
    assert states(second) == ["COMPLETE"] * 4
    third = Trials(small(tmp_path), QUIET)
    third.run()
    assert len(third.study.trials) == 4
    third.report()
    best = json.loads((tmp_path / "best.json").read_text())
    assert best["reward"] == max(trial.value for trial in third.study.trials)
    (chosen,) = [trial for trial in best["trials"] if trial["trial"] == best["trial"]]
    assert chosen["choices"]["ppo.epochs"] == best["settings"]["ppo"]["epochs"]
    # A trial's value is its run's.
    for trial in third.study.trials:
        lines = (tmp_path / f"trial-{trial.number:04d}" / "progress.jsonl").read_text().splitlines()
        assert json.loads(lines[-1])["episode/reward"] == trial.value
    with pytest.raises(ValueError, match="begun with other settings"):
        Trials(small(tmp_path, parameters=("ppo.minibatches",)), QUIET)


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_a_stopped_trial_goes_on(with_checkpoint: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Stopped after the first trial's first update, a search comes to the same results as one that was not."""
    through = Trials(small(tmp_path / "through", stage="single"), QUIET)
    through.run()

    def stopped(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        return train(given, lambda update, means: watch(update, means) or update == 1)

    monkeypatch.setattr(search, "train", stopped)
    broken = Trials(small(tmp_path / "broken", stage="single"), QUIET)
    with pytest.raises(KeyboardInterrupt):
        broken.run()
    assert states(broken) == ["FAIL", "WAITING", "WAITING"]
    if not with_checkpoint:
        (tmp_path / "broken" / "trial-0000" / "checkpoints" / "last.pt").unlink()
    monkeypatch.setattr(search, "train", train)
    resumed = Trials(small(tmp_path / "broken", stage="single"), QUIET)
    resumed.run()
    assert states(resumed) == ["FAIL", "COMPLETE", "COMPLETE", "COMPLETE"]

    def values(trials: Trials) -> dict[int, tuple[float | None, dict[int, float]]]:
        done = [trial for trial in trials.study.trials if trial.state.name == "COMPLETE"]
        return {trial.params["ppo.epochs"]: (trial.value, trial.intermediate_values) for trial in done}

    assert values(resumed) == values(through)
    assert not (tmp_path / "broken" / "trial-0003").exists()


def test_trials_that_fall_behind_are_stopped_once_they_are_warm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewards, watched = {3: 1.0, 2: 0.5, 4: 2.0}, {}

    def played(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        for update in range(1, given.ppo.updates + 1):
            watched[given.ppo.epochs] = update
            if watch(update, {"episode/reward": rewards[given.ppo.epochs]}):
                break
        return Path(given.run)

    monkeypatch.setattr(search, "train", played)
    given = small(tmp_path, stage="single", warm_up=6, startup_trials=1, period=2)
    given = replace(given, settings=replace(given.settings, ppo=replace(given.settings.ppo, updates=10)))
    trials = Trials(given, QUIET)
    trials.run()
    assert watched == {3: 10, 2: 6, 4: 10}
    assert states(trials) == ["COMPLETE", "PRUNED", "COMPLETE"]
    assert trials.study.best_params == {"ppo.epochs": 4}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env NoSuch-v0", "no environment `NoSuch-v0`; there are "),
        ("--parameters ppo.gamma", "`ppo.gamma` is not searched for gru; there are ppo.epochs, "),
        ("--percentile 0", "--percentile is 0.0; give more than 0 and at most 100"),
        ("--run mine", "a search names its runs itself; give --folder"),
        ("--time-limit 3", "trials are compared at the same updates; drop --time-limit"),
        ("--ppo.epochs 0", "--ppo.epochs is 0; give 1 or more"),
    ],
)
def test_errors_are_one_line(
    arguments: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["endless-search", *arguments.split()])
    assert search.main() == 1
    error = capsys.readouterr().err
    assert error.startswith(f"endless-search: {message}")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_has_the_training_s_flags() -> None:
    given = parse(["--preset", "quick", "--agent", "trxl", "--ppo.updates", "7", "--trials", "3"])
    assert (given.trials, given.warm_up, given.percentile) == (3, 2000, 25.0)
    expected = PRESETS["quick"]
    assert given.settings == replace(expected, agent="trxl", ppo=replace(expected.ppo, updates=7))
