"""Every example runs as a user would run it, and prints plausible numbers."""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from support import segments

import endless_gym

psutil = pytest.importorskip("psutil")
pytestmark = [pytest.mark.slow, pytest.mark.libraries]

EXAMPLES = Path(__file__).parent.parent / "examples"
SUMMARY = re.compile(r"steps=(\d+) steps_per_second=(\d+) .*mean_return=(-?\d+\.\d+|none yet)")


def run(
    script: str, cwd: Path, *arguments: str, python: str = sys.executable, **variables: str
) -> tuple[str, re.Match[str]]:
    """Run the example with `arguments`, and return its output and the numbers in its last line."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""} | variables
    ran = subprocess.run(
        [python, EXAMPLES / script, *arguments], cwd=cwd, env=environment, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "Traceback" not in ran.stderr
    assert "not writ" not in ran.stderr, "an observation was made a tensor with a warning"
    summary = SUMMARY.fullmatch(ran.stdout.rstrip().splitlines()[-1].split(" loss=")[0])
    assert summary, ran.stdout
    assert int(summary[2]) > 0
    return ran.stdout, summary


def test_every_example_has_a_test():
    tested = {example.split()[0] for example, *_ in RUNS} | {f"{name.removeprefix('test_')}.py" for name in globals()}
    assert {path.name for path in EXAMPLES.glob("*.py")} <= tested


#: One command, in episodes as short as the task permits.
SHORT_EPISODES = json.dumps(
    {
        "command_count": [1],
        "command_show_duration": [1],
        "command_show_delay": [0],
        "explosion_delay": [5],
        "explosion_duration": [1],
    }
)
SHORT_ID, GRID_ID, DICT_ID = "Endless-MortarMayhem-v0", "MysteryPath-Grid-v0", "MortarMayhemB-Grid-v0"
ROLLOUT, BATCHES = "--num-steps 32", r"(?s)(batch=\(8, 32\) observation=\(8, 32, 84, 84, 3\).*){2}"
PUFFERLIB, JAX = r"observations=\(8, 84, 84, 3\) uint8", r"observation=\(8, 84, 84, 3\) uint8 shared=True"
#: Arguments of an example, the environment, and its expected output. Random actions end episodes of `SHORT_ID`.
RUNS = [
    (f"sb3_recurrent_ppo.py {ROLLOUT} --hidden-size 32", SHORT_ID, "train/"),
    (f"sb3_recurrent_ppo.py {ROLLOUT} --hidden-size 32", DICT_ID, "train/"),
    (f"torchrl_rollout.py {ROLLOUT}", GRID_ID, BATCHES),
    (f"torchrl_rollout.py {ROLLOUT} --num-workers 2", SHORT_ID, BATCHES),
    ("pufferlib_rollout.py --backend PufferEnv", SHORT_ID, PUFFERLIB),
    ("pufferlib_rollout.py --backend Serial", GRID_ID, PUFFERLIB),
    ("pufferlib_rollout.py --backend Multiprocessing", SHORT_ID, PUFFERLIB),
    (f"ppo_gru.py {ROLLOUT} --num-minibatches 2 --observation rgb --autoreset same_step", SHORT_ID, "loss="),
    (f"ppo_gru.py {ROLLOUT} --num-minibatches 2 --observation features --autoreset next_step", DICT_ID, "loss="),
    ("jax_service.py", SHORT_ID, JAX),
    ("jax_service.py", DICT_ID, JAX),
]


@pytest.mark.parametrize(("example", "env_id", "printed"), [pytest.param(*run, id=" ".join(run[:2])) for run in RUNS])
def test_example_runs(tmp_path, request, example, env_id, printed):
    script, *arguments = example.split()
    python = request.getfixturevalue("libraries_python") if script == "jax_service.py" else sys.executable
    sizes = ("--env-id", env_id, "--num-envs", "8", "--total-timesteps", "512")
    output, summary = run(script, tmp_path, *arguments, *sizes, python=python)
    assert summary[1] == "512"
    assert re.search(printed, output)
    if env_id == SHORT_ID:
        assert summary[3] != "none yet"
    assert not segments()


@pytest.mark.parametrize("script", ["torchrl_rollout.py", "rllib_ppo.py"])
def test_dict_observations_are_refused_with_a_message(script, tmp_path, libraries_python):
    python = libraries_python if script == "rllib_ppo.py" else sys.executable
    command = [python, EXAMPLES / script, "--env-id", "MortarMayhemB-v0"]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert ran.returncode
    assert "MortarMayhemB-v0 has dict observations" in ran.stderr
    assert "Traceback" not in ran.stderr


@pytest.mark.parametrize(
    "script", ["jax_service.py", "pufferlib_rollout.py", "sb3_recurrent_ppo.py", "torchrl_rollout.py"]
)
def test_command_lines_in_docstrings_work(tmp_path, libraries_python, script):
    """The commands run with fewer steps. The other examples have their own tests."""
    text = (EXAMPLES / script).read_text()
    lines = re.findall(rf"^python {script} ?(.*)$", text, re.M)
    assert lines, "the docstring shows no command"
    python = libraries_python if "import jax" in text else sys.executable
    few = "--total-timesteps 512" + " --num-envs 8 --num-steps 32" * ("num_steps: " in text)
    for line in lines:
        _, summary = run(script, tmp_path, *shlex.split(line), *few.split(), python=python)
        assert int(summary[1]) >= 512


@pytest.mark.parametrize(
    "example",
    [
        "ppo_gru.py --num-envs 2 --num-minibatches 2 --num-steps 1 --total-timesteps 4 --autoreset same_step",
        # After the end of an episode, one of two steps is masked.
        "ppo_gru.py --num-envs 2 --num-minibatches 2 --num-steps 2 --total-timesteps 400 --autoreset next_step",
        "asynchronous_actors.py --actors 1 --num-envs 1 --batch-trajectories 1 --num-steps 1 --total-timesteps 4",
    ],
)
def test_a_minibatch_of_one_step_is_finite(tmp_path, example):
    script, *arguments = example.split()
    output, _ = run(script, tmp_path, *arguments, "--env-id", "MortarMayhem-Grid-v0", "--hidden-size", "8")
    losses = [float(loss) for loss in re.findall(r"loss=(\S+)", output)]
    assert losses and all(math.isfinite(loss) for loss in losses)


@pytest.mark.parametrize(
    ("env_id", "observation", "runners", "memory"),
    [("Endless-MortarMayhem-v0", "rgb", 1, "lstm"), ("MysteryPath-Grid-v0", "features", 0, "none")],
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
    # RLlib does not count steps that reset an environment, and samples whole steps of all environments.
    assert 256 <= int(summary[1]) < 256 + 2 * 8
    assert output.count("steps=") >= 2
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"


def test_rllib_ppo_remembers_a_command(tmp_path, ray_folder, libraries_python):
    """The module's GRU learns more than an agent without memory."""
    sizes = ("--num-envs", "32", "--num-steps", "32", "--total-timesteps", "24000", "--learning-rate", "0.003")
    returns = {}
    for memory in ("gru", "none"):
        given = ("--options", SHORT_EPISODES, *sizes, "--memory", memory)
        _, summary = run("rllib_ppo.py", tmp_path, *given, python=libraries_python)
        returns[memory] = float(summary[3])
    # The reward of the one command is 0.1.
    assert returns["gru"] > returns["none"] + 0.02


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Minari needs Python 3.11")
def test_behaviour_cloning(tmp_path):
    given = {"options": {"command_count": [1]}, "observation": "features", "num_threads": 1}
    endless_gym.record("MortarMayhem-Grid-v0", 60, dataset="clone/short-v0", root=tmp_path, **given)
    sizes = ("--updates", "100", "--batch-size", "16", "--hidden-size", "64", "--evaluation-episodes", "30")
    output, summary = run(
        "behaviour_cloning.py", tmp_path, "--dataset", "clone/short-v0", *sizes, MINARI_DATASETS_PATH=str(tmp_path)
    )
    losses = [float(loss) for loss in re.findall(r"loss=(\S+)", output)]
    assert len(losses) == 2
    # The reward of the one command is 0.1.
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


