"""Memories, encoders and wrappers outside the package: the page of the documentation, followed to the letter."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from agents_helpers import assert_equal_runs, changed, collecting, saved, settings

from endless_gym_agents.common.clock import Clock
from endless_gym_agents.evaluation import enjoy, probe, protocol, record
from endless_gym_agents.evaluation.evaluate import evaluate
from endless_gym_agents.evaluation.results import label
from endless_gym_agents.settings import PRESETS
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training import train as training
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.ppo import learn, make_optimizer

PAGE = Path(__file__).parents[2] / "docs" / "train" / "own-agents.md"
PROGRAMS = {"endless-train": training.main, "endless-eval": protocol.main, "endless-enjoy": enjoy.main}


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.DOTALL)


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    names = re.findall(r"Save (?:it|this) as\s+`(\w+\.py)`", PAGE.read_text())
    for name, block in zip(names, blocks("python"), strict=True):
        (tmp_path / name).write_text(block)
    return tmp_path / "min_gru.py"


@pytest.mark.parametrize("number", range(3))
def test_the_commands_of_the_page_work(
    number: int,
    file: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert len(blocks("sh")) == 3
    for line in blocks("sh")[number].replace("\\\n", " ").splitlines():
        # Shorter than on the page, since a test needs only a few updates.
        program, *arguments = shlex.split(line.replace("--time-limit 0.1", "--time-limit 0.001"))
        assert call(PROGRAMS[program], *arguments) == 0, line
    (run,) = Path("runs").iterdir()
    given = checkpoint.read_settings(run)
    assert label(given) == ("MinGRU_layers=2", "gru_128_Impala_channels=[4, 8]", "gru_128_StepPenalty")[number]
    assert label(given) in capsys.readouterr().out
    assert len(read_progress(run)) == blocks("sh")[number].count("endless-train")
    assert number or Path("episode.webp").stat().st_size > 0
    own = (given.agent, given.encoder, *given.environment.wrapper)[number]
    assert own == str(file.parent / ("min_gru.py:MinGRU", "impala.py:Impala", "penalty.py:StepPenalty")[number])
    # From another folder.
    monkeypatch.chdir("/")
    assert checkpoint.load(file.parent / run).agent.memory.width == 128


def test_acting_with_an_own_encoder_equals_learning_with_it(file: Path) -> None:
    given = settings("gru", env="MortarMayhem-Grid-v0", encoder=str(file.parent / "impala.py:Impala"), threads=1)
    given = changed(given, encoder_option=("channels=[2]",), ppo={"steps": 8, "minibatches": 2})
    given = changed(given, environment={"num_envs": 2, "observation": "rgb"})
    with collecting(given) as collector:
        made = collector.agent
        segment, _ = collector.collect(Clock())
        flat, states = segment.flat(), [memory.state for memory in collector.memories]
        (minibatch,) = made.memory.minibatches(states, segment.reset_mask, 1, torch.Generator().manual_seed(1))
        output = made({key: part[minibatch.indices] for key, part in flat.observation.items()}, minibatch)
        torch.testing.assert_close(output.value, flat.value[minibatch.indices], rtol=1e-5, atol=1e-5)
        before = made.encoder.own.layers[0].weight.clone()
        learn(made, make_optimizer(made, 0.01), segment, states, 0, given.ppo, torch.Generator().manual_seed(1))
        assert not torch.equal(before, made.encoder.own.layers[0].weight)


OWN = '''
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import VectorRewardWrapper, VectorWrapper
from gymnasium.vector.utils import batch_space


class Counting(VectorWrapper):
    """The reward is the number of the episode's step, which is also an observation."""

    def __init__(self, env):
        super().__init__(env)
        self.steps = np.zeros(env.num_envs)
        self.single_observation_space = spaces.Dict(
            {"features": env.single_observation_space, "time": spaces.Box(-np.inf, np.inf, (1,), np.float32)}
        )
        self.observation_space = batch_space(self.single_observation_space, env.num_envs)

    def reset(self, **given):
        observation, info = self.env.reset(**given)
        self.steps = np.zeros(self.num_envs)
        return self.seen(observation), info

    def step(self, actions):
        observation, _, terminated, truncated, info = self.env.step(actions)
        reward = self.steps = self.steps + 1
        self.steps = np.where(terminated | truncated, 0, self.steps)
        return self.seen(observation), reward, terminated, truncated, info

    def seen(self, observation):
        return {"features": observation, "time": self.steps[:, None].astype(np.float32)}

    def state_dict(self):
        return {"steps": self.steps}

    def load_state_dict(self, state):
        self.steps = state["steps"]


class Forgetful(VectorRewardWrapper):
    calls = 0

    def rewards(self, rewards):
        self.calls += 1
        return rewards


class Short(VectorWrapper):
    @property
    def num_envs(self):
        return 1


class Argument(VectorWrapper):
    def __init__(self, env, scale):
        super().__init__(env)


