"""The evaluation protocol: metrics from known infos, and results of checkpoints."""

import io
import json
import shutil
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from agents_helpers import changed, saved, settings
from rich.console import Console

import endless_gym_agents
from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.common import tables
from endless_gym_agents.evaluation import protocol
from endless_gym_agents.evaluation.evaluate import evaluate
from endless_gym_agents.evaluation.protocol import EvalArguments, evaluate_runs, find
from endless_gym_agents.evaluation.results import Experiment, Experiments, Run, label, read, to_json
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import parse, train

GRID = "MortarMayhem-Grid-v0"

#: Path lengths of the evaluation seeds, from the best rewards of the published episodes of the paper.
PATHS = [8, 9, 9, 12, 9, 10, 8, 7, 12, 9, 10, 10, 10, 10, 11, 9, 9, 8, 9, 10, 8, 9, 8, 9, 8]
PATHS += [12, 7, 9, 11, 7, 11, 12, 9, 9, 8, 10, 11, 7, 10, 9, 6, 6, 10, 7, 9, 10, 11, 11, 7, 11]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs of one experiment and one of another, with two checkpoints each."""
    folder = tmp_path_factory.mktemp("runs")
    for name, agent, seed in (("a", "gru", 1), ("b", "gru", 2), ("c", "none", 1)):
        given = settings(agent, env=GRID, seed=seed, run=str(folder / name), checkpoint_interval=1, threads=1)
        environment = {"num_envs": 4, "option": ("command_count=[2]",)}
        ppo = {"steps": 8, "minibatches": 1, "updates": 2}
        train(changed(given, environment=environment, ppo=ppo, keep_checkpoints=True))
    return folder


def small(*paths: Path, **changes: object) -> EvalArguments:
    return replace(EvalArguments(paths), seeds=5, threads=1, engine_threads=1, **changes)


def test_task_progress_uses_the_path_length_of_each_seed() -> None:
    """An untrained agent reaches one or two tiles; each is a fraction of the path of its seed."""
    agent = settings("none", env="MysteryPath-v0", environment={"option": ("max_steps=60",)})
    results = evaluate(make_agent(agent, spec("MysteryPath-v0")), range(200_000, 200_010), 2, num_threads=1)
    for result in results:
        path = PATHS[int(result["seed"]) - 200_000]
        assert result["task_progress"] == pytest.approx(round(result["reward"] / 0.1) / path)
    assert any(result["task_progress"] > 0 for result in results)


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("--agent gru", "gru"),
        ("--agent gru --recurrence.hidden-size 384", "gru_384"),
        ("--agent gru --ppo.reconstruction-coefficient 0.1", "gru_rec"),
        ("--agent retnet --recurrence.hidden-size 64", "retnet_64"),
        ("--agent lstm", "lstm"),
        ("--agent none", "ppo"),
        ("--agent stack --model.stack 16", "16stack"),
        ("--agent position", "pos_enc"),
        ("--agent gtrxl --transformer.gate-bias 2 --ppo.reconstruction-coefficient 0.1", "gtrxl_b2_rec"),
        ("--agent gtrxl", "gtrxl_b0"),
        ("--agent trxl --transformer.query-encoding", "trxl_qpos"),
        ("--agent trxl --ppo.ground-truth-coefficient 0.1", "trxl_gt"),
        ("--agent trxl --transformer.positional-encoding learned", "trxl_learned"),
        ("--agent trxl --transformer.query-previous", "trxl_qprev"),
        ("--agent gru --transformer.query-previous", "gru"),
    ],
)
def test_labels_match_the_published_results(flags: str, expected: str) -> None:
    assert label(parse(flags.split())) == expected
    published = json.loads((Path(endless_gym_agents.__file__).parent / "evaluation/published.json").read_text())
    names = {name for curves in published["curves"].values() for name in curves}
    assert expected.replace("_learned", "_lr_learned") in names | {"trxl_qprev", "retnet_64"}


def test_runs_and_checkpoints_are_found(runs: Path) -> None:
    assert [run.name for run, _ in find((runs,), False)] == ["a", "b", "c"]
    assert [file.name for _, files in find((runs / "a",), False) for file in files] == [
        "update-000000.pt",
        "update-000001.pt",
        "update-000002.pt",
    ]
    assert find((runs / "a" / "checkpoints",), True) == [(runs / "a", [runs / "a" / "checkpoints" / "last.pt"])]
    file = runs / "b" / "checkpoints" / "update-000001.pt"
    assert find((file,), False) == [(runs / "b", [file])]


def test_evaluation_plays_each_seed_equally_often_and_is_reproducible(runs: Path) -> None:
    quiet = Console(quiet=True)
    once = evaluate_runs(small(runs), quiet)
    assert [(one.label, len(one.runs), one.common_steps()) for one in once] == [
        ("gru_16", 2, [0, 32, 64]),
        ("ppo", 1, [0, 32, 64]),
    ]
    for run in once[0].runs:
        for episodes in run.episodes:
            assert Counter(episode["seed"] for episode in episodes) == dict.fromkeys(range(200_000, 200_005), 3)
    again = evaluate_runs(small(runs), quiet)
    assert to_json(again, {}, True) == to_json(once, {}, True)
    other = evaluate_runs(small(runs, action_seed=1), quiet)
    assert to_json(other, {}, True) != to_json(once, {}, True)


def test_the_last_checkpoints_of_runs_that_stop_when_learnt_are_compared(
    tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    for seed, steps in ((1, 32), (2, 64)):
        for name, stops in (("learnt", True), ("interrupted", False)):
            given = settings("gru", env=GRID, seed=seed, stop_when_learnt=stops, environment={"num_envs": 4})
            saved(tmp_path / name / str(seed), given, steps=steps)
    file = tmp_path / "all.json"
    for name, status in (("learnt", 0), ("interrupted", 1)):
        assert call(protocol.main, tmp_path / name, "--last", "--seeds", 2, "--json", file) == status
        printed = capsys.readouterr()
        assert ("no checkpoints at a common number of steps" in printed.err) is bool(status)
    (summary,) = json.loads(file.read_text())["experiments"][0]["summary"]
    assert summary["over"] == "2 runs that stopped from 32 steps on"
    (found,) = read(file)
    assert found.common_steps() == [64] and found.scores("reward").shape == (2, 1)
    assert [run.steps for run in found.runs] == [[32], [64]]


def test_a_foreign_run_does_not_prevent_the_evaluation_of_others(
    runs: Path, tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(runs, tmp_path / "runs")
    foreign = tmp_path / "runs" / "b" / "checkpoints" / "last.pt"
    foreign.write_text("of another library\n")
    assert call(protocol.main, tmp_path / "runs", "--last", "--seeds", 2, "--json", tmp_path / "all.json") == 1
    output = capsys.readouterr()
    assert output.err.startswith(f"endless-eval: the others are evaluated; {foreign} is not a checkpoint"), output.err
    assert "gru_16" in output.out and "none (ppo in the paper)" in output.out and "95 % of mean" in output.out
    written = json.loads((tmp_path / "all.json").read_text())
    assert [len(experiment["runs"]) for experiment in written["experiments"]] == [1, 1]


def test_progress_callback_counts_every_episode(runs: Path) -> None:
    counts: list[int] = []
    agent = checkpoint.load(runs / "a").agent
    evaluate(agent, range(200_000, 200_004), 2, num_threads=1, ended=counts.append)
    assert sum(counts) == 8
    assert min(counts) > 0


def test_settings_that_do_not_affect_learning_share_an_experiment() -> None:
    given, experiments = settings("gru", env=GRID, seed=1), Experiments()
    apart = {"seed": 2, "run": "b", "preset": "paper", "device": "cuda", "threads": 3, "bind_cores": True, "view": True}
    apart |= {"on_engine_failure": "fail", "time_limit": 1.0, "wandb": True}
    for name, value in apart.items():
        assert getattr(given, name) != value
        assert experiments.of(replace(given, **{name: value})) is experiments.of(given), name
    threads = changed(given, environment={"engine": "process", "num_threads": 7})
    assert experiments.of(threads) is experiments.of(given)
    for other in (replace(given, bf16=True), replace(given, agent="lstm"), replace(given, env="MortarMayhem-v0")):
        assert experiments.of(other) is not experiments.of(given)


def test_results_round_trip_through_json(runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file, start = tmp_path / "results.json", time.monotonic()
    protocol.execute(small(runs, json=str(file), episodes=True))
    table = capsys.readouterr().out
    written = json.loads(file.read_text())
    assert 0 < written.pop("seconds") < time.monotonic() - start
    assert written["protocol"] == {
        "first_seed": 200_000,
        "seeds": 5,
        "repetitions": 3,
        "action_seed": 0,
        "greedy": False,
    }
    gru, none = written["experiments"]
    means = []
    for run in gru["runs"]:
        scores = [episode["reward"] / 0.2 for episode in run["episodes"][-1]]
        means.append(sum(scores) / 15)
        assert run["metrics"]["task_progress"][-1] == pytest.approx(means[-1])
    last = gru["summary"][-1]
    assert (last["steps"], last["over"], last["mean"]) == (64, "2 runs", pytest.approx(sum(means) / 2))
    assert last["std"] == pytest.approx(abs(means[0] - means[1]) / 2)
    assert f"{last['mean']:.4f}" in table
    assert none["summary"][-1]["over"] == "15 episodes"
    assert to_json(read(file), written["protocol"], True) == written


def test_the_table_says_which_metric_to_trust() -> None:
    """An agent that executes no command, which the original reports as a success."""
    episodes = [{"reward": 0.0, "success": 1.0, "commands_completed": 1.0, "task_progress": 0.39, "seed": 1.0}] * 3

    def printed(env: str) -> str:
        run = Run("run", 1)
        run.add(64, episodes)
        console = Console(width=100, record=True, file=io.StringIO())
        tables.show(protocol.table(Experiment(env, "gru", {}, [run])), console)
        return " ".join(console.export_text().split())

    table = printed(GRID)
    assert "64 success * 1.0000" in table and "64 commands_completed * 1.0000" in table
    assert "64 task_progress 0.3900" in table
    assert "Trust task_progress. * as the original reports it: a last command that failed counts as executed" in table
    del episodes[0]["commands_completed"]
    for env in ("MysteryPath-v0", "SearingSpotlights-v0"):
        assert "*" not in printed(env) and "Trust" not in printed(env)
