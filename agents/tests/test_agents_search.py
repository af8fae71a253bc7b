"""The hyperparameter search: search space, order of the trials, pruning, and resumption."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
from agents_helpers import changed, settings
from rich.console import Console

from endless_gym_agents import checkpoint, search, search_ray, search_workers
from endless_gym_agents.logs import read_progress
from endless_gym_agents.search import parse
from endless_gym_agents.search_space import single_changes, space, with_choices
from endless_gym_agents.search_study import SearchArguments, Trials
from endless_gym_agents.settings import PRESETS, Settings, value
from endless_gym_agents.train import train

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


def values(trials: Trials) -> dict[int, tuple[float | None, dict[int, float]]]:
    """Final and intermediate rewards of the complete trials, by their number of epochs."""
    done = [trial for trial in trials.study.trials if trial.state.name == "COMPLETE"]
    return {trial.params["ppo.epochs"]: (trial.value, trial.intermediate_values) for trial in done}


def test_search_space_is_the_table_of_the_paper() -> None:
    gru, trxl = (space(replace(PRESETS["paper"], agent=agent)) for agent in ("gru", "trxl"))
    assert gru["ppo.learning_rate"] == (2.75e-4, 2.0e-4, 3.0e-4, 3.5e-4)
    assert gru["recurrence.hidden_size"] == (512, 256, 384)
    assert trxl["transformer.initialisation"] == ("xavier", "orthogonal", "kaiming", "tfixup")
    assert "transformer.layers" not in gru
    assert "recurrence.layers" not in trxl
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


@pytest.mark.slow
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
        search.run_trial(trial, trial.settings)
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
    search.run_trial(first, first.settings)
    trials.report()
    with (tmp_path / "best.json").open() as old:
        search.run_trials(trials)
        trials.report()
        assert json.loads(old.read())["reward"] == 3.0
    assert json.loads((tmp_path / "best.json").read_text())["reward"] == 4.0
    assert {file.name for file in tmp_path.iterdir()} == {"best.json", "locks", "study.db"}


def test_no_trial_is_begun_after_the_time_limit(tmp_path: Path) -> None:
    trials = Trials(small(tmp_path, stage="single", minutes=1e-9), QUIET)
    search.run_trials(trials)
    assert states(trials) == []
    assert Trials(small(tmp_path, stage="single"), QUIET).remaining() == (0, 3)


def test_a_failed_trial_is_resumed_only_by_the_next_call(tmp_path: Path) -> None:
    """Ray reports a trial that failed too often; one that ran out of memory is never resumed."""
    first = search_ray._Study(Trials(small(tmp_path, trials=2, stage="combinations"), QUIET))
    configuration = first.begin("a")
    assert configuration is not None
    run = configuration["settings"]["run"]
    first.end("a", is_error=True)
    assert first.begin("b") is not None
    first._ended["b"] = "ran out of GPU memory"
    first.end("b", is_error=False)
    # The failed trial counts as one of the combinations.
    assert first.begin("c") is None
    assert first.failed == [0]

    trials = Trials(small(tmp_path, trials=2, stage="combinations"), QUIET)
    assert trials.remaining() == (0, 1)
    second = search_ray._Study(trials)
    resumed = second.begin("d")
    assert resumed is not None
    assert resumed["settings"]["run"] == run
    second.observe("d", {"update": 3, "reward": 1.0, "end": "done"})
    second.end("d", is_error=False)
    assert second.begin("e") is None
    assert states(trials) == ["FAIL", "FAIL", "COMPLETE"]


@pytest.mark.slow
@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_interrupted_trial_resumes(with_checkpoint: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that is interrupted after the first update has the same results as an uninterrupted search."""
    through = Trials(small(tmp_path / "through", stage="single"), QUIET)
    search.run_trials(through)

    def stopped(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        return train(given, lambda update, means: watch(update, means) or update == 1)

    monkeypatch.setattr(search, "train", stopped)
    broken = Trials(small(tmp_path / "broken", stage="single"), QUIET)
    with pytest.raises(KeyboardInterrupt):
        search.run_trials(broken)
    assert states(broken) == ["FAIL", "WAITING", "WAITING"]
    if not with_checkpoint:
        (tmp_path / "broken" / "trial-0000" / "checkpoints" / "last.pt").unlink()
    monkeypatch.setattr(search, "train", train)
    resumed = Trials(small(tmp_path / "broken", stage="single"), QUIET)
    search.run_trials(resumed)
    assert states(resumed) == ["FAIL", "COMPLETE", "COMPLETE", "COMPLETE"]

    assert values(resumed) == values(through)
    assert not (tmp_path / "broken" / "trial-0003").exists()


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


def killed_once(trials: Trials, threads: int | None) -> None:
    """Work of a worker: the first two trials wait for each other, then the process of the first one is killed, once."""
    folder = trials.folder

    def trained(given: Settings, watch: Callable[[int, dict[str, float]], bool]) -> Path:
        def watched(update: int, means: dict[str, float]) -> bool:
            stops = watch(update, means)
            if update == 3:
                (folder / f"met-{Path(given.run).name}").touch()
                while len(list(folder.glob("met-*"))) < 2:
                    time.sleep(0.01)
                if given.run.endswith("trial-0000") and not (folder / "killed").exists():
                    shutil.copy(Path(given.run) / "progress.jsonl", folder / "killed")
                    os.kill(os.getpid(), signal.SIGKILL)
            return stops

        return train(given, watched)

    search.train = trained
    search.run_trials(trials, threads)


@pytest.mark.slow
def test_workers_resume_only_the_trial_of_a_killed_worker(tmp_path: Path) -> None:
    def given(name: str) -> SearchArguments:
        given = small(tmp_path / name, stage="single", workers=2)
        return replace(given, settings=changed(given.settings, ppo={"updates": 4}, checkpoint_interval=1))

    through = Trials(given("through"), QUIET)
    search.run_trials(through)
    shared = Trials(given("shared"), QUIET)
    search_workers.run_workers(shared, killed_once)
    assert states(shared) == ["FAIL", "COMPLETE", "COMPLETE", "COMPLETE"]
    assert [file.name for file in (tmp_path / "shared/locks").iterdir()] == ["study"]

    assert values(shared) == values(through)
    # The rows up to the checkpoint are those of the killed process, with its times.
    before = (tmp_path / "shared/killed").read_text().splitlines()
    rows = (tmp_path / "shared/trial-0000/progress.jsonl").read_text().splitlines()
    assert [json.loads(row)["update"] for row in rows] == [1, 2, 3, 4]
    assert len(before) == 3
    assert (rows[:2], rows[2] == before[2]) == (before[:2], False)
    assert "resumed" not in (tmp_path / "shared/trial-0001.log").read_text()


def killed_and_replaced(trials: Trials, threads: int | None) -> None:
    """Work of a worker that is killed, once."""
    with (trials.folder / "ends").open("a") as ends:
        print(repr(trials.end), file=ends)
    if len((trials.folder / "ends").read_text().splitlines()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
def test_a_replaced_worker_keeps_the_time_limit_of_the_search(tmp_path: Path) -> None:
    trials = Trials(small(tmp_path, stage="single", workers=1, minutes=5.0), QUIET)
    search_workers.run_workers(trials, killed_and_replaced)
    assert (tmp_path / "ends").read_text() == f"{trials.end!r}\n" * 2


@pytest.mark.slow
def test_a_worker_is_not_replaced_after_the_time_limit(tmp_path: Path) -> None:
    trials = Trials(small(tmp_path, stage="single", workers=1, minutes=5.0), QUIET)
    trials.end = time.monotonic()
    with pytest.raises(ValueError, match="1 of 1 workers failed; repeat the command"):
        search_workers.run_workers(trials, killed_and_replaced)
    assert len((tmp_path / "ends").read_text().splitlines()) == 1


def test_the_log_of_a_trial_says_why_it_failed(tmp_path: Path) -> None:
    given = settings("gru", run=str(tmp_path / "trial-0000"))
    with pytest.raises(RuntimeError), search_workers.output_of(given):
        print("before")
        raise RuntimeError("the cause")
    first, *_, last = (tmp_path / "trial-0000.log").read_text().splitlines()
    assert (first, last) == ("before", "RuntimeError: the cause")


def interrupted_or_late(trials: Trials, threads: int | None) -> None:
    """Work of a worker that only a signal ends in time."""
    time.sleep(30)
    (trials.folder / "late").touch()


@pytest.mark.slow
def test_a_signal_while_workers_are_started_stops_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process = multiprocessing.get_context("spawn").Process
    start, started = process.start, []

    def interrupting(self: Any) -> None:
        start(self)
        started.append(self.name)
        os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(process, "start", interrupting)
    with pytest.raises(KeyboardInterrupt):
        search_workers.run_workers(Trials(small(tmp_path, stage="single", workers=2), QUIET), interrupted_or_late)
    assert started == ["endless-search-0"]
    assert not (tmp_path / "late").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_workers_stop_with_their_search(number: signal.Signals, tmp_path: Path) -> None:
    """Even if the search is killed, the workers stop after their update, with checkpoints, as if interrupted."""
    command = [sys.executable, "-m", "endless_gym_agents.search", "--preset", "quick", "--folder", str(tmp_path)]
    sizes = ["--environment.num-envs", "4", "--ppo.steps", "16", "--ppo.minibatches", "1", "--ppo.updates", "100000"]
    choice = ["--env", "MortarMayhem-Grid-v0", "--parameters", "ppo.epochs", "--stage", "single", "--workers", "2"]
    with subprocess.Popen([*command, *sizes, *choice], stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as started:
        try:
            runs = [tmp_path / f"trial-000{number}" for number in (0, 1)]
            while not all((run / "progress.jsonl").exists() and read_progress(run) for run in runs):
                assert started.poll() is None, started.communicate()[0]
                time.sleep(0.05)
            workers = [
                child for child in psutil.Process(started.pid).children() if "spawn_main" in " ".join(child.cmdline())
            ]
            assert len(workers) == 2
            started.send_signal(number)
            assert started.wait(60) == (130 if number == signal.SIGINT else -number)
            assert not psutil.wait_procs(workers, timeout=60)[1]
        finally:
            started.kill()  # its workers stop with it
    for run in runs:
        assert checkpoint.load(run).update == read_progress(run)[-1]["update"]
    given = parse([*command[3:], *sizes, *choice])
    left = Trials(given, QUIET)
    assert states(left) == ["FAIL", "FAIL", "WAITING"]
    assert left.remaining() == (0, 3)


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
