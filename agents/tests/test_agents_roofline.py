"""The program that counts the floating-point operations of training on the CPU."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = Path(__file__).parents[1] / "benches" / "roofline.py"
#: FLOP of the three convolutions for one frame: output positions x output channels x inputs, a multiplication and an addition.
ENCODER = 2 * (20 * 20 * 32 * (8 * 8 * 3) + 9 * 9 * 64 * (4 * 4 * 32) + 7 * 7 * 64 * (3 * 3 * 64))


@pytest.mark.slow
def test_the_operations_are_those_of_the_network(tmp_path: Path) -> None:
    file = tmp_path / "roofline.json"
    arguments = ["--num-envs", "2", "--steps", "64", "--updates", "1", "--json", str(file)]
    done = subprocess.run([sys.executable, str(PROGRAM), *arguments], capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stderr
    results = {(row["agent"], row["phase"]): row for row in json.loads(file.read_text())["results"]}
    assert results.keys() == {(agent, phase) for agent in ("gru", "trxl") for phase in ("rollout", "learning")}
    for (agent, phase), row in results.items():
        operations = row["operations"]
        # One call for each step and one for the value after the last; three epochs of learning.
        frames = 2 * (64 + 1) if phase == "rollout" else 3 * 2 * 64
        # Equal frames are encoded once.
        encoded, rest = divmod(operations["convolution"]["flop"], ENCODER)
        assert rest == 0 and frames / 4 < encoded < frames, (agent, phase)
        if phase == "learning":
            # The gradients of the weights cost as much as the outputs; so do those of the inputs, which the frames do not need.
            first = 2 * 20 * 20 * 32 * (8 * 8 * 3)
            assert operations["convolution_backward"]["flop"] == encoded * (2 * ENCODER - first), (agent, phase)
        assert f"{agent}, {phase}, 2 x 64 steps" in done.stdout
    # The preset `paper` learns from single steps, whose attention is matrix products.
    acting, learning = (results["trxl", phase]["operations"] for phase in ("rollout", "learning"))
    assert acting["_scaled_dot_product_flash_attention_for_cpu"]["flop"] > 0
    assert learning["bmm"]["flop"] > 0
