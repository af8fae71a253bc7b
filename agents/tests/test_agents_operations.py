"""Budgets of the operations and of the waits for the device of an `act` and of an update.

The speed of tiny networks and small minibatches is limited by the number of operations, on the CPU and on a GPU. Operations that
only make a view are not counted.
"""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from agents_helpers import settings
from operations import Operations
from recorded_graphs import RecordedGraphs

from endless_gym_agents import encoders
from endless_gym_agents.agent import make_agent
from endless_gym_agents.clock import Clock
from endless_gym_agents.environments import Environments
from endless_gym_agents.host import Outcome, Upload
from endless_gym_agents.ppo import learn, make_optimizer
from endless_gym_agents.recurrence import PackedGRU
from endless_gym_agents.rollout import RolloutCollector
from endless_gym_agents.settings import PRESETS, Settings

STEPS, GROUPS = 16, 2
WORKSPACE = Path(__file__).parents[2]

#: Operations of one step of one group, and of one minibatch, each with its share of what is done once for a segment or an
#: update. The Transformer-XL has two blocks, and the actions two branches. A change that needs more must say why.
BUDGETS = {
    "none": (14, 200),
    "gru": (29, 345),
    "lstm": (32, 385),
    # The normalisation of the tokens is folded into the projections: more operations, but none of the size of the tokens.
    "trxl": (50, 325),
    "trxl, single steps": (50, 400),
    "gtrxl": (109, 475),
}


def small(name: str) -> Settings:
    agent, _, single = name.partition(", ")
    given = settings(agent, env="Endless-MortarMayhem-v0", threads=1)
    if single:
        given = replace(given, transformer=replace(given.transformer, sequence_length=1))
    return replace(
        given,
        environment=replace(given.environment, num_envs=8, groups=GROUPS, num_threads=1),
        ppo=replace(given.ppo, steps=STEPS, epochs=2, minibatches=2),
    )


#: Launches of one step of one group with graphs: the upload of the observation, two graphs, the copy of the actions and the
#: upload of the outcome. Hidden states are stored for each sequence, here every eighth step.
LAUNCHES = {"none": 5, "stack": 5, "position": 5, "gru": 5 + 1 / 8, "lstm": 5 + 1 / 8, "trxl": 5, "gtrxl": 5}
#: Launches for each segment of two groups: weights, noise, cache and bootstrap value are made without graphs.
SEGMENT_LAUNCHES = {"none": 63, "stack": 69, "position": 73, "gru": 96, "lstm": 102, "trxl": 176, "gtrxl": 288}


def counted(agent: str, device: str = "cpu") -> dict[str, float]:
    """Operations of the second segment and update; the first one makes what is made once."""
    given = small(agent)
    with Environments(given) as environments:
        torch.manual_seed(1)
        made = make_agent(given, environments.spec, device)
        collector = RolloutCollector(made, environments, STEPS, torch.Generator(device).manual_seed(1))
        optimizer = make_optimizer(made, 1e-3)
        counts = {}
        for _ in range(2):
            with Operations() as rollout:
                segment, _ = collector.collect(Clock())
            with Operations() as update:
                states = [memory.state for memory in collector.memories]
                learn(made, optimizer, segment, states, 1, given.ppo, torch.Generator().manual_seed(0))
            minibatches = given.ppo.epochs * given.ppo.minibatches
            counts = {
                "act": rollout.computed / (STEPS * GROUPS),
                "update": update.computed / minibatches,
                "waiting": rollout.waiting,
            }
    return counts


@pytest.mark.parametrize("agent", BUDGETS)
def test_operations_are_within_the_budget(agent: str) -> None:
    act, update = BUDGETS[agent]
    counts = counted(agent)
    assert counts["waiting"] == 0
    assert counts["act"] <= act
    assert counts["update"] <= update


