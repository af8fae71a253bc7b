"""Every fenced code block of the documentation runs as shown, and sessions (`>>>`) print what they show.

A comment before a block, which readers of the page do not see, says how to treat it:

    <!-- not run: REASON -->    the block is not run, for that reason
    <!-- continues -->          the block is run after the one before it, in the same folder; Python blocks share their names
    <!-- libraries -->          the block is run with the dependency group `rllib`
"""

from __future__ import annotations

import doctest
import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from itertools import groupby
from pathlib import Path

import pytest
from support import segments

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
    """The blocks that run, each with the blocks that continue it."""
    runs: list[list[Block]] = []
    for block in blocks(file):
        if block.reason or block.language not in ("python", *SHELL):
            continue
        if block.continues:
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs


TIMEOUT = 280
#: Fails if the block leaves programs running, after it has ended them so that engines remove their segments.
END_JOBS = """status=$?
for _ in {1..100}; do [ "$(jobs -pr)" ] || exit $status; sleep 0.1; done
jobs; kill -TERM $(jobs -pr); wait; exit 99"""
ALL_PROGRAMS = [program for page in pages() for program in programs(page)]
PROGRAMS = [program for program in ALL_PROGRAMS if not program[0].libraries]
OF_LIBRARIES = [program for program in ALL_PROGRAMS if program[0].libraries]
SESSIONS = [block for page in pages() for block in blocks(page) if block.language == "pycon"]
PACKAGE = ROOT / "bindings/python/endless_gym"
MODULES = [path for path in sorted(PACKAGE.rglob("*.py")) if ">>> " in path.read_text()]
LANGUAGES = {"python", "pycon", "rust", "text", "toml", "yaml", "dockerfile", *SHELL}


@pytest.mark.parametrize("block", SESSIONS, ids=lambda block: block.name)
def test_session_prints_what_it_shows(block: Block) -> None:
    session = doctest.DocTestParser().get_doctest(block.code, {}, block.name, str(block.file), block.line)
    assert not doctest.DocTestRunner().run(session).failed


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.stem)
def test_docstring_prints_what_it_shows(path: Path) -> None:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    results = doctest.testmod(import_module(".".join(parts).removesuffix(".__init__")))
    assert results.attempted and not results.failed


@pytest.mark.slow
@pytest.mark.libraries
@pytest.mark.parametrize("program", [pytest.param(program, id=program[0].name) for program in PROGRAMS])
def test_snippet_runs(program: list[Block], tmp_path: Path) -> None:
    for is_shell, part in groupby(program, lambda block: block.language in SHELL):
        code = "\n".join(block.code for block in part)
        shell = ["bash", "-euo", "pipefail", "-m", "-c", f"trap '{END_JOBS}' EXIT\n{code}"]
        run(shell if is_shell else [sys.executable, "-c", code], tmp_path, program[0].name)
    assert not segments(), "the block left segments in /dev/shm"


@pytest.mark.slow
@pytest.mark.libraries
@pytest.mark.parametrize("program", [pytest.param(program, id=program[0].name) for program in OF_LIBRARIES])
def test_library_snippet_runs(program: list[Block], tmp_path: Path, libraries_python: str, ray_folder: str) -> None:
    assert [block.language for block in program] == ["python"] * len(program)
    code = "\n".join(block.code for block in program)
    run([libraries_python, "-c", code], tmp_path, program[0].name)
    assert not segments(), "the block left segments in /dev/shm"


def run(command: list[str], folder: Path, name: str) -> None:
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=TIMEOUT,
    )
    assert done.returncode == 0, f"{name} ended with {done.returncode}:\n{done.stdout}"


def test_blocks_have_a_known_language() -> None:
    for page in pages():
        found = list(blocks(page))
        assert page.read_text().count("```") == 2 * len(found), f"{page} has a fence that is not recognised"
        for block in found:
            assert block.language in LANGUAGES, block.name
            # The integration tests run the examples.
            assert block.language != "rust", f"{block.name}: link a file of docs/examples instead"


def test_snippets_of_docstrings_define_their_names() -> None:
    sources = sorted(PACKAGE.rglob("*.py"))
    snippets = [block for path in sources for block in blocks(path) if block.language == "python"]
    assert len(snippets) >= 5
    ruff = [Path(sys.executable).parent / "ruff", "check", "--isolated", "--select", "F", "--ignore", "F401", "-"]
    for snippet in snippets:
        checked = subprocess.run(ruff, input=snippet.code, capture_output=True, text=True)
        assert checked.returncode == 0, f"{snippet.name}: {checked.stdout}"


#: Files that may show a command that a reader copies.
SOURCES = (
    "*.md",
    "bindings/python/endless_gym/**/*.py",
    "bindings/python/examples/*.py",
    "engine/cli/src/**/*.rs",
    "docs/**/*.md",
)
#: A word with unquoted brackets, after a program or in an argument, which zsh would treat as a file name pattern.
GLOB = re.compile(r"""(?:pip install|--option|--environment\.option)[ =](?:[^'"`\s]+ )*[^'"`\s]*\[""")


def test_shells_take_commands_literally() -> None:
    """zsh, unlike bash, refuses a word with brackets that matches no file."""
    blocks_of_shell = [block for page in pages() for block in blocks(page) if block.language in SHELL]
    unquoted = [
        f"{block.name}: {word}"
        for block in blocks_of_shell
        for line in re.sub(r"(<<'EOF'.*?^EOF$)", "", block.code, flags=re.M | re.S).splitlines()
        for word in re.sub(r"'[^']*'|\"[^\"]*\"|#.*", "", line).split()
        if re.search(r"\w\[|^\[\w", word)
    ]
    unquoted += [
        f"{path.relative_to(ROOT)}: {found[0]}"
        for pattern in SOURCES
        for path in ROOT.glob(pattern)
        for found in GLOB.finditer(path.read_text())
    ]
    assert not unquoted, unquoted


def test_links_lead_to_files() -> None:
    """Links of documents that are not built by MkDocs; `cargo xtask docs` checks the others."""
    documents = [*ROOT.glob("*.md"), ROOT / "bindings/python/README.md", *(ROOT / "benches").rglob("*.md")]
    broken = [
        f"{document.relative_to(ROOT)}: {target}"
        for document in documents
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", document.read_text())
        if "://" not in target and not (document.parent / target).exists()
    ]
    assert not broken, broken


def test_named_files_exist() -> None:
    """Paths in inline code, such as `docs/examples/trainer.rs`."""
    folders = "|".join(sorted(path.name for path in ROOT.iterdir() if path.is_dir() and path.name != "target"))
    path = re.compile(rf"`((?:{folders})/[\w./-]+)`")
    broken = [
        f"{page.relative_to(ROOT)}: {named}"
        for page in pages()
        for named in path.findall(page.read_text())
        if not (ROOT / named).exists()
    ]
    assert not broken, broken
