"""Tables in terminals of any width."""

from __future__ import annotations

import io

import pytest
from rich.console import Console
from rich.table import Table

from endless_gym_agents.common import tables
from endless_gym_agents.evaluation import probe, protocol
from endless_gym_agents.evaluation.results import Experiment, Run


def evaluated() -> Table:
    """The table of `endless-eval` with long numbers, a marked metric and a caption."""
    run = Run("run", 1)
    run.add(1_638_400_000, [{"reward": -1234.5678, "success": 1.0, "task_progress": 0.39, "seed": 1.0}] * 3)
    return protocol.table(Experiment("MortarMayhem-Grid-v0", "gated-transformer-xl", {}, [run]))


def probed() -> Table:
    """The table of `endless-probe`."""
    columns = ("stamina_of_the_path", "command_right_down")
    scores = [probe.Score(name, "observation", "linear", 0.25, 0.5, 0.5, 0.987, 0.456) for name in columns]
    return probe.table("Endless-MysteryPath-v0, 1,234,567 steps", scores)


@pytest.mark.parametrize("made", [evaluated(), probed()])
def test_no_word_and_no_number_breaks_in_a_narrow_terminal(made: Table) -> None:
    cells = [str(cell) for column in made.columns for cell in (column.header, *column.cells)]
    words = {word for text in (*cells, str(made.title), str(made.caption or "")) for word in text.split()}
    heights = []
    for width in (120, 80, 60, 40):
        console = Console(width=width, record=True, file=io.StringIO(), force_terminal=True)
        tables.show(made, console)
        text = console.export_text()
        assert max(len(line.rstrip()) for line in text.splitlines()) <= width
        assert words <= set(text.split()), f"{width}: {text}"
        heights.append(len(text.splitlines()))
    assert heights[0] < heights[-1]


def test_a_pipe_gets_a_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    tables.show(probed(), Console())
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["command_right_down", "observation", "linear", "0.2500", "0.5000", "0.500", "0.987", "0.456"] in rows
