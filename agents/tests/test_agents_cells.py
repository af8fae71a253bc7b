"""What the agents' programs offer, for every kind of environment: programs down, environments across."""

import pytest

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.settings import ONE_HOT, VECTORS, Settings, from_dict, to_dict

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
