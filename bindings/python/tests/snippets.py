"""The fenced code blocks of Markdown files.

A comment before a block says how to treat it; readers of the page do not see it:

    <!-- not run: REASON -->    the block is not run; the reason is reported
    <!-- continues -->          the block is run after the one before it, in the same folder; Python blocks share their names
    <!-- libraries -->          the block is run with the dependency group `rllib`
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[3]
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[a-z]*)(?P<attributes>\S*)[^\n]*\n(?P<code>.*?)^(?P=indent)```$", re.M | re.S
)
COMMENT = re.compile(r"<!-- (not run: (?P<reason>.+?)|(?P<continues>continues)|(?P<libraries>libraries)) -->\s*\Z")
SHELL = ("sh", "bash", "console")


@dataclass(frozen=True)
class Block:
    """A fenced code block."""

    file: Path
    line: int
    language: str
    code: str
    #: Why it is not run.
    reason: str = ""
    continues: bool = False
    libraries: bool = False

    @property
    def name(self) -> str:
        return f"{self.file.relative_to(ROOT)}:{self.line}"


def pages() -> list[Path]:
    """Every page for users."""
    return [ROOT / "README.md", ROOT / "bindings/python/README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(file: Path) -> Iterator[Block]:
    """The blocks of a file, in order."""
    text = file.read_text()
    for found in FENCE.finditer(text):
        comment = COMMENT.search(text[: found.start()])
        reason = (comment and comment["reason"]) or ""
        continues, libraries = (bool(comment and comment[name]) for name in ("continues", "libraries"))
        line = text[: found.start()].count("\n") + 1
        yield Block(file, line, found["language"], textwrap.dedent(found["code"]), reason, continues, libraries)


def programs(file: Path) -> list[list[Block]]:
    """The blocks that run, each with those that continue it."""
    runs: list[list[Block]] = []
    for block in blocks(file):
        if block.reason or block.language not in ("python", *SHELL):
            continue
        if block.continues:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs
