"""Every example runs as a user would run it, and ends with numbers that make sense."""

from __future__ import annotations

import json
import math
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import endless_gym

pytestmark = pytest.mark.slow

EXAMPLES = Path(__file__).parent.parent / "examples"
SUMMARY = re.compile(r"steps=(\d+) steps_per_second=(\d+) .*mean_return=(-?\d+\.\d+|none yet)")


def run(
    script: str, cwd: Path, *arguments: str, python: str = sys.executable, **variables: str
) -> tuple[str, re.Match[str]]:
    """Run the example with `arguments`, and return what it printed, and the last line's numbers."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""} | variables
    ran = subprocess.run(
        [python, EXAMPLES / script, *arguments],
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


@pytest.mark.parametrize("script", ["cleanrl_ppo.py", "torchrl_rollout.py", "rllib_ppo.py"])
def test_dict_observations_are_refused_with_a_message(script, tmp_path, libraries_python):
    command = [libraries_python, EXAMPLES / script, "--env-id", "MortarMayhemB-v0"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ran.returncode
    assert "MortarMayhemB-v0 has dict observations" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_cleanrl_ppo_needs_steps_for_one_update(tmp_path):
    command = [sys.executable, EXAMPLES / "cleanrl_ppo.py", "--total-timesteps", "100"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ran.returncode
    assert "--total-timesteps must be at least num_envs * num_steps, 8192" in ran.stderr


@pytest.mark.parametrize(
    "script", ["cleanrl_ppo.py", "jax_service.py", "pufferlib_rollout.py", "sb3_recurrent_ppo.py", "torchrl_rollout.py"]
)
def test_command_lines_are_right_as_written(tmp_path, libraries_python, script):
    """Those of the docstring, with fewer steps. The other examples have tests with shorter command lines."""
    text = (EXAMPLES / script).read_text()
    lines = re.findall(rf"^python {script} ?(.*)$", text, re.M)
    assert lines, "the docstring shows no command"
    python = libraries_python if "import jax" in text else sys.executable
    usage = subprocess.run([python, EXAMPLES / script, "--help"], capture_output=True, text=True, check=True).stdout
    for line in lines:
        few = [
            "--total-timesteps",
            "512",
            *(["--num-envs", "8", "--num-steps", "32"] if "--num-steps" in usage else []),
        ]
        _, summary = run(script, tmp_path, *shlex.split(line), *few, python=python)
        assert int(summary[1]) >= 512


@pytest.mark.parametrize("env_id", ["Endless-MortarMayhem-v0", "MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"])
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


def test_torchrl_rollout_with_workers(tmp_path, segments):
    sizes = ("--num-envs", "8", "--num-workers", "2", "--num-steps", "32", "--total-timesteps", "512")
    output, summary = run("torchrl_rollout.py", tmp_path, *sizes)
    assert summary[1] == "512"
    assert output.count("batch=(8, 32) observation=(8, 32, 84, 84, 3)") == 2
    assert summary[3] != "none yet"
    assert not segments()


@pytest.mark.parametrize(
    ("env_id", "backend"),
    [
        ("Endless-MortarMayhem-v0", "PufferEnv"),
        ("Endless-MortarMayhem-v0", "Serial"),
        ("Endless-MortarMayhem-v0", "Multiprocessing"),
        ("MysteryPath-Grid-v0", "PufferEnv"),
        ("MysteryPath-Grid-v0", "Serial"),
        ("MysteryPath-Grid-v0", "Multiprocessing"),
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


@pytest.mark.parametrize(
    ("env_id", "observation", "runners", "memory"),
    [
        ("Endless-MortarMayhem-v0", "rgb", 0, "lstm"),
        ("MysteryPath-Grid-v0", "features", 1, "none"),
        ("Endless-MortarMayhem-v0", "rgb", 1, "gru"),
    ],
)
def test_rllib_ppo(tmp_path, ray_folder, libraries_python, env_id, observation, runners, memory):
    arguments = {
        "--env-id": env_id,
        "--options": "{}",
        "--observation": observation,
        "--num-env-runners": runners,
        "--num-envs": 8,
        "--num-steps": 16,
        "--total-timesteps": 256,
        "--memory": memory,
    }
    flat = (str(part) for pair in arguments.items() for part in pair)
    output, summary = run("rllib_ppo.py", tmp_path, *flat, python=libraries_python)
    assert summary[1] == "256"
    assert output.count("steps=") >= 2
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"


def test_rllib_ppo_remembers_a_command(tmp_path, ray_folder, libraries_python):
    """In episodes that are as short as the task permits, with the module's GRU and without a memory."""
    options = {"command_count": [1], "command_show_duration": [1], "command_show_delay": [0]}
    options |= {"explosion_delay": [5], "explosion_duration": [1]}
    sizes = ("--num-envs", "32", "--num-steps", "32", "--total-timesteps", "24000", "--learning-rate", "0.003")
    returns = {}
    for memory in ("gru", "none"):
        given = ("--options", json.dumps(options), *sizes, "--memory", memory)
        _, summary = run("rllib_ppo.py", tmp_path, *given, python=libraries_python)
        returns[memory] = float(summary[3])
    # The reward of the one command is 0.1.
    assert returns["gru"] > returns["none"] + 0.02


@pytest.mark.parametrize("env_id", ["Endless-MortarMayhem-v0", "MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"])
def test_jax_service(tmp_path, libraries_python, segments, env_id):
    sizes = ("--num-envs", "8", "--total-timesteps", "512")
    output, summary = run("jax_service.py", tmp_path, "--env-id", env_id, *sizes, python=libraries_python)
    assert summary[1] == "512"
    assert "observation=(8, 84, 84, 3) uint8 shared=True" in output
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"
    assert not segments()


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Minari needs Python 3.11")
@pytest.mark.parametrize("env_id", ["MortarMayhem-Grid-v0", "MysteryPath-v0"])
def test_behaviour_cloning(tmp_path, env_id):
    options = {"command_count": [1]} if env_id.startswith("Mortar") else {"max_steps": 64}
    endless_gym.record(
        env_id, 60, options=options, observation="features", dataset="clone/short-v0", root=tmp_path, num_threads=1
    )
    sizes = ("--updates", "100", "--batch-size", "16", "--hidden-size", "64", "--evaluation-episodes", "30")
    output, summary = run(
        "behaviour_cloning.py", tmp_path, "--dataset", "clone/short-v0", *sizes, MINARI_DATASETS_PATH=str(tmp_path)
    )
    losses = [float(loss) for loss in re.findall(r"loss=(\S+)", output)]
    assert len(losses) == 2
    if env_id.startswith("Mortar"):
        # The reward of the one command.
        by_chance = float(re.search(r"random_return=(\S+)", output)[1])
        assert float(summary[3]) > by_chance + 0.03


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
