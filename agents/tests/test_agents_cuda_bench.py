"""The program that measures the agents on CUDA: its parts that run on the CPU."""

import json
import subprocess
import sys
import time
from pathlib import Path

from endless_gym_agents.settings import AGENTS

PROGRAM = Path(__file__).parents[1] / "benches" / "on_cuda.py"


def test_parts_that_need_no_gpu_run_on_the_cpu(tmp_path: Path) -> None:
    timed = ("gru", "trxl", "mingru", "lru")
    files = ("--json", str(tmp_path / "cuda.json"), "--markdown", str(tmp_path / "cuda.md"))
    command = [sys.executable, str(PROGRAM), "--device", "cpu", "--seconds", "0.1", *files]
    command += ["--agents", *timed, "nonsense"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400)
    assert done.returncode == 1, done.stderr
    report = json.loads((tmp_path / "cuda.json").read_text())
    # On the CPU both sides are the same.
    assert [row["agent"] for row in report["equality"]] == list(AGENTS)
    assert all(row["largest_difference"] == 0.0 for row in report["equality"])
    sizes = [(agent, *size) for size in ((4, 16, False), (8, 16, True)) for agent in timed]
    assert [(row["agent"], row["num_envs"], row["steps"], row["bf16"]) for row in report["training"]] == sizes
    for row in report["training"]:
        assert row["steps_per_second"] > 0 and row["updates"] > 0 and row["cpu_cores"] > 0
        assert row["shares_of_time"].keys() == {"stepping", "inference", "learning"}
        assert sum(row["shares_of_time"].values()) <= 1.0
    assert report["learning"][0]["steps"] == 4 * 64 and report["learning"][0]["seconds"] > 0
    assert [failure.split(":")[0] for failure in report["failures"]] == ["nonsense, 4 x 16", "nonsense, 8 x 16"]
    text = (tmp_path / "cuda.md").read_text()
    assert text.startswith("# The agents on the CPU") and "| gru | 4 " in text
    assert text in done.stdout


def test_a_run_that_is_cut_off_leaves_its_results(tmp_path: Path) -> None:
    file = tmp_path / "cuda.json"
    command = [sys.executable, str(PROGRAM), "--device", "cpu", "--json", str(file)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while not file.exists() and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    assert json.loads(file.read_text())["equality"][0]["agent"] == AGENTS[0]
