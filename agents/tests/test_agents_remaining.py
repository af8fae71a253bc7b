"""The time that the runs of an experiment still take, before they have begun."""

import json
from pathlib import Path

import pytest
from agents_helpers import EXPERIMENT

from endless_gym_agents.experiments import definitions, planning
from endless_gym_agents.reproduce import ReproduceArguments, execute
from endless_gym_agents.settings import to_dict


def test_a_run_before_its_first_update_is_estimated_from_the_steps_per_second_of_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second run's updates have four times the environment steps."""
    flags = {"ppo.updates": 10, "environment.num-envs": 8, "ppo.steps": 64}
    runs = [
        {"name": "few", "env": "MortarMayhem-v0", "flags": flags},
        {"name": "many", "env": "MortarMayhem-v0", "flags": flags | {"environment.num-envs": 32}},
    ]
    file = tmp_path / "mine.json"
    file.write_text(json.dumps(EXPERIMENT | {"runs": runs, "seeds": 1}))
    given = ReproduceArguments((str(file),), status=True, out=tmp_path / "out", jobs=1)
    execute(given)
    lines = capsys.readouterr().out.splitlines()
    assert not any("left" in line for line in lines[:-1])
    assert "time unknown before the first update" in lines[-1]

    few, _ = planning.jobs(definitions.load(str(file)), tmp_path / "out", 1)
    few.folder.mkdir(parents=True)
    (few.folder / "settings.json").write_text(json.dumps(to_dict(few.run.settings())))
    rows = [{"update": update, "seconds/learning": 30.0} for update in range(1, 5)]
    (few.folder / "progress.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    execute(given)
    first, second, last = capsys.readouterr().out.splitlines()
    assert first.endswith("update 4 of 10, 3.0 minutes left")
    assert second.endswith("update 0 of 10, 20.0 minutes left, estimated from other runs")
    assert "the rest takes 23.0 minutes" in last
