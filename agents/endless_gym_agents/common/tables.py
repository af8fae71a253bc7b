"""Tables that the commands print or write."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence

from rich import box
from rich.console import Console, Group, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

#: Width in characters of output that is not a terminal.
PIPE_WIDTH = 120
#: Wider than any table.
_UNLIMITED = 10_000


def table(title: str, columns: dict[str, bool], caption: str = "") -> Table:
    """An empty table.

    Args:
        title: The line above it; empty for none.
        columns: The columns' names, and whether they are aligned to the right.
        caption: The text below it; empty for none.
    """
    made = Table(
        title=title or None, title_justify="left", caption=caption or None, box=box.SIMPLE, padding=(0, 1, 0, 0)
    )
    made.caption_justify = "left"
    for name, right in columns.items():
        made.add_column(name, justify="right" if right else "left", no_wrap=True)
    return made


def markdown(columns: Mapping[str, bool], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table in Markdown; `columns` as for `table`."""
    ends = ("---:" if right else "---" for right in columns.values())
    return [f"| {' | '.join(row)} |" for row in (columns, ends, *rows)]


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([columns, *rows])
    return text.getvalue()


def show(made: Table, console: Console) -> None:
    """Print a table. If it is wider than the console, print a block of lines for each row, so that no word or number breaks.

    A console that is not a terminal becomes at least `PIPE_WIDTH` wide.
    """
    if not console.is_terminal:
        console.width = max(console.width, PIPE_WIDTH)
    needed = Measurement.get(console, console.options.update(max_width=_UNLIMITED), made).maximum
    console.print(made if needed <= console.width else _lines(made), soft_wrap=False)


def _lines(made: Table) -> RenderableType:
    """The title, a block of lines for each row, and the caption."""
    cells = [list(column.cells) for column in made.columns]
    parts: list[RenderableType] = [made.title] if isinstance(made.title, str) else []
    for row in zip(*cells, strict=True):
        block = Table.grid(padding=(0, 2, 0, 0))
        block.add_column(no_wrap=True, min_width=max(len(str(column.header)) for column in made.columns))
        block.add_column()
        for column, cell in zip(made.columns, row, strict=True):
            block.add_row(column.header, cell)
        parts += [Text(), block]
    if isinstance(made.caption, str):
        parts += [Text(), made.caption]
    return Group(*parts)
