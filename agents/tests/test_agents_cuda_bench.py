"""The program that measures the agents on CUDA: its parts that run on the CPU, and its message without a GPU."""

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from recorded_graphs import RecordedGraphs

PROGRAM = Path(__file__).parents[1] / "benches" / "on_cuda.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(PROGRAM), *arguments], capture_output=True, text=True, timeout=400)


@pytest.mark.slow
def test_the_parts_that_need_no_gpu(tmp_path: Path) -> None:
    files = ("--json", str(tmp_path / "cuda.json"), "--markdown", str(tmp_path / "cuda.md"))
    done = run("--device", "cpu", "--updates", "1", *files)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "cuda.json").read_text())
    # On the CPU both sides are the same.
    assert [row["agent"] for row in report["equality"]] == ["none", "stack", "position", "gru", "lstm", "trxl", "gtrxl"]
    assert all(row["largest_difference"] == 0.0 for row in report["equality"])
    assert [row["agent"] for row in report["graphs"]] == ["gru", "trxl"]
    for row in report["graphs"]:
        # On the CPU there are no graphs.
        assert (row["largest_difference"], row["refused"], row["equal"]) == (0.0, [], True)
        assert 0 < row["with"]["inference_seconds"] < row["with"]["seconds"]
    assert [(row["agent"], row["num_envs"], row["steps"]) for row in report["training"]] == [
        ("gru", 4, 16),
        ("trxl", 4, 16),
    ]
    for row in report["training"]:
        assert row["steps_per_second"] > 0
        assert row["shares_of_time"].keys() == {"stepping", "inference", "learning"}
        assert sum(row["shares_of_time"].values()) <= 1.0
    assert report["left_out"] == []
    text = (tmp_path / "cuda.md").read_text()
    assert text.startswith("# The agents on the CPU") and "| gru | 4 " in text
    assert text in done.stdout


def test_rollouts_with_graphs_are_compared() -> None:
    """With graphs on the CPU that behave as CUDA's."""
    specification = importlib.util.spec_from_file_location("on_cuda", PROGRAM)
    assert specification is not None and specification.loader is not None
    program = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(program)
    device = torch.device("cpu")
    for agent in ("gru", "trxl"):
        recorded = RecordedGraphs()
        row = program.compared_rollouts(program.networks(agent), device, recorded, segments=3)
        # Without graphs, the attention on the CPU is as short as the episodes, and equal frames are encoded once.
        assert row["equal"] and row["largest_difference"] < 1e-5
        assert len(recorded.captures) == 2 and recorded.replays >= 2 * 3 * 16

    class Wrong(RecordedGraphs):
        def capture(self, function: Callable[[], None]) -> Callable[[], None]:
            super().capture(function)
            return lambda: None

    row = program.compared_rollouts(program.networks("gru"), device, Wrong(), segments=2)
    assert not row["equal"] and "CUDA graphs are not used" in row["refused"][0]


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_cuda_it_says_so_and_fails() -> None:
    done = run()
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "on_cuda.py: PyTorch finds no CUDA device; `--device cpu` tests this program without one\n"
