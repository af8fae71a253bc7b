"""When a task counts as learnt, and the runs that stop then."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from agents_helpers import settings

import endless_gym
from endless_gym import spec
from endless_gym.specs import Learnt
from endless_gym_agents.training.logs import learnt
from endless_gym_agents.training.train import train

GRID = "MortarMayhem-Grid-v0"


@pytest.mark.parametrize(
    ("id", "means", "is_learnt"),
    [
        (GRID, {"task_progress": 0.89, "success": 1.0}, False),
        (GRID, {"task_progress": 0.91, "success": 0.0}, True),
        ("MysteryPath-v0", {"reward": 9.0, "success": 0.89}, False),
        ("MysteryPath-v0", {"reward": 0.1, "success": 0.91}, True),
        ("Endless-MortarMayhem-v0", {"reward": 100.0, "success": 1.0}, False),
        (GRID, {}, False),
    ],
)
def test_task_is_learnt_at_nine_tenths_of_its_best_result(id: str, means: dict[str, float], is_learnt: bool) -> None:
    given = {f"episode/{name}": value for name, value in means.items()}
    assert (learnt(spec(id), given) is not None) is is_learnt


@pytest.mark.parametrize(
    ("changes", "stops"), [({}, True), ({"stop_when_learnt": False}, False), ({"target_reward": 9.0}, False)]
)
def test_run_stops_with_a_message_when_the_task_is_learnt(
    changes: dict[str, object],
    stops: bool,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ppo = {"steps": 32, "minibatches": 1, "updates": 25}
    # So that an untrained agent, which executes one command of four, reaches it.
    easy = replace(spec(GRID), learnt=Learnt("task_progress", 0.05))
    monkeypatch.setitem(endless_gym.all_specs(), GRID, easy)
    environment = {"num_envs": 8, "option": ("command_count=[1]",)}
    given = settings(
        "none", env=GRID, run=str(tmp_path / "run"), threads=1, environment=environment, ppo=ppo, **changes
    )
    run = train(given)
    updates = len((run / "progress.jsonl").read_text().splitlines())
    output = " ".join(capsys.readouterr().out.split())
    assert ("the task is learnt: the last episodes have a mean task_progress of 0." in output) is stops
    assert (updates < 25) is stops
    assert json.loads((run / "settings.json").read_text())["stop_when_learnt"] is given.stop_when_learnt
