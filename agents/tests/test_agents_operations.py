"""Budgets for the number of operations in an `act` and in an update; `on_other_device.py` counts waits for the device.

The number of operations limits the speed of tiny networks and small minibatches, on the CPU and on a GPU. Operations that only
make a view are not counted.
"""

import pytest
import torch
from agents_helpers import changed, collecting, settings
from operations import Operations

from endless_gym_agents.common.clock import Clock
from endless_gym_agents.settings import Settings
from endless_gym_agents.training.ppo import learn, make_optimizer

STEPS, GROUPS = 16, 2

#: Operations per step of one group, and per minibatch, each with its share of the work done once per segment or update. The
#: Transformer-XL has two blocks, and the actions two branches. A change that raises a budget must say why.
BUDGETS = {
    # Biases, which do not decay, are a group of their own of the optimizer.
    "none": (14, 205),
    "gru": (29, 250),
    "lstm": (30, 255),
    # The normalisation of the tokens is folded into the projections: more operations, but none of the size of the tokens.
    "trxl": (50, 325),
    "trxl, single steps": (50, 400),
    "gtrxl": (109, 475),
}


def small(name: str) -> Settings:
    agent, _, single = name.partition(", ")
    given = settings(agent, env="Endless-MortarMayhem-v0", threads=1)
    if single:
        given = changed(given, transformer={"sequence_length": 1})
    environment = {"num_envs": 8, "groups": GROUPS, "num_threads": 1}
    return changed(given, environment=environment, ppo={"steps": STEPS, "epochs": 2, "minibatches": 2})


def counted(agent: str) -> dict[str, float]:
    """Operations of the second segment and update; the first includes one-time work."""
    given = small(agent)
    with collecting(given) as collector:
        optimizer = make_optimizer(collector.agent, 1e-3)
        counts = {}
        for _ in range(2):
            with Operations() as rollout:
                segment, _ = collector.collect(Clock())
            with Operations() as update:
                states = [memory.state for memory in collector.memories]
                learn(collector.agent, optimizer, segment, states, 1, given.ppo, torch.Generator().manual_seed(0))
            minibatches = given.ppo.epochs * given.ppo.minibatches
            counts = {
                "act": rollout.computed / (STEPS * GROUPS),
                "update": update.computed / minibatches,
            }
    return counts


@pytest.mark.parametrize("agent", BUDGETS)
def test_operations_are_within_the_budget(agent: str) -> None:
    act, update = BUDGETS[agent]
    counts = counted(agent)
    assert counts["act"] <= act
    assert counts["update"] <= update
