"""Fixtures of the tests of both Python packages; each `conftest.py` imports them."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from support import segments


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
def own_namespace() -> Iterator[Path]:
    """The namespace root of this test run, so that concurrent runs do not see each other's engines and segments."""
    # A short path, since it is part of the path of Unix sockets.
    root = tempfile.mkdtemp(prefix="endless-", dir="/tmp")
    os.environ["ENDLESS_GYM_ROOT"] = root
    # Processes that the tests start import the installed packages, not the sources in their working directory.
    os.environ["PYTHONSAFEPATH"] = "1"
    yield Path(root)
    left = segments()
    shutil.rmtree(root, ignore_errors=True)
    assert not left, f"left in /dev/shm: {sorted(left)}"
