"""The package's learning curves of the paper against all published evaluations."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from endless_gym_agents.evaluation.curves import _published

RESULTS = Path(__file__).parents[2] / "tests/reference/published_results.json.gz"

#: Environment, its name in the published results, the metric that the package keeps, and its suffix for the agents' names.
METRICS = [
    ("Endless-MortarMayhem-v0", "emm", "commands_completed", ""),
    ("Endless-MysteryPath-v0", "emp", "tiles_visited", ""),
    ("Endless-SearingSpotlights-v0", "ess", "coins_collected", ""),
    ("MortarMayhem-v0", "mm10", "reward", ""),
    ("MortarMayhem-Grid-v0", "mm_grid", "reward", ""),
    ("MortarMayhemB-Grid-v0", "mm_act_grid", "reward", ""),
    ("MysteryPath-Grid-v0", "mp_grid_off", "success", ""),
    ("MysteryPath-Grid-v0", "mp_grid_on", "success", "_cues"),
]


def results() -> dict[str, Any]:
    return dict(json.loads(gzip.decompress(RESULTS.read_bytes())))


@pytest.mark.parametrize(("env", "name", "metric", "suffix"), METRICS)
def test_published_curves_are_read_unchanged(env: str, name: str, metric: str, suffix: str) -> None:
    published = {
        key.removeprefix(f"{name}/").removesuffix("_2") + suffix: value["metrics"][metric]
        for key, value in results().items()
        if key.startswith(f"{name}/")
    }
    curves = _published()["curves"][env]
    assert published == {agent: curves[agent] for agent in curves if agent.endswith("_cues") == bool(suffix)}


def test_task_progress_of_mystery_path_fits_the_published_rewards() -> None:
    """A tile gives 0.1, the goal 1.0. The paths have 9.2 tiles on average; the shorter ones are finished more often."""
    published = results()
    curves = _published()["curves"]["MysteryPath-v0"]
    assert len(curves) == 7
    for agent, scores in curves.items():
        metrics = published[f"mp_off_dense/{agent}"]["metrics"]
        success, reward = np.array(metrics["success"]), np.array(metrics["reward"])
        tiles = (reward - success) / 0.1 + success
        assert np.abs(tiles / scores - 9.0).max() < 0.3, agent


def test_searing_spotlights_is_half_coins_and_half_success() -> None:
    published = results()
    curves = _published()["curves"]["SearingSpotlights-v0"]
    assert len(curves) == 11
    for agent, scores in curves.items():
        # Where an agent was evaluated twice, the figures of the paper show the runs with the suffix.
        key = next(key for key in (f"ss/{agent}_25", f"ss/{agent}") if key in published)
        coins, success = (np.array(published[key]["metrics"][name]) for name in ("coins_collected", "success"))
        # The package's scores have four decimals.
        assert np.abs((coins + success) / 2 - scores).max() < 5.01e-5, agent