ACTORS = ("--num-envs", "8", "--num-steps", "16", "--hidden-size", "16")


@pytest.mark.parametrize(("env_id", "service"), [(SHORT_ID, ()), (GRID_ID, ("--service",))])
def test_asynchronous_actors(tmp_path, env_id, service):
    sizes = ("--total-timesteps", "2048", "--batch-trajectories", "2")
    output, summary = run(
        "asynchronous_actors.py", tmp_path, "--env-id", env_id, "--options", "{}", *ACTORS, *sizes, *service
    )
    assert summary[1] == "2048"
    assert output.count("steps=") >= 2
    if env_id.startswith("Endless"):
        assert summary[3] != "none yet"
    assert not segments()


def test_asynchronous_actors_limit_the_policy_lag(tmp_path):
    sizes = ("--total-timesteps", "2048", "--batch-trajectories", "1", "--max-policy-lag", "0")
    output, summary = run("asynchronous_actors.py", tmp_path, *ACTORS, *sizes)
    assert summary[1] == "2048"
    assert set(re.findall(r"largest_lag=(\d+)", output)) == {"0"}
    # While the learner updates, every actor completes or begins a trajectory of the previous policy.
    assert int(re.findall(r"dropped=(\d+)", output)[-1]) > 0


def test_asynchronous_actors_learn_one_command(tmp_path):
    sizes = ("--num-steps", "32", "--num-minibatches", "2", "--learning-rate", "0.003", "--total-timesteps", "100000")
    _, summary = run("asynchronous_actors.py", tmp_path, "--options", SHORT_EPISODES, *sizes)
    # By chance, or without memory, the return is 0.025 of 0.1.
    assert float(summary[3]) > 0.04


