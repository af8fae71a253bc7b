"""Data-parallel training: the processes of `torchrun` compute the same as a single process, and end together."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import endless_gym
from endless_gym_agents.environments.ranks import Ranks
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.train import parse, train

ARGUMENTS = " ".join(
    (
        "--env MortarMayhem-Grid-v0 --environment.option command_count=[1] --preset quick --device cpu --threads 1",
        "--environment.num-envs 8 --environment.groups 2 --ppo.steps 16 --ppo.updates 3 --ppo.minibatches 2",
        "--checkpoint-interval 1 --recurrence.hidden-size 16 --recurrence.sequence-length 8 --transformer.width 16",
        "--transformer.window 8 --transformer.sequence-length 8 --model.vector-width 16 --model.head-width 16",
    )
).split()
TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
Start = Callable[..., subprocess.Popen[str]]
#: More updates than a test waits for.
ENDLESS = ["--ppo.updates", "100000"]


def log(run: Path) -> Path:
    return run.with_suffix(".log")


def finished(process: subprocess.Popen[str], run: Path, expected: int = 0) -> Path:
    assert process.wait(timeout=250) == expected, log(run).read_text()
    return run


def last(run: Path) -> dict[str, Any]:
    return torch.load(run / checkpoint.FOLDER / checkpoint.LAST, weights_only=True)


def wait_until(condition: Callable[[], bool], process: subprocess.Popen[str], run: Path) -> None:
    deadline = time.monotonic() + 200
    while not condition():
        assert process.poll() is None, log(run).read_text()
        assert time.monotonic() < deadline, log(run).read_text()
        time.sleep(0.05)


def ranks_of(process: subprocess.Popen[str]) -> dict[int, int]:
    """The process of each rank, by its number."""
    found = {}
    for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        variables = Path(f"/proc/{child}/environ").read_bytes().split(b"\0")
        found |= {int(value[5:]): int(child) for value in variables if value.startswith(b"RANK=")}
    return found


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a run of several ranks, with its output in a file next to its folder. The run is killed after the test."""
    processes = []

    def start(run: Path, ranks: int, *arguments: str, restarts: int = 0) -> subprocess.Popen[str]:
        module = [f"--nproc-per-node={ranks}", f"--max-restarts={restarts}", "-m", "endless_gym_agents.train", "--"]
        run.parent.mkdir(parents=True, exist_ok=True)
        with log(run).open("w") as output:
            process = subprocess.Popen(
                [*TORCHRUN, *module, *ARGUMENTS, *arguments, "--run", str(run)],
                stdout=output,
                stderr=subprocess.STDOUT,
                text=True,
                env=os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "TERM": "dumb", "COLUMNS": "200"},
                start_new_session=True,
            )
        processes.append(process)
        return process

    yield start
    for process in processes:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.mark.parametrize(
    ("agent", "ranks", "arguments"),
    [
        ("lstm", 4, "--ppo.advantage-normalisation minibatch --environment.engine process --environment.groups 1"),
        # Each minibatch has one sequence, which belongs to one rank; the other rank has no steps.
        ("trxl", 2, "--environment.num-envs 2 --environment.groups 1 --transformer.sequence-length 16"),
    ],
)
def test_ranks_compute_what_one_process_computes(
    tmp_path: Path, agent: str, ranks: int, arguments: str, start: Start
) -> None:
    given = ["--agent", agent, *arguments.split()]
    alone = train(parse([*ARGUMENTS, *given, "--run", str(tmp_path / "one")]))
    together = finished(start(tmp_path / "several", ranks, *given), tmp_path / "several")
    one, several = last(alone), last(together)
    assert one["model"].keys() == several["model"].keys()
    for name, weights in one["model"].items():
        torch.testing.assert_close(several["model"][name], weights, rtol=0, atol=1e-5)
    assert one["steps"] == several["steps"]
    for expected, found in zip(read_progress(alone), read_progress(together), strict=True):
        assert expected.keys() == found.keys()
        for name in expected:
            if not name.startswith("seconds/") and name != "steps_per_second":
                assert math.isclose(expected[name], found[name], rel_tol=1e-4, abs_tol=1e-5), name


def test_run_restarts_when_a_rank_is_killed(tmp_path: Path, segments: Callable[[], set[str]], start: Start) -> None:
    run, engines = tmp_path / "run", ("--agent", "gru", "--environment.engine", "process")
    undisturbed = start(tmp_path / "undisturbed", 2, *engines, "--ppo.updates", "12")
    finished(undisturbed, tmp_path / "undisturbed")
    process = start(run, 2, *engines, "--ppo.updates", "12", restarts=1)
    wait_until(lambda: len(read_progress(run)) >= 2, process, run)
    os.kill(ranks_of(process)[1], signal.SIGKILL)
    finished(process, run)
    assert "rank 0 of 2: another rank has ended" in log(run).read_text()
    assert [row["update"] for row in read_progress(run)] == list(range(1, 13))
    expected, found = last(tmp_path / "undisturbed"), last(run)
    for name, weights in expected["model"].items():
        assert torch.equal(found["model"][name], weights), name
    assert segments() == set()


