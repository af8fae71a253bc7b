"""Agents on a device other than the CPU: all tensors are on the right device, and the results equal the CPU's."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import other_device
import pytest

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


@pytest.mark.timeout(600)
def test_checks_on_another_device(tmp_path: Path) -> None:
    command = [sys.executable, Path(__file__).with_name("on_other_device.py"), tmp_path]
    environment = os.environ | {"PYTHONPATH": f"{Path(__file__).parent}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout.count("passed: ") == 10
