"""The ruler and the leaderboard: the scores of experts, POPGym's observations, and runs of small tables."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents_helpers import assert_equal_runs, changed
from gymnasium.spaces import flatten

from endless_gym import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.environments import wrappers
from endless_gym_agents.evaluation import conformance, enjoy, ruler
from endless_gym_agents.evaluation.evaluate import evaluate
from endless_gym_agents.evaluation.ruler import TASKS
from endless_gym_agents.paper import leaderboard, reproduce
from endless_gym_agents.paper.experiments.definitions import settings_of
from endless_gym_agents.paper.track import MEMORYLESS, Entry, read_track, trials
from endless_gym_agents.paper.track_page import compared, page
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training import train as training


@pytest.mark.parametrize("name", ["one-command", "path", "repeat-first", "count-recall"])
def test_experts_and_random_actions_have_the_scores_of_the_ruler(name: str) -> None:
    task = TASKS[name]
    assert round(ruler.mean_return(task, expert=True), 4) == task.expert
    assert round(ruler.mean_return(task, expert=False), 4) == task.random
    assert task.passes_gate(task.random)
    assert not task.passes_gate(task.expert)


def test_a_longer_version_fits_the_agents_of_its_task() -> None:
    for task in TASKS.values():
        if task.longer is not None:
            env, options = task.longer
            given = settings_of(task.env, {"preset": "quick", "environment.observation": "features", **task.flags()})
            other = replace(given, env=env, environment=replace(given.environment, option=options)).validated()
            made, longer = (make_agent(each, spec(each.env)) for each in (given.validated(), other))
            assert (made.observation_shapes, made.branches) == (longer.observation_shapes, longer.branches), task.name
            assert other.options() != given.options() or env != task.env


@pytest.mark.parametrize("name", ["two-commands", "count-recall", "labyrinth"])
def test_a_twin_shows_the_state(name: str, tmp_path: Path) -> None:
    env, flags = TASKS[name].twin() or ("", {})
    small = {"ppo.updates": 1, "ppo.steps": 8, "environment.num-envs": 2, "ppo.minibatches": 1}
    given = settings_of(env, {"preset": "quick", **flags, **small})
    settings = replace(given, run=str(tmp_path), device="cpu").validated()
    training.train(settings)
    assert list(evaluate(checkpoint.load(tmp_path).agent, [200_000], 1, num_threads=1))
    if env == TASKS[name].env:
        with wrappers.make(settings, 2, 1, seed=3) as envs:
            observation, info = envs.reset()
            space, states = envs.unwrapped.single_state_space, spec(env).states(info["state"])
            first = tuple(part[0] for part in states) if isinstance(states, tuple) else states[0]
            assert np.array_equal(observation[0], flatten(space, first))
    else:
        assert env == "MortarMayhemB-Grid-v0"


@pytest.mark.parametrize("name", ["million", "full"])
def test_the_agents_of_a_size_have_as_many_parameters_as_that_of_the_gru(name: str) -> None:
    track = read_track(name)
    assert set(track.tasks) <= TASKS.keys()
    for size in track.sizes:
        counts = {}
        for entry, _ in track.sized([one for one in track.agents.values() if not one.observable], [size]):
            task, flags = track.run(TASKS["three-commands"], entry, "-" if entry.agent in MEMORYLESS else size)
            given = settings_of(task.env, flags).validated()
            with torch.device("meta"):
                counts[given.agent] = make_agent(given, spec(given.env), "meta").num_parameters
        for agent in counts.keys() - set(MEMORYLESS):
            assert counts[agent] == pytest.approx(counts["gru"], rel=0.05), (size, agent)


def test_agents_of_popgym_resume_exactly_and_are_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = settings_of("popgym-CountRecallEasy-v0?num_decks=2", {"preset": "quick", **TASKS["count-recall"].flags()})
    given = changed(
        given, agent="lru", threads=1, environment={"num_envs": 4, "num_threads": 1}, recurrence={"hidden_size": 16}
    )
    given = changed(given, ppo={"updates": 4, "steps": 30, "minibatches": 1})
    whole = training.train(replace(given, run=str(tmp_path / "whole")))
    part = training.train(replace(given, run=str(tmp_path / "part")), lambda update, _: update == 2)
    training.train(replace(given, resume=str(part)))
    assert_equal_runs(part, whole)
    film = tmp_path / "film.webp"
    enjoy.execute(enjoy.EnjoyArguments(whole, max_steps=3, out=film))
    assert "in 3 steps" in capsys.readouterr().out and film.read_bytes()[8:12] == b"WEBP"
    with pytest.raises(
        ValueError, match=r"got MultiDiscrete\(.*by --environment.wrapper endless_gym_agents.popgym:Vec"
    ):
        make_agent(changed(given, environment={"wrapper": ()}), spec(given.env))


def mean_row(agent: str, task: str, seed: int, score: float) -> dict[str, Any]:
    base = {"size": "-", "parameters": 1, "acting": 1, "learning": 1, "state_bytes": 1, "core_seconds": 60, "steps": 10}
    return {"agent": agent, "task": task, "seed": seed, "score": score, "longer": score / 2} | base


def test_the_page_has_scores_gates_and_longer_versions() -> None:
    track = replace(read_track("million"), tasks={name: TASKS[name] for name in ("one-command", "repeat-first")})
    rows = [
        mean_row(agent, task, seed, score)
        for agent, scores in {"none": (0.02, -0.5), "gru": (0.1, 1.0)}.items()
        for task, score in zip(track.tasks, scores, strict=True)
        for seed in (1, 2)
    ]

    def made_of(rows: list[dict[str, Any]], is_tuned: bool = True) -> str:
        tuning = {"gru -": {"trials": [{}]}} if is_tuned else {}
        return page(track, rows, compared(track, rows, Path("rows")), tuning)

    made = made_of(rows)
    assert "| `gru` | 2 | 1.00 [1.00, 1.00] | 0.00 [0.00, 0.00] | 1.00 | 1.00 |" in made
    assert "| `none` | 2 | 0.00 [0.00, 0.00] | 1.00 [1.00, 1.00] | 0.00 | 0.00 |" in made
    assert "| repeat-first | object | 1 | -0.500 | passed |" in made
    assert "| `gru` | 0.10 → 0.05 | 1.00 → 0.50 |" in made
    assert "Which memory" not in made
    assert "| `gru` 1.00 [1.00, 1.00], `none` 0.00 [0.00, 0.00]; no rows of `gated-deltanet`, `mamba2` |" in made
    # Five runs show that the GRU is better with commands, but not that another is with cards; the cheapest of two is named.
    scores = {"none": ((0.0, 0.0), (0.0, 0.0)), "gru": ((0.1, 0.1), (0.5, 0.1)), "lru": ((0.05, 0.05), (0.1, 0.4))}
    fives = [
        mean_row(agent, task, seed, both[seed % 2]) | {"core_seconds": 20 if agent == "lru" else 60}
        for agent, of_tasks in scores.items()
        for task, both in zip(track.tasks, of_tasks, strict=True)
        for seed in range(5)
    ]
    told = made_of(fives)
    assert "| one-command | object | `gru` 1.00 |  | `gru` 60 |" in told
    assert "| repeat-first | object | `gru` 0.34 | `lru` | `lru` 20 |" in told
    assert "Which memory" not in made_of(fives, is_tuned=False)
    # An agent with holes has no mean, and a task without zero is left out.
    assert "| `gru` | 1-2 | incomplete |  | 1.00 | 1.00 |" in made_of(rows[:-1])
    assert (
        "repeat-first |"
        not in made_of([row for row in rows if row["agent"] == "gru" or row["task"] == "one-command"]).split(
            "Mean returns"
        )[0]
    )
    with pytest.raises(ValueError, match="needs the runs of `none` in a task, or a `zero`"):
        made_of([row for row in rows if row["agent"] == "gru"])


TRACK: dict[str, Any] = {
    "about": "Two tasks.",
    "tasks": [
        "one-command",
        {"name": "two", "env": "MortarMayhem-Grid-v0", "options": ["command_count=[2]"], "zero": 0.0},
    ],
    "agents": ["none", {"name": "gru-wide", "agent": "gru", "flags": {"recurrence.hidden-size": 32}}],
    "seeds": [1],
    "flags": {
        "preset": "quick",
        "environment.num-envs": 4,
        "ppo.steps": 32,
        "ppo.updates": 1,
        "recurrence.hidden-size": 16,
    },
    "evaluation": {"seeds": 2, "repetitions": 1},
}
TUNING: dict[str, Any] = {
    "task": "late-command",
    "trials": 3,
    "space": {"ppo.learning-rate": [1e-3, 3e-4], "ppo.entropy-coefficient": [1e-3, 1e-4]},
    "of": {"other": {"recurrence.layers": [1, 2]}},
    "own": {"lru": {"agent-option": [[], ["r_min=0.9"]]}},
}


def written(folder: Path, **changes: Any) -> Path:
    file = folder / "mine.json"
    file.write_text(json.dumps(TRACK | changes))
    return file


def test_another_command_in_the_same_folder_does_not_change_what_is_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track, out = read_track(str(written(tmp_path))), tmp_path / "out"
    monkeypatch.setattr(reproduce, "execute", lambda _: next(out.glob("*.runs.json")).write_text("{}"))
    runs = {"one": track.run(TASKS["one-command"], track.agents["none"], "-")}
    assert leaderboard.trained(track, "runs", runs, [1], leaderboard.LeaderboardArguments("", out=out)) == ([], None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"seed": [1]},
            "track mine: `seed` is unknown, missing or empty; allowed: about, tasks, agents, seeds, flags, task-flags",
        ),
        ({"agents": []}, "track mine: `agents` is unknown, missing or empty"),
        ({"tasks": ["nope"]}, "track mine: a task must be an object, or one of one-command, .*; got `nope`"),
        ({"tasks": [{"env": "Nope-v0"}]}, "track mine, task Nope-v0: id must be one of "),
        (
            {"tasks": [{"id": "x"}]},
            "track mine, tasks: must be a name, or an object with `env` and some of name, options, zero",
        ),
        ({"agents": [{"name": "a/b"}]}, "a name has letters, digits and any of `_.:=+-`, got `a/b`"),
    ],
)
def test_mistakes_in_a_track_are_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=re.escape(message).replace(r"\.\*", ".*")):
        read_track(str(written(tmp_path, **changes)))


def test_all_agents_are_tuned_with_the_same_common_choices(tmp_path: Path) -> None:
    track = read_track(str(written(tmp_path, agents=["none", "gru", "lru"], tuning=TUNING)))
    assert track.tasks["two"].expert == pytest.approx(0.2)  # played by the environment's expert
    found = {name: trials(track, entry) for name, entry in track.agents.items()}
    common = ("ppo.learning-rate", "ppo.entropy-coefficient")
    assert [len(one) for one in found.values()] == [3, 3, 3]
    for one in found.values():
        assert [tuple(one[0][name] for name in common)] == [(1e-3, 1e-3)]
        assert len({json.dumps(trial) for trial in one}) == 3
    assert set(found["none"][0]) == set(common) and set(found["lru"][0]) == {
        *common,
        "recurrence.layers",
        "agent-option",
    }
    assert found["lru"][0]["agent-option"] == []
    # A memory of your own has choices of its own, and no more trials than there are choices.
    mine = Entry("mine", {"agent": "mine.py:Mine"})
    assert "agent-option" in trials(track, mine, {"agent-option": [["a=1"], ["a=2"]]})[0]
    small = replace(track, tuning=TUNING | {"trials": 99})
    assert len(trials(small, track.agents["none"])) == 4


@pytest.mark.usefixtures("in_process")
def test_a_track_of_your_own_is_tuned_resumed_and_extended(
    tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    file = written(tmp_path, tuning=TUNING | {"trials": 2})

    def run(*arguments: str) -> dict[str, Any]:
        given = [file, "--jobs", 2, "--device", "cpu", "--out", tmp_path / "out"]
        assert call(leaderboard.main, *given, *arguments) == 0, capsys.readouterr().err
        return dict(json.loads((tmp_path / "out/mine/results.json").read_text()))

    data = run()
    rows = {(row["agent"], row["task"], row["seed"]): row for row in data["rows"]}
    assert set(rows) == {(agent, task, 1) for agent in ("none", "gru-wide") for task in ("one-command", "two")}
    trials = data["tuning"]["gru-wide -"]["trials"]
    assert len(trials) == 2 and data["tuning"]["gru-wide -"]["task"] == "late-command"
    best = max(trials, key=lambda trial: trial["score"])
    assert data["tuning"]["gru-wide -"]["best"] == trials.index(best)
    given = checkpoint.read_settings(tmp_path / "out/runs/MortarMayhem-Grid-v0/two gru-wide -/seed-1")
    assert (given.ppo.learning_rate, given.recurrence.layers) == (
        best["flags"]["ppo.learning-rate"],
        best["flags"]["recurrence.layers"],
    )
    assert (given.recurrence.hidden_size, given.options()) == (32, {"command_count": [2]})
    assert rows["gru-wide", "two", 1]["tuning_core_seconds"] == pytest.approx(
        sum(trial["core_seconds"] for trial in trials)
    )
    page = (tmp_path / "out/mine/README.md").read_text()
    assert "Each agent was tuned with up to 2 configurations on a task outside of the table." in page
    assert "core-seconds of tuning" in page and "128 steps; 0 becomes 0, and 0.2 becomes 1." in page
    assert (tmp_path / "out/mine/comparison.pdf").read_bytes().startswith(b"%PDF")
    # The same again trains nothing; another agent is tuned and added.
    capsys.readouterr()
    assert run() == data
    assert "started" not in capsys.readouterr().out
    more = run("--agents", "mingru", "--tasks", "one-command")
    assert len(more["rows"]) == 5 and set(more["tuning"]) == {"none -", "gru-wide -", "mingru -"}
    # A task of the table is none to tune on.
    written(tmp_path, tuning=TUNING | {"task": "one-command"})
    with pytest.raises(ValueError, match="agents must be tuned on a task outside of the table, got one-command"):
        leaderboard.execute(leaderboard.LeaderboardArguments(str(file), out=tmp_path / "other"))


@pytest.mark.usefixtures("in_process")
def test_a_track_has_the_gap_to_fully_observable_twins(tmp_path: Path) -> None:
    wide = TRACK["agents"][1]
    agents = ["none", wide, wide | {"name": "twin", "observable": True}]
    # Agents of the twins are tuned on a twin, too, whose longer version they cannot observe.
    tuning = {"task": "two-commands", "trials": 1, "space": {"ppo.learning-rate": [1e-3]}}
    file = written(tmp_path, agents=agents, tasks=["one-command"], tuning=tuning)
    leaderboard.execute(leaderboard.LeaderboardArguments(str(file), device="cpu", jobs=1, out=tmp_path / "out"))
    assert (tmp_path / "out/runs/MortarMayhemB-Grid-v0/one-command twin -/seed-1").is_dir()
    rows = json.loads((tmp_path / "out/mine/results.json").read_text())["rows"]
    score = {row["agent"]: row["score"] for row in rows}
    gap = (score["twin"] - score["gru-wide"]) / (0.1 - score["none"])
    page = (tmp_path / "out/mine/README.md").read_text()
    assert "gap of `gru-wide` |" in page and f"| {gap:.2f} |" in page


@pytest.mark.usefixtures("in_process")
def test_an_agent_enters_a_track_of_the_package(tmp_path: Path, call: Callable[..., int]) -> None:
    """In a smaller version, which has other budgets than the package's rows; the best agents are exported."""
    best, folder = tmp_path / "best", tmp_path / "out/scale-2e-05/million"
    given = f"million --seeds 1 --scale tiny --device cpu --out {tmp_path / 'out'} --best {best}"
    given += " --agents mingru none --tasks three-commands repeat-first-12"
    assert call(leaderboard.main, *given.split()) == 0
    rows = json.loads((folder / "results.json").read_text())["rows"]
    assert [(row["agent"], row["task"], row["steps"] > 0) for row in rows] == [
        (agent, task, True) for agent in ("mingru", "none") for task in ("repeat-first-12", "three-commands")
    ]
    for row in rows:
        assert row["longer"] is not None and (row["state_bytes"] > 0) == (row["agent"] == "mingru")
    page = (folder / "README.md").read_text()
    assert "| `mingru` | 1 |" in page and "| three-commands | sequential | 0.3 |" in page
    # The best agent of a task, of those that the page plays; the page has no POPGym.
    assert [file.name for file in best.iterdir()] == ["three-commands.safetensors"]
    scores = {row["agent"]: row["score"] for row in rows if row["task"] == "three-commands"}
    exported = checkpoint.load(best / "three-commands.safetensors").agent
    assert scores[exported.settings.agent] == max(scores.values())


