"""Fixtures of the agents' tests."""

import importlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest

from endless_gym import _native


@pytest.fixture
def ray_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A folder for Ray's logs and sockets, whose paths must be short; Ray writes and sends nothing elsewhere."""
    with tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # otherwise Ray writes a token to the home directory
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        monkeypatch.delenv("RAY_ADDRESS", raising=False)  # otherwise Ray joins that cluster
        yield folder


@pytest.fixture
def in_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the commands of jobs in this process, one after the other, without the start of another one."""
    from endless_gym_agents.paper import jobs

    def start(machine: jobs.Machine, command: Sequence[str], slot: int, lock: IO[str], log: IO[str]) -> Any:
        main = importlib.import_module(jobs._MODULES[command[0]]).main
        with redirect_stdout(log), redirect_stderr(log), monkeypatch.context() as patch:
            patch.setattr(sys, "argv", list(command))
            status = main()
        return SimpleNamespace(poll=lambda: status)

    monkeypatch.setattr(jobs.Machine, "start", start)
    monkeypatch.setattr(jobs, "_POLL", 0.0)


@pytest.fixture(scope="session")
def undisturbed(own_namespace: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `small("gru", ...)` with four updates."""
    from agents_helpers import small

    from endless_gym_agents.training.train import train

    return train(small("gru", tmp_path_factory.mktemp("undisturbed") / "run", 4))


@pytest.fixture(autouse=True, scope="session")
def own_namespace() -> Iterator[None]:
    """A namespace root of this test run, so that concurrent runs do not see each other's engines and segments."""
    # A short path, since it is part of the path of Unix sockets.
    root = tempfile.mkdtemp(prefix="endless-", dir="/tmp")
    os.environ["ENDLESS_GYM_ROOT"] = root
    # Processes that the tests start import the installed packages, not the sources in their working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    yield
    left = _segments()
    shutil.rmtree(root, ignore_errors=True)
    assert not left, f"left in /dev/shm: {sorted(left)}"


@pytest.fixture(scope="session")
def segments(own_namespace: None) -> Callable[[], set[str]]:
    """The shared memory segments of this test run."""
    return _segments


def _segments() -> set[str]:
    prefix = _native.segment_prefix()
    return {name for name in os.listdir("/dev/shm") if name.startswith(prefix)}
