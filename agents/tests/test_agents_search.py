"""The hyperparameter search: search space, order of the trials, pruning, and resumption."""

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from agents_helpers import changed, settings
from rich.console import Console

from endless_gym_agents.paper import jobs, search
from endless_gym_agents.paper.search import parse
from endless_gym_agents.paper.search_space import single_changes, space, with_choices
from endless_gym_agents.paper.search_study import SearchArguments, Trials
from endless_gym_agents.settings import PRESETS, Settings, value

QUIET = Console(quiet=True)


def small(folder: Path, **changes: Any) -> SearchArguments:
    environment, ppo = {"num_envs": 4, "option": ("command_count=[1]",)}, {"steps": 16, "minibatches": 1, "updates": 3}
    given = {"env": "MortarMayhem-Grid-v0", "threads": 1, "checkpoint_interval": 100}
    start = settings("gru", environment=environment, ppo=ppo, **given)
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
    lru = space(replace(PRESETS["paper"], agent="lru"))
    assert lru == {name: choices for name, choices in gru.items() if name not in ("agent", "recurrence.residual")}
    # The table has 8 common parameters with 16 alternatives, 4 with 5 for recurrence, and 5 with 10 for the Transformer-XL.
    assert (len(gru), len(single_changes(gru))) == (12, 1 + 16 + 5)
    assert (len(trxl), len(single_changes(trxl))) == (13, 1 + 16 + 10)
    rebuilt = changed(PRESETS["paper"], ppo={"reconstruction_coefficient": 0.1})
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
    assert [len(names) for names in different] == [1] * (sum(map(len, choices.values())) - len(choices))
    assert len(changes) == 2 + 3 + 1
    lstm = with_choices(base, {"agent": "lstm", "ppo.epochs": 4})
    assert (value(lstm, "agent"), lstm.ppo.epochs, lstm.ppo.gamma) == ("lstm", 4, base.ppo.gamma)


def test_search_from_start_to_end(tmp_path: Path) -> None:
    """Single changes, then a combination; restarting a complete search runs no trial."""
    first = Trials(small(tmp_path, stage="single"), QUIET)
    search.run_trials(first)
    assert [trial.params["ppo.epochs"] for trial in first.study.trials] == [3, 2, 4]
    second = Trials(small(tmp_path), QUIET)
    search.run_trials(second)
    assert states(second) == ["COMPLETE"] * 4
    third = Trials(small(tmp_path), QUIET)
    search.run_trials(third)
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


def test_a_trial_that_diverges_fails_and_the_search_continues(tmp_path: Path) -> None:
    arguments = small(tmp_path, stage="single", parameters=("ppo.learning_rate",))
    trials = Trials(replace(arguments, settings=changed(arguments.settings, ppo={"learning_rate": 1e20})), QUIET)
    for _ in range(2):
        trial = trials.begin()
        assert trial is not None
        search.run_trial(trial)
    ended = {trial.params["ppo.learning_rate"]: trial.state.name for trial in trials.study.trials if trial.params}
    assert ended == {1e20: "FAIL", 2.75e-4: "COMPLETE"}