class Wide(VectorWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.single_observation_space = spaces.Box(0, 1, (2, 2), np.float32)


class Flat(torch.nn.Module):
    def __init__(self, shapes):
        super().__init__()

    def forward(self, observation):
        return observation["features"].sum()


class Frames(Flat):
    def forward(self, observation):
        return observation["visual_observation"]
'''


@pytest.mark.parametrize(("engine", "groups"), [("thread", 2), ("process", 1)])
def test_a_resumed_run_with_a_wrapper_equals_an_undisturbed_one(
    engine: str, groups: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    environment = {"num_envs": 4, "groups": groups, "engine": engine, "wrapper": ("own.py:Counting",)}
    given = settings("gru", env="MortarMayhem-Grid-v0", threads=1, environment=environment)
    given = changed(given, ppo={"updates": 4, "steps": 16, "minibatches": 1})
    whole = training.train(changed(given, run="whole"))
    part = training.train(changed(given, run="part"), lambda update, _: update == 2)
    training.train(changed(given, resume=str(part)))
    assert_equal_runs(part, whole)
    resumed = checkpoint.load(part)
    assert sum(float(group["wrappers"][0]["steps"].sum()) for group in resumed.state["player"]["wrappers"]) > 0
    assert resumed.agent.observation_shapes["time"] == (1,)
    # The wrapper is part of the evaluation, whose returns are the environment's own.
    assert max(episode["reward"] for episode in evaluate(resumed.agent, range(2), 1)) <= 1.0
    with pytest.raises(ValueError, match="a resumed run must keep its environment"):
        training.train(changed(given, resume=str(part), environment={"wrapper": ()}))


def test_films_probes_and_data_sets_know_the_wrapper(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    """An agent of wrapped observations cannot act without the wrapper."""
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    given = settings("gru", env="Endless-MysteryPath-v0", environment={"wrapper": ("own.py:Counting",)}).validated()
    agent = saved(Path("run"), given)
    monkeypatch.chdir("/")
    assert agent.observation_shapes["time"] == (1,)
    assert len(probe.record(agent, range(2), max_steps=4).truth) == 8
    assert len(list(enjoy.EpisodeRecorder(agent, max_steps=3).frames((5,)))) > 4
    assert call(record.main, tmp_path / "run") == 1
    assert re.search(r"trained with --environment.wrapper .*own.py:Counting", capsys.readouterr().err)


def test_the_agent_learns_from_the_wrapped_rewards(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN)
    environment = {"num_envs": 2, "wrapper": (f"{tmp_path}/own.py:Counting",)}
    given = settings("gru", env="MortarMayhem-Grid-v0", threads=1, environment=environment, ppo={"steps": 8})
    with collecting(given) as collector:
        segment, _ = collector.collect(Clock())
    assert segment.reward.tolist() == [[step, step] for step in range(1, 9)]
    assert segment.observation["time"][..., 0].tolist() == [[step, step] for step in range(8)]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wrapper": ("own.py:Forgetful",)}, "Forgetful changes its attribute calls while it plays.*`state_dict`"),
        ({"wrapper": ("own.py:Short",)}, "own.py:Short must keep num_envs, which is 64, got 1"),
        ({"wrapper": ("own.py:Argument",)}, "own.py:Argument cannot wrap the environments: .* 'scale'"),
        ({"wrapper": ("own.py:Wide",)}, r"must leave observations that are uint8 .*, got Box\(.*\(2, 2\)"),
        ({"wrapper": ("own.py:Flat",)}, "must name a class derived from VectorWrapper, got `own.py:Flat`"),
        ({"wrapper": ("own.py",)}, "must be module:Class or file.py:Class of a class"),
        (
            {"wrapper": ("gymnasium.wrappers.vector:FlattenObservation",)},
            "FlattenObservation cannot wrap the environments: Expected autoreset_mode",
        ),
        ({"encoder": "own.py:Counting"}, "--encoder must name a class derived from Module"),
        ({"encoder": "own.py:Flat"}, r"Flat must encode n observations as a tensor \(n, width\), got \(\) for n = 2"),
        ({"encoder": "own.py:Frames"}, "Frames cannot encode an observation of {'features': .*: 'visual_observation'"),
        ({"encoder": "own.py:Flat", "encoder_option": ("a=1",)}, "Flat cannot be made of shapes and --encoder-option"),
        ({"encoder_option": ("a=1",)}, "--encoder-option needs an encoder of your own"),
    ],
)
def test_encoders_and_wrappers_that_do_not_fit_are_refused(
    changes: dict[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(OWN)
    if "wrapper" in changes:
        changes = {"environment": changes}
    given = settings("gru", env="MortarMayhem-Grid-v0", run="run", threads=1, ppo={"updates": 2, "steps": 8})
    with pytest.raises(ValueError, match=message):
        training.train(changed(given, **changes))


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
        ("os:system", (), "--agent must name a class derived from Module, got `os:system`"),
        ("min_gru.py:MinGRU", ("depth=2",), "MinGRU cannot be made of .* 'depth'"),
        ("min_gru.py:MinGRU", ("layers",), "--agent-option must be NAME=VALUE with a JSON value"),
        ("gru", ("layers=2",), "--agent-option is for mingru.* and agents of your own, got --agent gru"),
    ],
)
def test_agents_that_cannot_be_made_are_refused(agent: str, option: tuple[str, ...], message: str, file: Path) -> None:
    given = changed(PRESETS["quick"], agent=agent, agent_option=option, env="MortarMayhem-Grid-v0", run="run")
    with pytest.raises(ValueError, match=message):
        training.train(given)
