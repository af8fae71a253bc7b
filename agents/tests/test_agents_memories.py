"""The memories of the literature as agents: their sizes, and the programs with them."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from agents_helpers import changed, settings

from endless_gym import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.evaluation import enjoy, export, plot, probe, protocol
from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.paper import search
from endless_gym_agents.settings import PRESETS, Settings
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training import train as training
from endless_gym_agents.training.logs import read_progress

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


def test_the_programs_take_a_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)

    def run(main: Callable[[], int], *arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["program", *arguments])
        return main()

    small = ["--preset", "quick", "--threads", "1", "--environment.num-threads", "1", "--environment.num-envs", "4"]
    small += ["--ppo.steps", "32", "--recurrence.hidden-size", "64", "--recurrence.sequence-length", "16"]
    env = ["--env", "Endless-MysteryPath-v0", "--agent", "retnet"]
    assert run(training.main, *env, *small, "--recurrence.match-gru", "--ppo.updates", "2", "--run", "runs/one") == 0
    assert run(training.main, "--resume", "runs/one", "--ppo.updates", "4") == 0
    assert [row["update"] for row in read_progress(Path("runs/one"))] == [1, 2, 3, 4]
    assert run(protocol.main, "runs", "--seeds", "2", "--repetitions", "1", "--json", "results.json") == 0
    assert "retnet_64" in capsys.readouterr().out
    assert run(plot.main, "results.json", "--out", "plots") == 0
    assert list(Path("plots").glob("*.png"))
    assert run(enjoy.main, "runs/one", "--seeds", "200000", "--max-steps", "4", "--out", "episode.webp") == 0
    capsys.readouterr()
    assert run(probe.main, "runs/one", "--episodes", "5", "--max-steps", "10", "--json") == 0
    assert json.loads(capsys.readouterr().out)
    searched = ["--folder", "study", "--trials", "1", "--parameters", "recurrence.layers"]
    assert run(search.main, *searched, *env, *small, "--ppo.updates", "1") == 0
    assert run(export.main, "runs/one", "--out", "agent.safetensors") == 0
    assert checkpoint.load(Path("agent.safetensors")).agent.settings.agent == "retnet"
