"""Programs that need Gymnasium 0.29 and numpy 1, like the original, run with this package in its place."""

import json
import os
import subprocess
from pathlib import Path

import pytest

import endless_gym


@pytest.fixture
def environment(tmp_path: Path) -> dict[str, str]:
    """Variables with which the original's Python also finds the package under test."""
    (tmp_path / "endless_gym").symlink_to(Path(endless_gym.__file__).parent)
    return {**os.environ, "PYTHONPATH": str(tmp_path), "SDL_VIDEODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1"}


def test_env_plays_as_the_original_under_gymnasium_029(original_python: str, environment: dict[str, str]) -> None:
    program = Path(__file__).parent / "older_gymnasium.py"
    records = []
    for module in ("memory_gym", "endless_gym.memory_gym"):
        command = [original_python, "-W", "ignore", program, module]
        ran = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        # The original's libraries print other lines first.
        records.append(json.loads(ran.stdout.splitlines()[-1]))
    original, ours = records
    assert original.keys() == ours.keys()
    for id, entries in original.items():
        for number, (wanted, given) in enumerate(zip(entries, ours[id], strict=True)):
            assert given == wanted, f"{id}, entry {number}"


def test_vector_environments_ask_for_a_newer_gymnasium(original_python: str, environment: dict[str, str]) -> None:
    program = """
import endless_gym, gymnasium
print(gymnasium.__version__)
for name in ("make_vec", "serve", "connect", "EndlessVectorEnv"):
    try:
        getattr(endless_gym, name)
    except ImportError as error:
        print(error)
"""
    command = [original_python, "-c", program]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    version, *messages = ran.stdout.splitlines()
    assert version.startswith("0.29")
    assert len(messages) == 4
    assert all("need Gymnasium 1.1 or newer, and 0.29" in message for message in messages)
