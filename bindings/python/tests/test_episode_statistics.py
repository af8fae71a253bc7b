"""`RecordEpisodeStatistics` under several versions of Gymnasium."""

import os
import subprocess
from pathlib import Path

import pytest
from episode_statistics import compare

import endless_gym


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_statistics_are_those_of_the_engine(autoreset: str) -> None:
    ended, _ = compare(autoreset)
    assert ended > 50


@pytest.mark.libraries
@pytest.mark.parametrize("version", ["1.1.0", "1.2.3"])
def test_statistics_are_right_where_gymnasiums_are_not(
    version: str, gymnasium_python: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "endless_gym").symlink_to(Path(endless_gym.__file__).parent)
    program = Path(__file__).parent / "episode_statistics.py"
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    ran = subprocess.run([gymnasium_python[version], program], env=environment, capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr
    found, *counts = ran.stdout.split()
    same, wrong_same, following, wrong_following = map(int, counts)
    assert found == version
    # Gymnasium's fault, for which this wrapper exists: when its oldest supported version has no such fault, the wrapper can go.
    assert same > 50 and wrong_same > same / 2
    assert following > 50 and wrong_following == 0
