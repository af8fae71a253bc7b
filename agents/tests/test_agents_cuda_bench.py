"""The program that measures the agents on CUDA: its parts that run on the CPU."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from endless_gym_agents.settings import AGENTS

PROGRAM = Path(__file__).parents[1] / "benches" / "on_cuda.py"


@pytest.mark.slow
def test_parts_that_need_no_gpu_run_on_the_cpu(tmp_path: Path) -> None:
    files = ("--json", str(tmp_path / "cuda.json"), "--markdown", str(tmp_path / "cuda.md"))
    command = [sys.executable, str(PROGRAM), "--device", "cpu", "--updates", "1", *files]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "cuda.json").read_text())
    # On the CPU both sides are the same.
    assert [row["agent"] for row in report["equality"]] == list(AGENTS)
    assert all(row["largest_difference"] == 0.0 for row in report["equality"])
    assert [(row["agent"], row["num_envs"], row["steps"], row["engine"]) for row in report["training"]] == [
        ("gru", 4, 16, "thread"),
        ("trxl", 4, 16, "thread"),
        ("gru", 4, 16, "process"),
    ]
    for row in report["training"]:
        assert row["steps_per_second"] > 0
        assert row["shares_of_time"].keys() == {"stepping", "inference", "learning"}
        assert sum(row["shares_of_time"].values()) <= 1.0
    assert report["left_out"] == []
    text = (tmp_path / "cuda.md").read_text()
    assert text.startswith("# The agents on the CPU") and "| gru | 4 " in text
    assert text in done.stdout
