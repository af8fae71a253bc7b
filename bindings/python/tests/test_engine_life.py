"""Engines that `serve` started end without a call of `close` when nothing refers to them, and with their process."""

import gc
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from support import segments, stop

import endless_gym

ID = "Endless-MortarMayhem-v0"
ACTIONS = np.zeros((4, 2), dtype=np.int64)


@pytest.fixture
def no_collector() -> Iterator[None]:
    """Disables Python's cyclic garbage collector, so that an engine in a reference cycle would keep running."""
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def play(envs: endless_gym.EndlessVectorEnv) -> np.ndarray:
    envs.reset(seed=1)
    envs.send(ACTIONS)
    envs.recv()
    envs.restore({0: envs.snapshot(1)})
    return envs.step(ACTIONS)[0]


def test_an_engine_ends_when_its_variable_is_reassigned(no_collector: None) -> None:
    observations = []
    for _ in range(3):
        envs = endless_gym.serve(ID, 4)
        observations.append(play(envs))
        assert endless_gym.running_engines() == [envs._engine.service]
    last, process = observations[-1].copy(), envs._engine.pid
    del envs
    assert endless_gym.running_engines() == []
    assert not Path(f"/proc/{process}").exists()
    np.testing.assert_array_equal(observations[-1], last)


def test_an_engine_ends_with_the_wrappers_around_it(no_collector: None) -> None:
    envs = gymnasium.wrappers.vector.TransformReward(endless_gym.serve(ID, 4), abs)
    envs.reset()
    del envs
    assert endless_gym.running_engines() == []


def resources() -> dict[str, object]:
    """What this process and the engines hold: descriptors, threads, child processes, shared memory and other files."""
    root = Path(os.environ.get("ENDLESS_GYM_ROOT", f"/tmp/endless-gym-{os.getuid()}"))
    process = Path("/proc/self")
    return {
        "descriptors": len(os.listdir(process / "fd")),
        "threads": len(os.listdir(process / "task")),
        "children": (process / f"task/{os.getpid()}/children").read_text(),
        "segments": segments(),
        "files": len(list(root.rglob("*"))),
    }


def memory() -> int:
    """Resident memory of this process in kilobytes."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0])


def test_starts_and_stops_of_engine_trainer_and_observer_leave_nothing() -> None:
    starts = 12
    for number in range(starts):
        with endless_gym.serve(ID, 4) as envs, endless_gym.watch(envs._engine.service) as batches:
            play(envs)
            next(batches)
        if number == starts // 3:
            before, kilobytes = resources(), memory()
    assert resources() == before
    assert memory() - kilobytes < 2_000 + 2 * starts


def test_an_engine_ends_when_an_exception_leaves_its_function(no_collector: None) -> None:
    def fails() -> None:
        envs = endless_gym.serve(ID, 4)
        envs.step(ACTIONS)

    with pytest.raises(RuntimeError, match="reset"):
        fails()
    assert endless_gym.running_engines() == []


@pytest.mark.libraries
@pytest.mark.parametrize(
    ("library", "name", "autoreset"), [("sb3", "EndlessVecEnv", "same_step"), ("torchrl", "EndlessEnv", "disabled")]
)
def test_an_engine_ends_with_the_adapter_around_it(library: str, name: str, autoreset: str) -> None:
    adapter = getattr(importlib.import_module(f"endless_gym.{library}"), name)
    envs = adapter(endless_gym.serve(ID, 4, autoreset=autoreset))
    envs.reset()
    assert len(endless_gym.running_engines()) == 1
    del envs
    gc.collect()
    assert endless_gym.running_engines() == []


@pytest.mark.parametrize("end", ["", "raise SystemExit(3)", "undefined_name"])
def test_an_engine_ends_before_its_interpreter_does(end: str) -> None:
    text = f"import endless_gym; envs = endless_gym.serve({ID!r}, 4); print(envs._engine.pid, flush=True); {end}"
    ended = subprocess.run([sys.executable, "-c", text], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, timeout=60)
    assert not Path(f"/proc/{int(ended.stdout)}").exists()
    assert endless_gym.running_engines() == []


def test_a_trainer_killed_while_its_interpreter_exits_leaves_no_shared_memory() -> None:
    """A thread keeps the environments alive; the handler that kills runs after the one that ends the engine."""
    text = f"""
import atexit, os, signal, threading
atexit.register(os.kill, os.getpid(), signal.SIGKILL)
import endless_gym
envs = endless_gym.serve({ID!r}, 4)
envs.reset()
threading.Thread(target=lambda envs: threading.Event().wait(), args=[envs], daemon=True).start()
"""
    assert subprocess.run([sys.executable, "-c", text], timeout=60).returncode == -signal.SIGKILL
    assert not segments()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_close_ends_the_engine_while_a_forked_child_lives() -> None:
    envs = endless_gym.serve(ID, 4)
    envs.reset()
    with pytest.raises(ConnectionError, match="already has a trainer"):
        endless_gym.connect(envs._engine.service, timeout=1)
    child = os.fork()
    if child == 0:
        signal.pause()
        os._exit(0)
    try:
        process = envs._engine._process
        envs.close()
        # The engine ended by itself; it was not killed after a timeout.
        assert process.returncode == 0
        envs.close()
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_signal_handler_closes_environments_that_wait_for_the_engine() -> None:
    envs = endless_gym.serve(ID, 1)
    envs.reset()
    process = envs._engine._process
    stop(process.pid)
    before = signal.signal(signal.SIGALRM, lambda *_: envs.close())
    signal.setitimer(signal.ITIMER_REAL, 0.3)
    try:
        with pytest.raises(RuntimeError, match="the environments are closed"):
            envs.step(envs.action_space.sample())
    finally:
        signal.signal(signal.SIGALRM, before)
    assert process.returncode == 0
