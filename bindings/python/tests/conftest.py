"""Fixtures and markers for all tests."""

import os

import pytest
from shared_fixtures import own_namespace, ray_folder  # noqa: F401


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


@pytest.fixture(autouse=True, scope="session")
def sb3_logs(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Sets the log folder of Stable-Baselines3 for this process and its children; by default it makes new ones in /tmp."""
    os.environ["SB3_LOGDIR"] = str(tmp_path_factory.mktemp("sb3"))
