"""Agents on a device other than the CPU: all tensors are on the right device, and the results equal the CPU's."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import other_device
import pytest

from endless_gym_agents.memories import MEMORIES

pytestmark = pytest.mark.slow

SMALL = (
    "--preset quick --environment.num-envs 2 --ppo.steps 8 --ppo.updates 1 --ppo.epochs 1 "
    "--ppo.minibatches 2 --threads 1 --environment.num-threads 1 --recurrence.hidden-size 16 --transformer.width 16 "
    "--transformer.window 6 --transformer.sequence-length 4"
)
HEADS = "--environment.observation rgb --ppo.reconstruction-coefficient 0.1 --ppo.ground-truth-coefficient 0.1"
FLAGS = {
    "gru": f"--env Endless-MortarMayhem-v0 --agent gru {HEADS}",
    "lstm": "--env MortarMayhemB-Grid-v0 --agent lstm --recurrence.layers 2 --ppo.advantage-normalisation minibatch",
    "mingru": "--env MortarMayhemB-Grid-v0 --agent mingru --recurrence.layers 2 --recurrence.kernels torch",
    "trxl": "--env Endless-MysteryPath-v0 --agent trxl --transformer.positional-encoding learned --transformer.query-encoding",
    "gtrxl": "--env MortarMayhemB-Grid-v0 --agent gtrxl --transformer.positional-encoding relative --transformer.query-previous",
    "stack": "--env MortarMayhemB-Grid-v0 --agent stack --environment.observation rgb --model.stack 2",
    "position": "--env MortarMayhemB-Grid-v0 --agent position --ppo.advantage-normalisation batch",
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Output of `other_device.py`, run in a subprocess since a registered device cannot be removed."""
    given = [json.dumps([*flags.split(), *SMALL.split()]) for flags in FLAGS.values()]
    command = [sys.executable, other_device.__file__, str(tmp_path_factory.mktemp("runs")), *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    return dict(zip(FLAGS, json.loads(done.stdout.splitlines()[-1]), strict=True))


@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", FLAGS)
def test_run_on_another_device_equals_the_run_on_the_cpu(results: dict[str, Any], name: str) -> None:
    """Training, a checkpoint, resumption from it, and evaluation."""
    here, there = results[name]["cpu"], results[name][other_device.NAME]
    assert [row["update"] for row in there["rows"]] == [1, 2]
    for one, other in zip(here["rows"], there["rows"], strict=True):
        timed = {key for key in one if key.startswith("seconds/")} | {"steps_per_second"}
        assert other.keys() == one.keys()
        # Fused cells and unfused attention round differently from the CPU kernels.
        for key in one.keys() - timed:
            assert other[key] == pytest.approx(one[key], rel=1e-3, abs=1e-5), key
    assert there["episodes"] == here["episodes"]


def test_stand_in_rejects_what_cuda_rejects() -> None:
    program = f"""
import sys

sys.path.append({str(Path(__file__).parent)!r})
import torch
from other_device import NAME, device, register

register()
with device():
    layer, here = torch.nn.Linear(2, 2).to(NAME), torch.ones(3, 2)
    assert layer(here.to(NAME)).device.type == NAME and layer(here.to(NAME)).cpu().device.type == "cpu"
    for wrong in (lambda: layer(here), lambda: here.to(NAME) + here, lambda: here.to(NAME).numpy()):
        try:
            wrong()
        except (RuntimeError, TypeError) as error:
            print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert done.returncode == 0 and len(lines) == 3, done.stderr
    assert "addmm: tensors on two devices" in lines[0]
    assert "add: tensors on two devices" in lines[1]
    assert "numpy" in lines[2]


def test_memories_compute_on_another_device_what_they_compute_on_the_cpu() -> None:
    """Outputs, states and gradients of sequences, where scans over steps are associative, and outputs of steps."""
    program = f"""
import sys

sys.path.append({str(Path(__file__).parent)!r})
import torch
from other_device import NAME, device, register
from torch import nn

from endless_gym_agents.common import own
from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.memories.sequence_model import Stack

register()


def computed(name, place):
    torch.manual_seed(1)
    model = Stack(own.load("--agent", MEMORIES[name], nn.Module), 16, 16, 2, {{}})
    for parameter in model.parameters():
        parameter.data += 0.1 * torch.randn_like(parameter)
    x, resets = torch.randn(90, 3, 16), torch.rand(90, 3) < 0.05
    state = {{key: torch.zeros(3, *shape) for key, shape in model.state_shapes.items()}}
    model, x, resets = model.to(place), x.to(place).requires_grad_(), resets.to(place)
    state = {{key: part.to(place) for key, part in state.items()}}
    y, after = model.sequence(x, state, resets)
    gradients = torch.autograd.grad((y * y.detach().roll(1, -1)).mean(), [x, *model.parameters()])
    return [part.detach().cpu() for part in (y, *after.values(), *gradients, *model.step(x[0], after)[1].values())]


with device():
    for name in MEMORIES:
        for here, there in zip(computed(name, "cpu"), computed(name, NAME), strict=True):
            assert here.abs().max() > 0
            torch.testing.assert_close(there, here, rtol=1e-4, atol=1e-4 * float(here.abs().max()))
        print(name)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert done.stdout.split() == list(MEMORIES), done.stderr[-3000:]
