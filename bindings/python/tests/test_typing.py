"""User scripts pass strict type checking."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from endless_gym.requests.configuration import MODES, AutoresetName
from endless_gym.specs import OBSERVATIONS, ObservationName

SCRIPTS = Path(__file__).parent / "typed"
RIGHT = sorted(path for path in SCRIPTS.glob("*.py") if path.name != "wrong.py")
WRONG = SCRIPTS / "wrong.py"


def marked() -> set[int]:
    return {number for number, line in enumerate(WRONG.read_text().splitlines(), 1) if line.endswith("# wrong")}


@pytest.mark.slow
@pytest.mark.libraries
def test_mypy_accepts_right_calls_and_reports_wrong_ones(tmp_path: Path) -> None:
    # In a folder without the package's own settings, as a user runs it. mypy takes minutes for PyTorch, which pyright checks.
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = True\n[mypy-torch.*]\nfollow_imports = skip\n")
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--cache-dir", tmp_path / "cache"]
    checked = subprocess.run([*command, *RIGHT, WRONG], cwd=tmp_path, capture_output=True, text=True)
    found = [line for line in checked.stdout.splitlines() if ": note: " not in line]
    wrong = {int(match[1]) for line in found if (match := re.match(r".*/wrong\.py:(\d+): error: ", line))}
    assert [line for line in found if "wrong.py" not in line] == [], checked.stderr
    assert wrong == marked(), checked.stdout


@pytest.mark.slow
@pytest.mark.libraries
def test_pyright_accepts_right_calls_and_reports_wrong_ones(tmp_path: Path) -> None:
    scripts = [str(path) for path in (*RIGHT, WRONG)]
    settings = {"include": scripts, "typeCheckingMode": "strict", "pythonVersion": "3.10"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    command = [Path(sys.executable).parent / "basedpyright", "--outputjson", "--pythonpath", sys.executable]
    checked = subprocess.run([*command, "--project", tmp_path], cwd=tmp_path, capture_output=True, text=True)
    report = json.loads(checked.stdout)
    assert report["summary"]["filesAnalyzed"] == len(scripts)
    errors = [found for found in report["generalDiagnostics"] if found["severity"] == "error"]
    assert [found for found in errors if not found["file"].endswith("wrong.py")] == []
    assert {found["range"]["start"]["line"] + 1 for found in errors} == marked()


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.libraries] if "import torch" in path.read_text() else [])
        for path in RIGHT
    ],
)
def test_typed_scripts_run(path: Path) -> None:
    ran = subprocess.run([sys.executable, path], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_literals_have_the_names_that_are_accepted() -> None:
    assert set(AutoresetName.__args__) == set(MODES)
    assert set(ObservationName.__args__) == set(OBSERVATIONS)
