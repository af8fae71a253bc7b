"""The checks of a memory: all memories of the package pass them, and memories with mistakes do not."""

import contextlib
import os
import pty
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from endless_gym_agents.evaluation import conformance
from endless_gym_agents.memories import MEMORIES

OPTIONS = ("mingru positive=true", "shm stride=0 limit=100")


@pytest.mark.parametrize("given", ["gru", "lstm", "trxl", "gtrxl", *MEMORIES, *OPTIONS])
def test_the_memories_of_the_package_pass(given: str) -> None:
    name, *options = given.split()
    # The cache of a transformer is as long as its window, so fewer steps suffice.
    results = list(
        conformance.check(name, tuple(options), 500 if "trxl" in name else 1000, 500 if "trxl" in name else 10_000)
    )
    assert [result.name for result in results if not result.passed] == []
    names = {result.name for result in results}
    assert names >= {"agreement", "reset", "size", "leak", "finite"}
    assert ("gradient" in names) == ("trxl" not in name)


@pytest.mark.parametrize(("page", "name"), [("memories", "Average"), ("own-agents", "MinGRU")])
def test_the_memories_of_the_documentation_pass(page: str, name: str, tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "train" / f"{page}.md").read_text()
    (tmp_path / "own.py").write_text(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0])
    assert all(result.passed for result in conformance.check(f"{tmp_path}/own.py:{name}"))


MISTAKES = '''
import torch
from endless_gym_agents.memories.scans import linear_scan
from endless_gym_agents.memories.sequence_model import SequenceModel


class Right(SequenceModel):
    """A running mean with the rate 0.1."""

    def __init__(self, input_width, width):
        super().__init__()
        self.width, self.state_shapes = width, {"h": (width,)}
        self.projection = torch.nn.Linear(input_width, width)

    def step(self, x, state):
        h = 0.9 * state["h"] + 0.1 * self.projection(x)
        return h, {"h": h}

    def sequence(self, x, state, resets):
        y = linear_scan(torch.tensor(0.9), 0.1 * self.projection(x), state["h"], resets)
        return y, {"h": y[-1]}


class IgnoresResets(Right):
    def sequence(self, x, state, resets):
        return super().sequence(x, state, torch.zeros_like(resets))


class SeesTheFuture(Right):
    def sequence(self, x, state, resets):
        return super().sequence(x + 1e-7 * x.roll(-1, 0), state, resets)


class CutsGradients(Right):
    def sequence(self, x, state, resets):
        y, state = super().sequence(x, state, resets)
        return y.detach() + 0.1 * (self.projection(x) - self.projection(x).detach()), state


class Rounds(Right):
    def sequence(self, x, state, resets):
        y, state = super().sequence(x, state, resets)
        return y + 2e-5, state


class Overflows(Right):
    def step(self, x, state):
        h = 1.1 * state["h"] + self.projection(x)
        return h, {"h": h}

    sequence = SequenceModel.sequence


class Vanishes(Right):
    def step(self, x, state):
        y = self.projection(x) * (state["h"] < 300)
        return y, {"h": state["h"] + 1}

    sequence = SequenceModel.sequence


class Global(Right):
    """Its steps share a state that no reset clears."""

    count = 0.0

    def step(self, x, state):
        self.count += 0.001
        y, state = super().step(x, state)
        return y + self.count, state


class Plain(torch.nn.Module):
    """A cell as `CellMemory` takes it."""

    def __init__(self, input_width, width):
        super().__init__()
        self.cell = torch.nn.GRUCell(input_width, width)

    def forward(self, x, state):
        state = self.cell(x, state)
        return state, state
'''


@pytest.mark.parametrize(
    ("name", "failed"),
    [
        ("Right", set()),
        ("Plain", set()),
        ("IgnoresResets", {"agreement", "gradient", "leak"}),
        ("SeesTheFuture", {"leak"}),
        ("CutsGradients", {"gradient", "memory"}),
        ("Rounds", {"agreement"}),
        ("Overflows", {"finite"}),
        ("Vanishes", {"finite"}),
        ("Global", {"agreement", "reset"}),
    ],
)
def test_a_mistake_is_found(name: str, failed: set[str], tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(MISTAKES)
    results = conformance.check(f"{tmp_path}/own.py:{name}", steps=200, long=1000)
    assert {result.name for result in results if not result.passed} >= failed
    if not failed:
        assert all(result.passed for result in conformance.check(f"{tmp_path}/own.py:{name}", steps=200, long=1000))


def test_the_program_prints_the_checks_and_fails_if_one_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "own.py").write_text(MISTAKES)
    monkeypatch.chdir(tmp_path)
    for name, status in (("Right", 0), ("Rounds", 1)):
        assert call(conformance.main, f"own.py:{name}", "--steps", 100, "--long-steps", 200) == status
        printed = capsys.readouterr()
        assert ("FAILED  agreement" in printed.out) == bool(status)
        assert "the last check plays 200 steps and is the longest: about " in printed.err
    assert "own.py:Rounds fails agreement" in printed.err


def test_a_terminal_shows_how_much_of_the_time_has_passed(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(MISTAKES)
    terminal, other = pty.openpty()
    command = [sys.executable, "-m", "endless_gym_agents.conformance", "own.py:Plain", "--steps", "300"]
    env = os.environ | {"TERM": "xterm", "COLUMNS": "100"}
    with subprocess.Popen(command, cwd=tmp_path, env=env, stdout=other, stderr=other) as process:
        os.close(other)
        shown = b""
        with contextlib.suppress(OSError):  # the end of the program
            while part := os.read(terminal, 10_000):
                shown += part
    os.close(terminal)
    text = shown.decode()
    assert process.returncode == 0 and "passed  finite" in text
    assert re.search(r"checking \S*━+.*0:00:0\d", text)


def test_an_agent_without_memory_is_refused() -> None:
    with pytest.raises(ValueError, match="agent `none` has no memory to check"):
        list(conformance.check("none"))
