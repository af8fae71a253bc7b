"""Data sets of a trained agent's episodes."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents_helpers import saved, settings

from endless_gym.recording import record
from endless_gym.specs import spec
from endless_gym_agents.evaluation import record as recording
from endless_gym_agents.evaluation.evaluate import evaluate
from endless_gym_agents.evaluation.record import AgentPlayer
from endless_gym_agents.settings import ONE_HOT, VECTORS

pytestmark = pytest.mark.skipif(sys.version_info < (3, 11), reason="Minari needs Python 3.11")

ID = "MysteryPath-Grid-v0"


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))
    return tmp_path / "datasets"


def make(agent: str, run: Path) -> Any:
    return saved(run, settings(agent, env=ID, environment={"option": ("max_steps=20",)}))


def load(dataset: str) -> Any:
    import minari

    return minari.load_dataset(dataset)


@pytest.mark.parametrize("agent", ["gru", "trxl", "stack"])
def test_recorded_episodes_equal_evaluated_ones(agent: str, tmp_path: Path) -> None:
    made = make(agent, tmp_path)
    recorded = record(
        ID,
        6,
        policy=AgentPlayer(made, greedy=True),
        options=made.settings.options(),
        observation="features",
        seed=200_000,
        num_threads=1,
    )
    assert recorded.dataset == f"endless-gym/{ID}/agent-v0"
    results = evaluate(made, range(200_000, 200_006), 1, greedy=True)
    episodes = list(load(recorded.dataset))
    assert [len(episode) for episode in episodes] == [result["length"] for result in results]
    assert [episode.rewards.sum() for episode in episodes] == pytest.approx([result["reward"] for result in results])


@pytest.mark.parametrize("wrapper", [VECTORS, ONE_HOT])
@pytest.mark.parametrize("id", ["popgym-RepeatPreviousEasy-v0", "popgym-AutoencodeEasy-v0"])
def test_integers_are_recorded_as_the_environment_returns_them(id: str, wrapper: str, tmp_path: Path) -> None:
    made = saved(tmp_path, settings("gru", env=id, environment={"wrapper": (wrapper,)}))
    recorded = record(id, 6, policy=AgentPlayer(made, greedy=True), seed=200_000, num_threads=1)
    dataset, results = load(recorded.dataset), evaluate(made, range(200_000, 200_006), 1, greedy=True)
    assert dataset.observation_space == spec(id).observation_space(None, True)
    assert [len(episode) for episode in dataset] == [result["length"] for result in results]
    assert [episode.rewards.sum() for episode in dataset] == pytest.approx([result["reward"] for result in results])


def test_agents_see_the_actions_that_were_played(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    id = "popgym-RepeatPreviousEasy-v0"
    made = saved(tmp_path, settings("gru", env=id, environment={"wrapper": (VECTORS,)}))
    seen: list[Any] = []
    act = made.act
    monkeypatch.setattr(
        made, "act", lambda observation, *given: (seen.append(observation), act(observation, *given))[1]
    )
    recorded = record(id, 1, policy=AgentPlayer(made), error_rates=0.5, num_threads=1)
    (episode,) = load(recorded.dataset)
    # Suit, previous action, and whether the step is the first.
    vectors = np.concatenate(seen)
    assert vectors[:, :4].argmax(1).tolist() == episode.observations[:-1].tolist()
    assert vectors[1:, 4:8].argmax(1).tolist() == episode.actions[:-1].tolist()
    assert vectors[:, 9].tolist() == [1.0] + [0.0] * (len(episode) - 1)


def test_sampled_actions_depend_only_on_the_seed(tmp_path: Path) -> None:
    made = make("gru", tmp_path)

    def actions(name: str, seed: int, threads: int) -> list[list[int]]:
        player = AgentPlayer(made, seed)
        given = {"policy": player, "observation": "features", "options": made.settings.options()}
        recorded = record(ID, 40, dataset=f"{name}-v0", num_threads=threads, **given)
        return [episode.actions.tolist() for episode in load(recorded.dataset)]

    first = actions("first", 1, 1)
    assert actions("second", 1, 2) == first
    assert actions("third", 2, 2) != first


def test_the_command_records_a_checkpoint(
    tmp_path: Path, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    make("gru", tmp_path / "run")
    assert call(recording.main, tmp_path / "run", "--episodes", 3, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    dataset = load(result["dataset"])
    assert len(dataset) == result["episodes"] == 3
    assert dataset.storage.metadata["algorithm_name"] == "PPO, agent gru"
    (metadata,) = dataset.storage.get_episode_metadata([0])
    assert metadata["options"] == {"max_steps": 20}
    assert np.isfinite(dataset[0].observations).all()
