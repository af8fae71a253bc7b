"""Agents outside the package: the page of the documentation, followed to the letter."""

import re
import shlex
import sys
from pathlib import Path

import pytest
import torch
from agents_helpers import changed, collecting, settings

from endless_gym_agents import checkpoint, enjoy, protocol
from endless_gym_agents import train as training
from endless_gym_agents.clock import Clock
from endless_gym_agents.logs import read_progress
from endless_gym_agents.ppo import learn, make_optimizer
from endless_gym_agents.results import label
from endless_gym_agents.settings import PRESETS

PAGE = Path(__file__).parents[2] / "docs" / "train" / "own-agents.md"
PROGRAMS = {"endless-train": training.main, "endless-eval": protocol.main, "endless-enjoy": enjoy.main}


def blocks(language: str) -> str:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)[0]


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "min_gru.py").write_text(blocks("python"))
    return tmp_path / "min_gru.py"


def test_the_commands_of_the_page_work(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for line in blocks("sh").replace("\\\n", " ").splitlines():
        # Shorter than on the page, since a test needs only a few updates.
        arguments = shlex.split(line.replace("--time-limit 0.1", "--time-limit 0.001"))
        monkeypatch.setattr(sys, "argv", arguments)
        assert PROGRAMS[arguments[0]]() == 0, line
    assert "MinGRU_layers=2" in capsys.readouterr().out
    assert len(read_progress(Path("runs/mine"))) == 2
    assert Path("episode.gif").stat().st_size > 0
    given = checkpoint.read_settings("runs/mine")
    assert (given.agent, given.agent_option, label(given)) == (f"{file}:MinGRU", ("layers=2",), "MinGRU_layers=2")
    # From another folder.
    monkeypatch.chdir("/")
    assert checkpoint.load(file.parent / "runs/mine").agent.memory.width == 128


@pytest.mark.parametrize("embedding", [True, False])
def test_forward_equals_the_rollout_with_the_same_weights(embedding: bool, file: Path) -> None:
    given = settings(f"{file}:MinGRU", env="MortarMayhem-Grid-v0", agent_option=("layers=2",), threads=1)
    environment = {"num_envs": 8, "groups": 2, "option": ("command_count=[1, 2]",)}
    given = changed(given, environment=environment, ppo={"steps": 16, "minibatches": 2})
    given = changed(given, recurrence={"embedding": embedding, "sequence_length": 5})
    with collecting(given) as collector:
        made = collector.agent
        for _ in range(2):
            segment, _ = collector.collect(Clock())
            flat, states = segment.flat(), [memory.state for memory in collector.memories]
            for minibatch in made.memory.minibatches(states, segment.reset_mask, 2, torch.Generator().manual_seed(1)):
                output = made({key: part[minibatch.indices] for key, part in flat.observation.items()}, minibatch)
                log_prob = output.log_prob(flat.action[minibatch.indices])
                torch.testing.assert_close(log_prob, flat.log_prob[minibatch.indices], rtol=1e-5, atol=1e-5)
                torch.testing.assert_close(output.value, flat.value[minibatch.indices], rtol=1e-5, atol=1e-5)
            before = made.memory.cell.gates[1].weight.clone()
            learn(made, make_optimizer(made, 0.01), segment, states, 0, given.ppo, torch.Generator().manual_seed(1))
            assert not torch.equal(before, made.memory.cell.gates[1].weight)


@pytest.mark.parametrize(
    ("agent", "option", "message"),
    [
        ("grv", (), "--agent must be one of gru, .*, got `grv`; did you mean gru"),
        (
            "nowhere.py:MinGRU",
            (),
            "--agent must be module:Class or file.py:Class .*, got `nowhere.py:MinGRU`: no file nowhere.py",
        ),
        ("no_such_module:MinGRU", (), "got `no_such_module:MinGRU`: No module named"),
        ("min_gru.py:Other", (), "got `min_gru.py:Other`: .* has no attribute 'Other'"),
        ("os:system", (), "--agent must name a class derived from torch.nn.Module, got `os:system`"),
        ("min_gru.py:MinGRU", ("depth=2",), "MinGRU cannot be made of .* 'depth'"),
        ("min_gru.py:MinGRU", ("layers",), "--agent-option must be NAME=VALUE with a JSON value"),
        ("gru", ("layers=2",), "--agent-option needs an agent of your own, got --agent gru"),
    ],
)
def test_agents_that_cannot_be_made_are_refused(agent: str, option: tuple[str, ...], message: str, file: Path) -> None:
    given = changed(PRESETS["quick"], agent=agent, agent_option=option, env="MortarMayhem-Grid-v0", run="run")
    with pytest.raises(ValueError, match=message):
        training.train(given)