def launches(agent: str, steps: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Launches of the second segment with graphs; uploads are copies of NumPy on the CPU, and count as one each."""
    given, recorded, uploads = small(agent), RecordedGraphs(), 0

    def counting(function: Callable[..., None]) -> Callable[..., None]:
        def call(*args: Any) -> None:
            nonlocal uploads
            uploads += 1
            function(*args)

        return call

    with Environments(given) as environments, monkeypatch.context() as patch:
        torch.manual_seed(1)
        made = make_agent(given, environments.spec)
        collector = RolloutCollector(made, environments, steps, torch.Generator().manual_seed(1), graphs=recorded)
        collector.collect(Clock())
        patch.setattr(Upload, "copy", counting(Upload.copy))
        patch.setattr(Outcome, "copy_to", counting(Outcome.copy_to))
        recorded.replays = 0
        with Operations() as operations:
            collector.collect(Clock())
    return operations.computed + recorded.replays + uploads


@pytest.mark.parametrize("agent", LAUNCHES)
def test_launches_with_graphs_are_within_the_budget(agent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    short, long = (launches(agent, steps, monkeypatch) for steps in (STEPS, 2 * STEPS))
    for_each_step = (long - short) / (STEPS * GROUPS)
    assert for_each_step == LAUNCHES[agent]
    assert short - for_each_step * STEPS * GROUPS <= SEGMENT_LAUNCHES[agent]


@pytest.mark.slow
def test_act_waits_only_for_the_actions_and_copies_each_observation_once() -> None:
    """Counted on a stand-in for a CUDA device; in a subprocess, since a registered device cannot be removed."""
    program = f"""
import sys

sys.path.append({str(Path(__file__).parent)!r})
import json
import other_device
import test_agents_operations
from endless_gym_agents import ppo, rollout

other_device.register()
found = {{}}
collect, learn = rollout.RolloutCollector.collect, ppo.learn

def counting(name, function):
    def run(*args):
        other_device.waits.clear()
        other_device.uploads.clear()
        result = function(*args)
        found[name] = dict(other_device.waits)
        if name == "collect":
            found["uploads"] = sorted(other_device.uploads.items())
        return result
    return run

rollout.RolloutCollector.collect = counting("collect", collect)
test_agents_operations.learn = counting("learn", learn)
for agent in ("gru", "trxl", "stack"):
    with other_device.device():
        test_agents_operations.counted(agent, other_device.NAME)
    print(json.dumps(found))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr[-3000:]
    for line in done.stdout.splitlines():
        found = json.loads(line)
        # Each action is copied to the CPU, and nothing else waits.
        assert found["collect"] == {"copy_": STEPS * GROUPS}, line
        # Each group's observation, also the last one, goes to the device once, and its rewards and ends of episodes together.
        assert found["uploads"] == [[[2, 4], STEPS * GROUPS], [[4, 17], (STEPS + 1) * GROUPS]], line
        # The reset mask and the metrics; the Transformer-XL also needs the length of the longest episode.
        assert sum(found["learn"].values()) <= 2 + 1, line


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["gru", "trxl"])
def test_counts_in_the_documentation(agent: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The table of the estimate for a GPU, which encodes all frames at once and whose recurrent layer is one operation."""
    monkeypatch.setattr(encoders, "FRAMES_PER_CHUNK", 1 << 30)
    paper = replace(PRESETS["paper"], env="Endless-MortarMayhem-v0", agent=agent)
    # The number of environments changes only how many steps have the operations for an episode that starts.
    given = replace(paper, environment=replace(paper.environment, num_envs=2, num_threads=1)).validated()
    steps, ppo = given.ppo.steps, given.ppo
    with Environments(given) as environments:
        torch.manual_seed(1)
        made = make_agent(given, environments.spec)
        collector = RolloutCollector(made, environments, steps, torch.Generator().manual_seed(1))
        collector._frames = None  # Equal frames are encoded once on the CPU only.
        optimizer, states = make_optimizer(made, 1e-4), [memory.state for memory in collector.memories]
        learn(made, optimizer, collector.collect(Clock())[0], states, 0, replace(ppo, epochs=1), torch.Generator())
        with Operations() as rollout:
            segment, _ = collector.collect(Clock())
        with Operations() as update:
            for name in ("forward", "backward"):
                monkeypatch.setattr(PackedGRU, name, staticmethod(update.as_one(getattr(PackedGRU, name))))
            learn(made, optimizer, segment, states, 1, ppo, torch.Generator().manual_seed(0))
    text, column = (WORKSPACE / "docs/train/agents.md").read_text(), ["gru", "trxl"].index(agent)
    for row, count in (
        ("operations of a call of the network, 512 calls", rollout.computed / steps),
        ("operations of a minibatch, 24 minibatches", update.computed / (ppo.epochs * ppo.minibatches)),
    ):
        (numbers,) = re.findall(rf"^\| {row} \| (\d+) \| (\d+) \|$", text, re.MULTILINE)
        assert int(numbers[column]) == round(count), row
