"""What the agents' programs offer, for every kind of environment: programs down, environments across."""

import sys
from pathlib import Path

import pytest

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.evaluation import enjoy
from endless_gym_agents.settings import ONE_HOT, VECTORS, Settings, from_dict, to_dict
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import parse, train

#: The entries of the observations, and those of earlier runs of `endless learn`.
ENTRIES = {
    "popgym-RepeatPreviousEasy-v0": (4 + 4 + 2, 4),
    "popgym-AutoencodeEasy-v0": (2 + 4 + 4 + 2, 2 + 4),
    "popgym-CountRecallEasy-v0": (2 + 2 + 27 + 2, 2 + 2),
    "popgym-BattleshipEasy-v0": (2 + 8 + 8 + 2, 2),
    "popgym-BattleshipEasy-v0?board_size=9": (2 + 9 + 9 + 2, 2),
    "popgym-PositionOnlyCartPoleEasy-v0": (2, 2),
}


@pytest.mark.parametrize("id", ENTRIES)
def test_integers_become_vectors_without_a_flag(id: str) -> None:
    wanted = Settings(env=id).validated()
    given = to_dict(Settings(env=id))
    # Earlier versions of `endless learn` wrote no wrapper.
    del given["environment"]["wrapper"]
    of_rust = from_dict(given)
    is_box = "CartPole" in id
    assert (wanted.environment.wrapper, of_rust.environment.wrapper) == (
        ((), ()) if is_box else ((VECTORS,), (ONE_HOT,))
    )
    assert from_dict(to_dict(wanted)) == wanted
    shapes = [make_agent(settings, spec(id)).observation_shapes for settings in (wanted, of_rust)]
    assert shapes == [{"features": (entries,)} for entries in ENTRIES[id]]


def test_a_run_in_an_environment_of_integers_resumes_and_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    small = "--environment.num-envs 2 --ppo.steps 4 --ppo.minibatches 1 --recurrence.hidden-size 8 --ppo.updates 2"
    run = train(parse(f"--env popgym-AutoencodeEasy-v0?num_decks=2 --preset quick {small} --run {tmp_path / 'run'}".split()))
    train(parse(f"--resume {run} --ppo.updates 3".split()))
    assert checkpoint.load(run).update == 3
    film = tmp_path / "film.webp"
    monkeypatch.setattr(sys, "argv", ["endless-enjoy", str(run), "--max-steps", "3", "--out", str(film)])
    assert enjoy.main() == 0
    assert "in 3 steps" in capsys.readouterr().out and film.read_bytes()[8:12] == b"WEBP"
