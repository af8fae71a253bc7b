"""What the agents' programs offer, for every kind of environment: programs down, environments across."""

import pytest

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.settings import VECTORS, Settings, from_dict, to_dict

#: The entries of the observations.
ENTRIES = {
    "popgym-RepeatPreviousEasy-v0": 4 + 4 + 2,
    "popgym-AutoencodeEasy-v0": 2 + 4 + 4 + 2,
    "popgym-CountRecallEasy-v0": 2 + 2 + 27 + 2,
    "popgym-BattleshipEasy-v0": 2 + 8 + 8 + 2,
    "popgym-BattleshipEasy-v0?board_size=9": 2 + 9 + 9 + 2,
    "popgym-PositionOnlyCartPoleEasy-v0": 2,
}


@pytest.mark.parametrize("id", ENTRIES)
def test_integers_become_vectors_without_a_flag(id: str) -> None:
    settings = Settings(env=id).validated()
    assert settings.environment.wrapper == (() if "CartPole" in id else (VECTORS,))
    assert from_dict(to_dict(settings)) == settings
    assert make_agent(settings, spec(id)).observation_shapes == {"features": (ENTRIES[id],)}
