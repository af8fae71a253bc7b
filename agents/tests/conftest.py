"""Fixtures of the agents' tests."""

import importlib
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any

import pytest
import support
from shared_fixtures import own_namespace, ray_folder  # noqa: F401


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


@pytest.fixture
def call(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Calls the `main` of a program with arguments, and returns its exit status."""

    def called(main: Callable[[], int], *arguments: object) -> int:
        monkeypatch.setattr(sys, "argv", ["program", *map(str, arguments)])
        return main()

    return called


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of `small("gru", ...)` with four updates."""
    from agents_helpers import small

    from endless_gym_agents.training.train import train

    return train(small("gru", tmp_path_factory.mktemp("undisturbed") / "run", 4))


@pytest.fixture(scope="session")
def segments() -> Callable[[], set[str]]:
    """The shared memory segments of this test run."""
    return support.segments
