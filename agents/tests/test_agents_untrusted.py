"""Files that are no regular files or claim too much, and names that a terminal would obey."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from agents_helpers import saved, settings
from rich.table import Table

from endless_gym.program.printable import printable
from endless_gym_agents.common import command, tables
from endless_gym_agents.evaluation import export, protocol
from endless_gym_agents.training import checkpoint, train

#: Escape sequences of 7 and of 8 bits, a bell, a line break, a direction of text, rich's markup, and a byte that is not UTF-8.
HOSTILE = "\x1b]0;t\x07\x9b2J\n\r\u202e[/red]:smile:\udcff"
ESCAPED = r"\x1b]0;t\x07\x9b2J\n\r\u202e[/red]:smile:\udcff"

Captured = pytest.CaptureFixture[str]


def test_escapes_keep_the_text_of_all_languages() -> None:
    assert printable(HOSTILE) == ESCAPED
    plain = "Größe “5” 'x' \"y\" \\ 文字 🙂"
    assert printable(plain) == plain


@pytest.mark.parametrize("width", [20, 120])
def test_a_console_escapes_texts_and_tables(width: int) -> None:
    console = command.Terminal(width=width, file=io.StringIO(), force_terminal=True, color_system=None, soft_wrap=True)
    made: Table = tables.table("", {HOSTILE: False})
    made.add_row(HOSTILE)
    tables.show(made, console)
    console.print(HOSTILE)
    written = console.file.getvalue()
    assert not any(c in written for c in "\x1b\x07\x9b\r\u202e\udcff")
    assert written.splitlines()[-2:] == [r"\x1b]0;t\x07\x9b2J", r"\r\u202e[/red]:smile:\udcff"]


def test_errors_of_hostile_names_take_one_line(tmp_path: Path, call: Callable[..., int], capsys: Captured) -> None:
    assert call(protocol.main, tmp_path / HOSTILE) == 1
    said = capsys.readouterr().err
    assert r"\x1b]0;t\x07\x9b2J" in said and said.count("\n") == 1 and said.strip().isprintable()


def test_a_run_in_a_folder_whose_name_is_not_utf_8_is_refused(
    tmp_path: Path, call: Callable[..., int], capsys: Captured
) -> None:
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    assert call(train.main, "--env", "MysteryPath-Grid-v0", "--run", folder) == 1
    assert "the name of a run's folder must be UTF-8" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["file.pt", "file.safetensors"])
def test_what_is_not_a_regular_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    fifo = tmp_path / name
    os.mkfifo(fifo)
    with pytest.raises(OSError, match=f"{name} is not a regular file"):
        checkpoint.load(fifo)
    zeros = tmp_path / f"zeros.{name}"
    zeros.symlink_to("/dev/zero")
    with pytest.raises(OSError, match="is not a regular file"):
        checkpoint.load(zeros)


def test_settings_and_results_that_are_no_regular_files_are_refused(
    tmp_path: Path, call: Callable[..., int], capsys: Captured
) -> None:
    os.mkfifo(tmp_path / "settings.json")
    assert call(train.main, "--resume", tmp_path) == 1
    assert "settings.json is not a regular file" in capsys.readouterr().err


def test_a_million_empty_tensors_are_refused_at_once(tmp_path: Path) -> None:
    tensors = {str(number): {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for number in range(1_000_000)}
    header = json.dumps(tensors).encode()
    file = tmp_path / "many.safetensors"
    file.write_bytes(len(header).to_bytes(8, "little") + header)
    with pytest.raises(ValueError, match="far more tensors than a network"):
        checkpoint.load(file)


def test_an_export_prints_its_path_escaped(tmp_path: Path, call: Callable[..., int], capsys: Captured) -> None:
    saved(tmp_path / "run", settings("gru", env="MysteryPath-Grid-v0"))
    call(export.main, tmp_path / "run", "--out", tmp_path / "a\x1b[2Jb")
    assert "\x1b" not in "".join(capsys.readouterr())