@pytest.mark.parametrize("ended", ["actor", "learner", "ctrl-c"])
def test_asynchronous_actors_end_together(tmp_path, ended):
    """If one process ends, all end within seconds, with a message, and nothing is left in /dev/shm."""
    process = subprocess.Popen(
        [sys.executable, EXAMPLES / "asynchronous_actors.py", *ACTORS, "--total-timesteps", "100000000", "--service"],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        pids = re.fullmatch(r"learner=(\d+) actors=(\d+),(\d+)\n", process.stdout.readline())
        learner, *actors = (int(pid) for pid in pids.groups())
        assert process.stdout.readline().startswith("steps=")
        if ended == "actor":
            os.kill(actors[1], signal.SIGKILL)
        elif ended == "learner":
            os.kill(learner, signal.SIGKILL)
        else:
            os.killpg(process.pid, signal.SIGINT)
        _, message = process.communicate(timeout=60)
        if ended != "learner":
            assert process.returncode == 1
            assert "Traceback" not in message
            cause = rf"by Ctrl-C after \d+ steps|after \d+ steps: actor 1 \(process {actors[1]}\) has ended.*"
            assert re.fullmatch(rf"stopped ({cause})", message.strip().splitlines()[-1]), message
        tensors = tuple(f"torch_{pid}_" for pid in (learner, *actors))
        deadline = time.monotonic() + 60
        while (
            left := segments()
            | {name for name in os.listdir("/dev/shm") if name.startswith(tensors)}
            | {pid for pid in actors if is_running(pid)}
        ):
            assert time.monotonic() < deadline, left
            time.sleep(0.05)
    finally:
        # Not before: an engine that is killed while it ends leaves its segments.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def is_running(pid):
    # If the learner was killed, nobody waits for its actors, which may stay in the process table.
    try:
        return psutil.Process(pid).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False
