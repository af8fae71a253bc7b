"""The hyperparameter search: search space, order of the trials, pruning, and resumption."""

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from agents_helpers import settings
from rich.console import Console

from endless_gym.agents import search
from endless_gym.agents.search import SearchArguments, Trials, parse
from endless_gym.agents.search_space import single_changes, space, value, with_choices
from endless_gym.agents.settings import PRESETS, Settings
from endless_gym.agents.train import train

pytestmark = pytest.mark.slow

QUIET = Console(quiet=True)


def small(folder: Path, **changes: Any) -> SearchArguments:
    given = settings("gru", env="MortarMayhem-Grid-v0", threads=1, checkpoint_interval=100)
    environment = replace(given.environment, num_envs=4, option=("command_count=[1]",))
    ppo = replace(given.ppo, steps=16, minibatches=1, updates=3)
    start = replace(given, environment=environment, ppo=ppo)
    return replace(
        SearchArguments(str(folder), parameters=("ppo.epochs",), trials=1, period=1, settings=start), **changes
    )


def states(trials: Trials) -> list[str]:
    return [trial.state.name for trial in trials.study.trials]


def test_search_space_is_the_table_of_the_paper() -> None:
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
    # Every single change gives valid settings.
    for agent, choices in (("gru", gru), ("trxl", trxl)):
        for change in single_changes(choices):
            with_choices(replace(PRESETS["paper"], agent=agent), change).validated()


def test_single_changes_differ_in_one_parameter() -> None:
    base = PRESETS["quick"]
    choices = space(base, ("ppo.epochs", "ppo.max-gradient-norm", "agent"))
    start, *changes = single_changes(choices)
    assert with_choices(base, start) == base
    different = [[name for name in change if change[name] != start[name]] for change in changes]
    assert all(len(names) == 1 for names in different)
    assert len(changes) == 2 + 3 + 1
    lstm = with_choices(base, {"agent": "lstm", "ppo.epochs": 4})
    assert (value(lstm, "agent"), lstm.ppo.epochs, lstm.ppo.gamma) == ("lstm", 4, base.ppo.gamma)


def test_search_from_start_to_end(tmp_path: Path) -> None:
    """Single changes, then a combination; restarting a complete search runs no trial."""
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
    # The value of a trial is the last mean reward of its run.
    for trial in third.study.trials:
        lines = (tmp_path / f"trial-{trial.number:04d}" / "progress.jsonl").read_text().splitlines()
        assert json.loads(lines[-1])["episode/reward"] == trial.value
    with pytest.raises(ValueError, match="started with other settings"):
        Trials(small(tmp_path, parameters=("ppo.minibatches",)), QUIET)


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_interrupted_trial_resumes(with_checkpoint: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that is interrupted after the first update has the results of an uninterrupted search."""
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


def test_trials_are_pruned_after_the_warm_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        ("--env NoSuch-v0", "id must be one of .*, got 'NoSuch-v0'"),
        ("--parameters ppo.gamma", "--parameters for gru must be among ppo.epochs, "),
        ("--percentile 0", "--percentile must be greater than 0 and at most 100, got 0.0"),
        ("--run mine", "--run and --resume are not supported: the search names its runs; use --folder"),
        ("--time-limit 3", "--time-limit and --target-reward are not supported: "),
        ("--ppo.epochs 0", "--ppo.epochs must be 1 or more, got 0"),
        ("--trials -1", "--trials must be 0 or more, got -1"),
        ("--period 0", "--period must be 1 or more, got 0"),
    ],
)
def test_errors_are_one_line(
    arguments: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["endless-search", *arguments.split()])
    assert search.main() == 1
    error = capsys.readouterr().err
    assert re.match(f"endless-search: {message}", error)
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_command_line_includes_the_training_flags() -> None:
    given = parse(["--preset", "quick", "--agent", "trxl", "--ppo.updates", "7", "--trials", "3"])
    assert (given.trials, given.warm_up, given.percentile) == (3, 2000, 25.0)
    expected = PRESETS["quick"]
    assert given.settings == replace(expected, agent="trxl", ppo=replace(expected.ppo, updates=7))
