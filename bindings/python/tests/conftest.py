"""What the tests share."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from endless_gym import _native


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if "original_python" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.original)


@pytest.fixture(scope="session")
def original_python() -> str:
    """A Python that has the original, memory-gym 1.0.2."""
    python = os.environ.get("ENDLESS_ORIGINAL_PYTHON")
    if not python:
        pytest.fail("ENDLESS_ORIGINAL_PYTHON names no Python with memory-gym 1.0.2; run `cargo xtask test`")
    return python


@pytest.fixture(autouse=True, scope="session")
def own_namespace() -> Iterator[Path]:
    """A namespace root of this test run, so that runs at the same time do not see each other's engines and segments."""
    # A short path, since it is part of the path of Unix sockets.
    root = tempfile.mkdtemp(prefix="endless-", dir="/tmp")
    os.environ["ENDLESS_GYM_ROOT"] = root
    # Processes that the tests start import the installed package, not the sources in their working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    yield Path(root)
    left = _segments()
    shutil.rmtree(root, ignore_errors=True)
    assert not left, f"left in /dev/shm: {sorted(left)}"


@pytest.fixture(scope="session")
def segments(own_namespace: Path) -> Callable[[], set[str]]:
    """The shared memory segments of this test run."""
    return _segments


def _segments() -> set[str]:
    prefix = _native.segment_prefix()
    return {name for name in os.listdir("/dev/shm") if name.startswith(prefix)}
