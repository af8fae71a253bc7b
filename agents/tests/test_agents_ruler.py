"""The ruler and the leaderboard's program: the scores of experts, POPGym's observations, and runs of a small table."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from agents_helpers import changed

from endless_gym import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.evaluation import ruler
from endless_gym_agents.evaluation.ruler import TASKS
from endless_gym_agents.paper.experiments.definitions import settings_of
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training import train as training

PROGRAM = Path(__file__).parents[1] / "benches" / "leaderboard.py"


@pytest.fixture(scope="module")
def leaderboard() -> ModuleType:
    described = importlib.util.spec_from_file_location("leaderboard", PROGRAM)
    assert described is not None
    assert described.loader is not None
    module = importlib.util.module_from_spec(described)
    described.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["one-command", "path", "repeat-first", "count-recall"])
def test_experts_and_random_actions_have_the_scores_of_the_ruler(name: str) -> None:
    task = TASKS[name]
    assert round(ruler.mean_return(task, expert=True), 4) == task.expert
    assert round(ruler.mean_return(task, expert=False), 4) == task.random
    assert task.passes_gate(task.random)
    assert not task.passes_gate(task.expert)
    assert task.normalised(task.expert, task.random) == 1.0
    assert task.normalised(task.random, task.random) == 0.0


def test_a_longer_version_fits_the_agents_of_its_task() -> None:
    for task in TASKS.values():
        if task.longer is not None:
            env, options = task.longer
            given = settings_of(task.env, {"preset": "quick", "environment.observation": "features", **task.flags()})
            other = replace(given, env=env, environment=replace(given.environment, option=options)).validated()
            made, longer = (make_agent(each, spec(each.env)) for each in (given.validated(), other))
            assert (made.observation_shapes, made.branches) == (longer.observation_shapes, longer.branches), task.name
            assert other.options() != given.options() or env != task.env


@pytest.mark.parametrize("name", ["laptop", "full"])
def test_the_agents_of_a_size_have_as_many_parameters_as_that_of_the_gru(name: str, leaderboard: ModuleType) -> None:
    track = leaderboard.read(name)
    assert len([agent for agent in track["agents"] if agent not in leaderboard.MEMORYLESS]) >= 12
    assert set(track["tasks"]) <= TASKS.keys()
    for size in track["sizes"]:
        written = leaderboard.experiment(track, ["three-commands"], track["agents"], [size])
        counts = {}
        for run in written["runs"]:
            given = settings_of(run["env"], run["flags"]).validated()
            with torch.device("meta"):
                counts[given.agent] = make_agent(given, spec(given.env), "meta").num_parameters
        for agent in counts.keys() - set(leaderboard.MEMORYLESS):
            assert counts[agent] == pytest.approx(counts["gru"], rel=0.05), (size, agent)


def test_agents_of_popgym_resume_exactly(tmp_path: Path) -> None:
    given = settings_of("popgym-CountRecallEasy-v0", {"preset": "quick", **TASKS["count-recall"].flags()})
    given = changed(
        given, agent="lru", threads=1, environment={"num_envs": 4, "num_threads": 1}, recurrence={"hidden_size": 16}
    )
    given = changed(given, ppo={"updates": 4, "steps": 30, "minibatches": 1})
    whole = checkpoint.load(training.train(replace(given, run=str(tmp_path / "whole"))))
    part = training.train(replace(given, run=str(tmp_path / "part")), lambda update, _: update == 2)
    resumed = checkpoint.load(training.train(replace(given, resume=str(part))))
    # Two ranks of cards, the previous action, and whether the step is the first.
    assert whole.agent.observation_shapes == {"features": (2 + 2 + 27 + 2,)}
    for name, tensor in whole.agent.state_dict().items():
        assert torch.equal(tensor, resumed.agent.state_dict()[name]), name
    with pytest.raises(
        ValueError, match=r"got MultiDiscrete\(.*by --environment.wrapper endless_gym_agents.popgym:Vec"
    ):
        make_agent(changed(given, environment={"wrapper": ()}), spec(given.env))


@pytest.mark.slow
def test_the_program_fills_the_table_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leaderboard: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*arguments: str) -> list[dict[str, Any]]:
        results = tmp_path / "laptop.results.json"
        given = ["laptop", "--seeds", "1", "--scale", "tiny", "--jobs", "2", "--device", "cpu"]
        given += ["--out", str(tmp_path / "runs"), "--results", str(results)]
        monkeypatch.setattr(sys, "argv", ["leaderboard.py", *given, *arguments])
        leaderboard.main()
        return list(json.loads(results.read_text())["rows"])

    rows = run("--agents", "none", "mingru", "--tasks", "one-command", "repeat-first")
    assert [(row["agent"], row["task"]) for row in rows] == [
        (agent, task) for agent in ("mingru", "none") for task in ("one-command", "repeat-first")
    ]
    for row in rows:
        assert row["longer"] is not None
        assert row["steps"] > 0
        assert (row["state_bytes"] > 0) == (row["agent"] == "mingru")
    # The same again trains nothing, and other agents add rows.
    capsys.readouterr()
    assert run("--agents", "none", "mingru", "--tasks", "one-command", "repeat-first") == rows
    assert "started" not in capsys.readouterr().out
    assert len(run("--agents", "ffm", "--tasks", "one-command")) == 5
    page = (tmp_path / "laptop.md").read_text()
    assert "| `ffm` | gru |" in page
    assert "| one-command | object | 0.1 |" in page
    # The best agent of a task, of those that the page plays; the page has no POPGym.
    best = tmp_path / "best"
    run("--agents", "none", "mingru", "ffm", "--tasks", "one-command", "repeat-first", "--table", "--best", str(best))
    assert [file.name for file in best.iterdir()] == ["one-command.safetensors"]
    scores = {row["agent"]: row["score"] for row in rows if row["task"] == "one-command"}
    exported = checkpoint.load(best / "one-command.safetensors").agent
    assert scores[exported.settings.agent] == max(scores.values())


def test_the_interquartile_mean_is_that_of_normalised_scores(leaderboard: ModuleType) -> None:
    track = {"name": "t", "about": "-", "tasks": ["one-command", "repeat-first"]}
    base = {"parameters": 1, "acting": 1, "learning": 1, "state_bytes": 1}
    rows = [
        {"agent": agent, "size": "-", "task": task, "seed": seed, "score": score, "longer": score / 2, **base}
        for agent, scores in {"none": (0.02, -0.5), "gru": (0.1, 1.0)}.items()
        for task, score in zip(track["tasks"], scores, strict=True)
        for seed in (1, 2)
    ]
    page = leaderboard.table(track, rows)
    assert "| `gru` | - | 1.00 | 1.00 to 1.00 | 1.00 | 1.00 |" in page
    assert "| `none` | - | 0.00 | 0.00 to 0.00 | 0.00 | 0.00 |" in page
    assert "| repeat-first | object | 1 | -0.500 | passed |" in page
    assert "| `gru` | - | 0.10 → 0.05 | 1.00 → 0.50 |" in page
    # A table with holes has no mean.
    assert "| `gru` | - |  | incomplete | 1.00 |" in leaderboard.table(track, rows[:-1])
