"""The benchmark that compares with the original runs, and measures everybody."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[3] / "benches/comparison.py"


def test_every_contender_is_measured(original_python: str, tmp_path: Path) -> None:
    id, file = "Endless-MysteryPath-v0", tmp_path / "comparison.json"
    command = [sys.executable, SCRIPT, "--original", original_python, "--ids", id, "--rounds", "1", "--seconds", "0.01"]
    subprocess.run([*command, "--json", file], check=True, timeout=250)
    (row,) = json.loads(file.read_text())["environments"]
    contenders = ["original, gymnasium.make", "gymnasium.make", "make_vec, 1024 environments", "serve, 64 environments"]
    assert {*contenders, "Rust, service, only receives, 64 environments"} <= row["medians"].keys()
    assert all(steps_per_second > 0 for steps_per_second in row["medians"].values())
