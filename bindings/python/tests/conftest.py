"""What the tests share."""

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def original_python() -> str:
    """A Python that has the original, memory-gym 1.0.2."""
    python = os.environ.get("ENDLESS_ORIGINAL_PYTHON")
    if not python:
        pytest.fail("ENDLESS_ORIGINAL_PYTHON names no Python with memory-gym 1.0.2; run `cargo xtask test`")
    return python


@pytest.fixture(autouse=True, scope="session")
def own_namespace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Engines of these tests meet nobody else's, and leave nothing behind."""
    root = tmp_path_factory.mktemp("gym", numbered=True)
    os.environ["ENDLESS_GYM_ROOT"] = str(root)
    # Processes that the tests start take the installed package, not the sources where they are started.
    os.environ["PYTHONSAFEPATH"] = "1"
    before = set(os.listdir("/dev/shm"))
    yield root
    left = {name for name in set(os.listdir("/dev/shm")) - before if name.startswith("endless")}
    assert not left, f"left in /dev/shm: {sorted(left)}"
