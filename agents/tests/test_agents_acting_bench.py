"""The program that measures the time of a rollout's steps, with few repetitions."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[1] / "benches" / "acting.py"


@pytest.mark.slow
def test_the_program(tmp_path: Path) -> None:
    arguments = ("--repetitions", "1", "--segments", "1", "--json", str(tmp_path / "acting.json"))
    done = subprocess.run([sys.executable, str(PROGRAM), *arguments], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = json.loads((tmp_path / "acting.json").read_text())["rows"]
    assert [row["agent"] for row in rows] == ["gru", "trxl"]
    for row in rows:
        assert 0 < row["replay"] < row["rollout"] and 0 < row["inference"] < row["rollout"] and row["act"] > 0
        assert 0 < row["operations"] < row["with_views"]
    assert len(done.stdout.splitlines()) == 2