def test_all_ranks_end_within_seconds_of_one(tmp_path: Path, segments: Callable[[], set[str]], start: Start) -> None:
    run = tmp_path / "run"
    process = start(run, 2, "--agent", "none", "--environment.engine", "process", *ENDLESS)
    wait_until(lambda: len(read_progress(run)) >= 1, process, run)
    ranks = ranks_of(process)
    os.kill(ranks[0], signal.SIGKILL)
    killed = time.monotonic()
    wait_until(lambda: not Path(f"/proc/{ranks[1]}").exists(), process, run)
    assert time.monotonic() - killed < 10
    assert process.wait(timeout=60) != 0
    assert "rank 1 of 2: another rank has ended" in log(run).read_text()
    assert segments() == set()


def test_interrupted_run_resumes_with_the_same_or_another_number_of_ranks(tmp_path: Path, start: Start) -> None:
    run = tmp_path / "run"
    process = start(run, 2, "--agent", "trxl", *ENDLESS)
    wait_until(lambda: len(read_progress(run)) >= 2, process, run)
    # Like Ctrl-C in a terminal, which torchrun also forwards.
    os.killpg(process.pid, signal.SIGINT)
    process.wait(timeout=100)
    text, done = log(run).read_text(), len(read_progress(run))
    assert f"{done} of 100000 updates done" in text
    assert last(run)["update"] == done

    # With the same ranks it resumes exactly: two more updates equal those of an uninterrupted run.
    more = ["--ppo.updates", str(done + 2)]
    undisturbed = start(tmp_path / "undisturbed", 2, "--agent", "trxl", *more)
    resume = ["--nproc-per-node=2", "-m", "endless_gym_agents.train", "--", "--resume", str(run), *more]
    subprocess.run([*TORCHRUN, *resume], check=True, timeout=250, env=os.environ | {"OMP_NUM_THREADS": "1"})
    finished(undisturbed, tmp_path / "undisturbed")
    for name, weights in last(tmp_path / "undisturbed")["model"].items():
        assert torch.equal(last(run)["model"][name], weights), name

    # With another number of ranks the weights are kept, and all environments start an episode.
    before = last(run)["steps"]
    train(parse(["--resume", str(run), "--ppo.updates", str(done + 3)]))
    assert last(run)["steps"] == before + 8 * 16
    assert [row["update"] for row in read_progress(run)] == list(range(1, done + 4))


def test_no_thread_outlives_the_connection(tmp_path: Path) -> None:
    """A gloo thread that still runs when the interpreter exits can crash the process with a signal."""
    program = tmp_path / "program.py"
    program.write_text(
        f"""
from pathlib import Path
from endless_gym_agents.training.train import parse, train

train(parse({[*ARGUMENTS, "--agent", "gru", "--run", str(tmp_path / "run")]!r}))
names = [file.read_text() for file in Path("/proc/self/task").glob("*/comm")]
assert not any("gloo" in name for name in names), names
"""
    )
    command, environment = [*TORCHRUN, "--nproc-per-node=2", program], os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, env=environment)
    assert done.returncode == 0, done.stderr
    assert len(read_progress(tmp_path / "run")) == 3


def test_environments_that_cannot_be_divided_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("RANK", "0"), ("WORLD_SIZE", "2"), ("MASTER_ADDR", "localhost")):
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match="must be a multiple of 2 groups times 2 ranks, got 6"):
        train(parse([*ARGUMENTS, "--environment.num-envs", "6"]))


@pytest.mark.parametrize("place", [endless_gym.make_vec, endless_gym.serve])
@pytest.mark.parametrize("seeds", [None, range(100)])
def test_parts_of_the_environments_equal_the_whole(place: Callable[..., Any], seeds: range | None) -> None:
    def play(first: int, groups: int, total: int | None) -> list[np.ndarray[Any, Any]]:
        given = {"seed": 3, "seeds": seeds, "groups": groups, "first_env": first, "total_envs": total}
        played = []
        with place("MysteryPath-Grid-v0", 2, 1, autoreset="same_step", options={"max_steps": 3}, **given) as envs:
            for group in range(groups):
                frames = [envs.reset(group=group)[0].copy()]
                for _ in range(8):
                    envs.send(np.array([3, 3]), group)
                    frames.append(envs.recv(group)[0].copy())
                frames.append(envs.reset(seed=11, group=group)[0].copy())
                mask = np.array([False, True])
                frames.append(envs.reset(seed=12, group=group, options={"reset_mask": mask})[0].copy())
                played.append(np.stack(frames))
        return played

    whole = play(0, 3, None)
    parts = play(0, 1, 6) + play(2, 2, 6)
    assert len({frames.tobytes() for frames in whole}) == 3
    for expected, found in zip(whole, parts, strict=True):
        np.testing.assert_array_equal(expected, found)


def test_numbers_of_environments_are_checked() -> None:
    with pytest.raises(ValueError, match="total_envs"):
        endless_gym.make_vec("MysteryPath-v0", 2, groups=2, first_env=4, total_envs=7)
    with pytest.raises(ValueError, match="first_env"):
        endless_gym.serve("MysteryPath-v0", 2, first_env=-1)


def test_rank_of_another_program_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RANK", "3")
    ranks = Ranks()
    assert (ranks.rank, ranks.size, ranks.threads) == (0, 1, None)
    assert ranks.share(6) == range(6)
