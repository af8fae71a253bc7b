"""Every example runs as a user would run it, and ends with numbers that make sense."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent / "examples"
SUMMARY = re.compile(r"steps=(\d+) steps_per_second=(\d+) .*mean_return=(-?\d+\.\d+|none yet)")


def run(script: str, cwd: Path, *arguments: str) -> tuple[str, re.Match[str]]:
    """Run the example with `arguments`, and return what it printed, and the last line's numbers."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    ran = subprocess.run(
        [sys.executable, EXAMPLES / script, *arguments],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr
    assert "not writ" not in ran.stderr, "an observation was made a tensor with a warning"
    summary = SUMMARY.fullmatch(ran.stdout.rstrip().splitlines()[-1].split(" loss=")[0])
    assert summary, ran.stdout
    assert int(summary[2]) > 0
    return ran.stdout, summary


def test_every_example_has_a_test():
    assert {f"test_{path.stem}" for path in EXAMPLES.glob("*.py")} <= set(globals())


@pytest.mark.parametrize("env_id", ["Endless-MortarMayhem-v0", "MortarMayhemB-Grid-v0"])
def test_sb3_recurrent_ppo(tmp_path, env_id):
    sizes = ("--num-envs", "8", "--num-steps", "32", "--total-timesteps", "512", "--hidden-size", "32")
    output, summary = run("sb3_recurrent_ppo.py", tmp_path, "--env-id", env_id, *sizes)
    assert summary[1] == "512"
    assert "train/" in output, "no update was made"
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"
        assert "ep_rew_mean" in output


@pytest.mark.parametrize("env_id", ["Endless-MortarMayhem-v0", "MysteryPath-Grid-v0"])
def test_torchrl_rollout(tmp_path, env_id):
    sizes = ("--num-envs", "8", "--num-steps", "32", "--total-timesteps", "512")
    output, summary = run("torchrl_rollout.py", tmp_path, "--env-id", env_id, *sizes)
    assert summary[1] == "512"
    assert output.count("batch=(8, 32) observation=(8, 32, 84, 84, 3)") == 2
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"


@pytest.mark.parametrize(
    ("env_id", "backend"),
    [
        ("Endless-MortarMayhem-v0", "PufferEnv"),
        ("Endless-MortarMayhem-v0", "Serial"),
        ("Endless-MortarMayhem-v0", "Multiprocessing"),
        ("MysteryPath-Grid-v0", "PufferEnv"),
        ("MysteryPath-Grid-v0", "Serial"),
    ],
)
def test_pufferlib_rollout(tmp_path, env_id, backend):
    sizes = ("--num-envs", "8", "--total-timesteps", "512")
    output, summary = run("pufferlib_rollout.py", tmp_path, "--env-id", env_id, "--backend", backend, *sizes)
    assert summary[1] == "512"
    assert "observations=(8, 84, 84, 3) uint8" in output
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"


@pytest.mark.parametrize("env_id", ["Endless-MortarMayhem-v0", "MysteryPath-Grid-v0"])
def test_cleanrl_ppo(tmp_path, env_id):
    sizes = ("--num-envs", "8", "--num-steps", "32", "--num-minibatches", "2", "--update-epochs", "1")
    output, summary = run(
        "cleanrl_ppo.py", tmp_path, "--env-id", env_id, "--total-timesteps", "512", "--hidden-size", "32", *sizes
    )
    assert summary[1] == "512"
    assert output.count("steps=") >= 2
    losses = [float(loss) for loss in re.findall(r"loss=(\S+)", output)]
    assert len(losses) == 2
    assert not any(math.isnan(loss) for loss in losses)


def test_curriculum(tmp_path):
    sizes = ("--commands", "2", "--num-envs", "32", "--total-timesteps", "30000")
    output, summary = run("curriculum.py", tmp_path, *sizes)
    assert int(summary[1]) < 30_000
    assert float(summary[3]) >= 0.9
    output, _ = run("curriculum.py", tmp_path, *sizes, "--compare", "1")
    assert [line.split()[0] for line in output.splitlines() if " seed=1 " in line] == [
        "curriculum=True",
        "curriculum=False",
    ]