def test_the_best_settings_are_replaced_atomically(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reader that has the old file open can read all of it."""

    def played(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> None:
        watch(given.ppo.updates, {"episode/reward": float(given.ppo.epochs)})

    monkeypatch.setattr(search, "train", played)
    trials = Trials(small(tmp_path, stage="single"), QUIET)
    first = trials.begin()
    assert first is not None
    search.run_trial(first)
    trials.report()
    with (tmp_path / "best.json").open() as old:
        search.run_trials(trials)
        trials.report()
        assert json.loads(old.read())["reward"] == 3.0
    assert json.loads((tmp_path / "best.json").read_text())["reward"] == 4.0
    assert {file.name for file in tmp_path.iterdir()} == {"best.json", "locks", "study.journal"}


def test_no_trial_is_begun_after_the_time_limit(tmp_path: Path) -> None:
    trials = Trials(small(tmp_path, stage="single", minutes=1e-9), QUIET)
    search.run_trials(trials)
    assert states(trials) == ["WAITING"] * 3
    assert Trials(small(tmp_path, stage="single"), QUIET).remaining() == (0, 3)


@pytest.mark.parametrize(
    ("changes", "updates"),
    [
        ({"warm_up": 6, "startup_trials": 1}, {3: 10, 2: 6, 4: 10}),
        # ASHA keeps the best of the trials that have reached an update, from the first trial on.
        ({"warm_up": 2, "pruner": "asha"}, {3: 10, 2: 2, 4: 10}),
        ({"warm_up": 2, "pruner": "none"}, {3: 10, 2: 10, 4: 10}),
    ],
)
def test_trials_that_fall_behind_are_pruned(
    changes: dict[str, Any], updates: dict[int, int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewards, watched = {3: 1.0, 2: 0.5, 4: 2.0}, {}

    def played(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> None:
        for update in range(1, given.ppo.updates + 1):
            watched[given.ppo.epochs] = update
            if watch(update, {"episode/reward": rewards[given.ppo.epochs]}):
                break

    monkeypatch.setattr(search, "train", played)
    given = small(tmp_path, stage="single", period=2, **changes)
    given = replace(given, settings=changed(given.settings, ppo={"updates": 10}))
    trials = Trials(given, QUIET)
    search.run_trials(trials)
    assert watched == updates
    assert states(trials) == ["COMPLETE", "PRUNED" if updates[2] < 10 else "COMPLETE", "COMPLETE"]
    assert trials.study.best_params == {"ppo.epochs": 4}


def test_a_new_worker_has_the_rest_of_the_time(tmp_path: Path) -> None:
    given = small(tmp_path, stage="single", workers=2, minutes=5.0)
    trials = Trials(replace(given, settings=replace(given.settings, threads=3)), QUIET)
    worker = search.Worker(trials, ("--workers", "2", "--minutes", "5"), 0)
    trials.end -= 60
    (command,) = worker.commands(jobs.Machine(2, job_cores=7))
    parsed = parse(command[1:])
    assert 3.9 < parsed.minutes < 4
    assert (parsed.workers, parsed.folder, parsed.ray) == (0, str(tmp_path), "")
    # The threads of the machine, where the settings choose none.
    assert (parsed.settings.threads, parsed.settings.environment.num_threads) == (0, 7)
    trials.end = time.monotonic()
    assert worker.commands(jobs.Machine(2)) == []


def test_a_part_of_a_line_in_the_journal_is_cut_off(tmp_path: Path) -> None:
    """As of a process that was killed, or of a full disk."""
    trials = Trials(small(tmp_path, stage="single"), QUIET)
    journal = tmp_path / "study.journal"
    before = journal.read_bytes()
    journal.write_bytes(before + before.splitlines()[-1][:20])
    trial = Trials(small(tmp_path, stage="single"), QUIET).begin()
    assert trial is not None
    trial.reward = 1.0
    trial.complete()
    assert journal.read_bytes().startswith(before)
    assert states(trials) == ["COMPLETE", "WAITING", "WAITING"]


def test_a_trial_that_its_process_did_not_end_is_resumed(tmp_path: Path) -> None:
    """It keeps its number and its choices, after those that have not begun. One that ran out of GPU memory is never resumed."""
    arguments = small(tmp_path, trials=2, stage="combinations")
    trials = Trials(arguments, QUIET)
    first, second = trials.begin(), trials.begin()
    assert first is not None
    assert second is not None
    assert trials.begin() is None
    assert Trials(arguments, QUIET).begin() is None
    first.observe(1, 5.0)
    first.interrupt()
    second.fail("ran out of GPU memory")
    other = Trials(arguments, QUIET)
    assert other.remaining() == (0, 1)
    resumed = other.begin()
    assert resumed is not None
    assert (resumed.number, resumed.settings, resumed.reported) == (first.number, first.settings, 1)
    assert other.begin() is None
    resumed.observe(1, 6.0)
    resumed.observe(2, 7.0)
    resumed.complete()
    assert states(trials) == ["COMPLETE", "FAIL"]
    assert trials.study.trials[0].intermediate_values == {1: 5.0, 2: 7.0}
    assert [file.name for file in (tmp_path / "locks").iterdir()] == ["study"]


def test_command_line_includes_the_training_flags() -> None:
    given = parse(["--preset", "quick", "--agent", "trxl", "--ppo.updates", "7", "--trials", "3"])
    assert (given.trials, given.warm_up, given.percentile) == (3, 2000, 25.0)
    assert [parse(line.split()).ray for line in ("", "--ray", "--ray --trials 3", "--ray auto")] == [
        "",
        "local",
        "local",
        "auto",
    ]
    assert given.settings == changed(PRESETS["quick"], agent="trxl", ppo={"updates": 7})
