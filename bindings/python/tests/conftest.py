"""Fixtures and markers for all tests."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import segments


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "original_python" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.original)


def _python(variable: str, contents: str) -> str:
    python = os.environ.get(variable)
    if not python:
        pytest.fail(f"{variable} names no Python with {contents}; run `cargo xtask test --all`")
    return python


@pytest.fixture(scope="session")
def original_python() -> str:
    """A Python with the original, memory-gym 1.0.2."""
    return _python("ENDLESS_ORIGINAL_PYTHON", "memory-gym 1.0.2")


@pytest.fixture(scope="session")
def libraries_python() -> str:
    """A Python with the agents and the dependency group `rllib`: Ray, JAX and Jupyter's kernel."""
    return _python("ENDLESS_LIBRARIES_PYTHON", "the group `rllib`")


@pytest.fixture(scope="session")
def gymnasium_python() -> dict[str, str]:
    """Pythons with numpy and only an old Gymnasium, by its version."""
    pythons = _python("ENDLESS_GYMNASIUM_PYTHONS", "old versions of Gymnasium").split(":")
    return dict(python.split("=", 1) for python in pythons)


@pytest.fixture
def ray_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A folder for Ray's logs and sockets, whose paths must be short. Nothing is sent or written elsewhere."""
    with tempfile.TemporaryDirectory(prefix="ray-", dir="/tmp", ignore_cleanup_errors=True) as folder:
        monkeypatch.setenv("RAY_TMPDIR", folder)
        monkeypatch.setenv("RAY_AUTH_MODE", "disabled")  # otherwise it writes a token to the home directory
        monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        monkeypatch.delenv("RAY_ADDRESS", raising=False)  # otherwise it joins that cluster
        yield folder


@pytest.fixture(autouse=True, scope="session")
def sb3_logs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Sets the log folder of Stable-Baselines3 for this process and its children; by default it makes new ones in /tmp."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))


@pytest.fixture(autouse=True, scope="session")
def own_namespace() -> Iterator[Path]:
    """The namespace root of this test run, so that concurrent runs do not see each other's engines and segments."""
    # A short path, since it is part of the path of Unix sockets.
    root = tempfile.mkdtemp(prefix="endless-", dir="/tmp")
    os.environ["ENDLESS_GYM_ROOT"] = root
    # Processes that the tests start import the installed package, not the sources in their working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    yield Path(root)
    left = segments()
    shutil.rmtree(root, ignore_errors=True)
    assert not left, f"left in /dev/shm: {sorted(left)}"
