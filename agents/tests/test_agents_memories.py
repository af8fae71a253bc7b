"""The sizes of agents with the memories of the literature."""

import pytest
from agents_helpers import changed, settings

from endless_gym import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.settings import PRESETS, Settings

ID = "MortarMayhem-Grid-v0"


def parameters(given: Settings) -> int:
    return make_agent(given, spec(given.env)).num_parameters


@pytest.mark.parametrize("hidden_size", [64, 128])
def test_agents_have_as_many_parameters_as_that_of_the_gru(hidden_size: int) -> None:
    base = changed(PRESETS["quick"], env=ID, recurrence={"hidden_size": hidden_size})
    wanted = parameters(base)
    for name in ("lstm", *MEMORIES):
        matched = changed(base, agent=name, recurrence={"hidden_size": hidden_size, "match_gru": True}).validated()
        assert parameters(matched) == pytest.approx(wanted, rel=0.05), name
    assert parameters(changed(base, agent="mingru")) < 0.7 * wanted


def test_other_agents_cannot_be_matched() -> None:
    with pytest.raises(ValueError, match=r"--recurrence\.match-gru is for recurrent memories, got --agent none"):
        changed(PRESETS["quick"], agent="none", recurrence={"match_gru": True}).validated()
    with pytest.raises(ValueError, match=r"mingru has .* the agent gru with 4 has .*; choose a larger"):
        make_agent(settings("mingru", env=ID, recurrence={"hidden_size": 4, "match_gru": True}), spec(ID))
