"""Helpers for several tests: comparisons of what environments return, and engines started by the program."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import endless_gym
from endless_gym import _native
from endless_gym.program import program

MEMORY_GYM = [id for id in endless_gym.all_specs() if not id.startswith("popgym-")]
WHERE = [endless_gym.make_vec, endless_gym.serve]


def stop(process: int) -> None:
    """Stop a process, and wait until all of its threads have stopped."""
    os.kill(process, signal.SIGSTOP)
    tasks = Path(f"/proc/{process}/task")
    while any(task.joinpath("stat").read_text().rpartition(") ")[2][0] != "T" for task in tasks.iterdir()):
        time.sleep(0.001)


def exact(value: Any) -> Any:
    """A value that compares equal only if every byte is: arrays by dtype, shape and contents. Times are left out."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        return ("array", str(value.dtype), value.shape, value.tobytes())
    if isinstance(value, dict):
        return {key: exact(item) for key, item in value.items() if key != "t"}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [exact(item) for item in value]
    return value


def same(given: Any, wanted: Any, path: str = "") -> None:
    """Assert that all numbers are equal, in arrays, lists, tuples and dicts."""
    if isinstance(wanted, dict):
        assert set(given) == set(wanted), path
        for key, value in wanted.items():
            same(given[key], value, f"{path}.{key}")
    elif isinstance(wanted, (list, tuple)) or (isinstance(wanted, np.ndarray) and wanted.dtype == object):
        assert len(given) == len(wanted), path
        for number, (one, other) in enumerate(zip(given, wanted, strict=True)):
            same(one, other, f"{path}[{number}]")
    else:
        np.testing.assert_array_equal(given, wanted, err_msg=path)


@contextlib.contextmanager
def engine_of_program(service: str, id: str, *arguments: str) -> Iterator[subprocess.Popen]:
    """An engine that `endless serve` runs until the block ends."""
    command = [*program(), "serve", "--child", f"--service={service}", f"--env={id}", *arguments]
    engine = subprocess.Popen(command, stdin=subprocess.PIPE)
    try:
        yield engine
    finally:
        engine.communicate()
    assert engine.returncode in (0, -signal.SIGKILL)


def await_end_of_engines(seconds: float = 10.0) -> None:
    """Assert that all engines end within this time."""
    end = time.monotonic() + seconds
    while endless_gym.running_engines() and time.monotonic() < end:
        time.sleep(0.02)
    assert endless_gym.running_engines() == []


def segments() -> set[str]:
    """The shared memory segments of this test run."""
    prefix = _native.segment_prefix()
    return {name for name in os.listdir("/dev/shm") if name.startswith(prefix)}


def rest_of_terminal(leader: int) -> bytes:
    """Everything that a program writes to a terminal before it closes it."""
    shown = b""
    # Reading at the end of a terminal is an error.
    with contextlib.suppress(OSError):
        while part := os.read(leader, 4096):
            shown += part
    os.close(leader)
    return shown
