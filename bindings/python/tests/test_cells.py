"""What the package offers, for every kind of environment: features down, environments across.

A feature that an environment cannot have says why in one line when it is requested.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from support import same

import endless_gym

#: An environment of each suite and of each kind of observation and action space.
IDS = [
    "MortarMayhem-Grid-v0",
    "MortarMayhemB-v0",
    "popgym-RepeatPreviousEasy-v0",
    "popgym-AutoencodeEasy-v0",
    "popgym-CountRecallEasy-v0",
    "popgym-PositionOnlyPendulumEasy-v0",
    "popgym-BattleshipEasy-v0",
]


def row(batch: Any, number: int) -> Any:
    """One of the observations of a batch or an episode."""
    if isinstance(batch, dict):
        return {key: row(part, number) for key, part in batch.items()}
    return tuple(row(part, number) for part in batch) if isinstance(batch, tuple) else batch[number]


@pytest.mark.libraries
@pytest.mark.parametrize("id", IDS)
def test_data_sets_are_what_a_new_environment_plays(id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "data")
    for policy, root in (("expert", "data"), ("random", None)):
        recorded = endless_gym.record(id, 2, policy=policy, seed=3, root=root, max_steps=30)
        dataset = minari.load_dataset(recorded.dataset)
        env = dataset.recover_environment()
        assert (dataset.observation_space, dataset.action_space) == (env.observation_space, env.action_space)
        for number, episode in enumerate(dataset):
            observation, _ = env.reset(seed=3 + number)
            same(row(episode.observations, 0), observation)
            for step, action in enumerate(episode.actions):
                observation, reward, *_ = env.step(action)
                same([row(episode.observations, step + 1), episode.rewards[step]], [observation, reward])