def test_the_rows_of_the_package_have_equal_budgets() -> None:
    track = read_track("million")
    comparison = compared(track, track.rows["rows"], Path("million"))
    assert {"none", "gru"} <= set(comparison.aggregates) <= track.agents.keys()


@pytest.mark.usefixtures("in_process")
def test_the_page_from_idea_to_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., int]) -> None:
    """With one update, and without the environment that the page builds."""
    text = (Path(__file__).parents[2] / "docs/train/from-idea-to-table.md").read_text()
    monkeypatch.chdir(tmp_path)
    (memory,) = re.findall(r"```python\n(.*?)```", text, re.S)
    Path("decay.py").write_text(memory)
    assert all(result.passed for result in conformance.check("decay.py:Decay", steps=100, long=300))
    (study,) = re.findall(r"<<'EOF'\n(.*?)EOF\n", text, re.S)
    track = json.loads(study)
    track["tasks"] = [task for task in track["tasks"] if isinstance(task, str)]
    assert len(track["tasks"]) == 1
    Path("study.json").write_text(json.dumps(track))
    given = "study.json --scale tiny --agents none decay-fixed --seeds 1 2 --device cpu"
    assert call(leaderboard.main, *given.split()) == 0
    listed = re.findall(r"^\| ((?:`[\w.]+`(?:, )?)+) \|", text.split("## The table")[1].split("## Tuning")[0], re.M)
    named = {name for cell in listed for name in re.findall(r"`([\w.]+)`", cell)}
    assert {file.name for file in Path("leaderboard/scale-2e-05/study").iterdir()} == named
    # The part of a track about tuning is one, too.
    (tuning,) = re.findall(r"```text\n(.*?)```", text, re.S)
    Path("tuned.json").write_text(json.dumps(track | json.loads(f"{{{tuning}}}")))
    tuned = read_track("tuned.json")
    assert [len(trials(tuned, entry)) for entry in tuned.agents.values()] == [6, 8, 8, 8]
