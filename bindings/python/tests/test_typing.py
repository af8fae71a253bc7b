"""Scripts of users are type-checked strictly, and every public function says what it takes and returns."""

from __future__ import annotations

import importlib
import inspect
import json
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import endless_gym
from endless_gym.configuration import MODES, AutoresetName
from endless_gym.specs import OBSERVATIONS, ObservationName

SCRIPTS = Path(__file__).parent / "typed"
RIGHT = sorted(path for path in SCRIPTS.glob("*.py") if path.name != "wrong.py")
WRONG = SCRIPTS / "wrong.py"


def marked() -> set[int]:
    return {number for number, line in enumerate(WRONG.read_text().splitlines(), 1) if line.endswith("# wrong")}


@pytest.mark.slow
def test_mypy(tmp_path: Path) -> None:
    # In a folder without the package's own settings, as a user runs it. PyTorch, which is left to pyright, takes it minutes.
    (tmp_path / "mypy.ini").write_text("[mypy]\nstrict = True\n[mypy-torch.*]\nfollow_imports = skip\n")
    command = [sys.executable, "-m", "mypy", "--no-error-summary", "--cache-dir", tmp_path / "cache"]
    checked = subprocess.run([*command, *RIGHT, WRONG], cwd=tmp_path, capture_output=True, text=True)
    found = [line for line in checked.stdout.splitlines() if ": note: " not in line]
    wrong = {int(match[1]) for line in found if (match := re.match(r".*/wrong\.py:(\d+): error: ", line))}
    assert [line for line in found if "wrong.py" not in line] == [], checked.stderr
    assert wrong == marked(), checked.stdout


@pytest.mark.slow
def test_pyright(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("path", RIGHT, ids=lambda path: path.stem)
def test_the_scripts_run(path: Path) -> None:
    if path.stem == "trained":
        compile(path.read_text(), path, "exec")  # the documentation's snippets run the same calls
        return
    ran = subprocess.run([sys.executable, path], capture_output=True, text=True)
    assert ran.returncode == 0, ran.stderr


def test_literals_are_the_names_that_are_accepted() -> None:
    assert set(AutoresetName.__args__) == set(MODES)
    assert set(ObservationName.__args__) == set(OBSERVATIONS)


def public_modules() -> Iterator[str]:
    """The package's modules, without programs and without the adapter that needs PufferLib's working directory."""
    yield "endless_gym"
    for module in pkgutil.iter_modules(endless_gym.__path__, "endless_gym."):
        if not module.name.rpartition(".")[2].startswith("_") and module.name != "endless_gym.pufferlib":
            yield module.name


def public_functions(module_name: str) -> Iterator[tuple[str, object]]:
    """The public classes, functions and methods that a module defines, and all that the package exports."""
    module = importlib.import_module(module_name)
    exported = module_name == "endless_gym"
    for name in module.__all__ if exported else vars(module):
        member = getattr(module, name)
        if name.startswith("_") or not (exported or getattr(member, "__module__", None) == module_name):
            continue
        if inspect.isclass(member):
            yield name, member
            for method, static in vars(member).items():
                function = getattr(static, "__func__", getattr(static, "fget", static))
                if not method.startswith("_") and inspect.isfunction(function) and function.__name__ == method:
                    # Looked up in the class, so that `inspect.getdoc` finds an interface's docstring.
                    yield f"{name}.{method}", static if isinstance(static, property) else getattr(member, method)
        elif inspect.isfunction(member):
            yield name, member


@pytest.mark.parametrize("module_name", list(public_modules()))
def test_every_public_function_has_a_docstring_and_types(module_name: str) -> None:
    for name, member in public_functions(module_name):
        where = f"{module_name}.{name}"
        # A method that implements an interface has the interface's docstring.
        assert inspect.getdoc(member), f"{where} has no docstring"
        function = getattr(member, "__func__", getattr(member, "fget", member))
        if inspect.isfunction(function):
            signature = inspect.signature(function)
            bare = [name for name, each in signature.parameters.items() if each.annotation is inspect.Parameter.empty]
            assert set(bare) <= {"self", "cls"}, f"{where}: {bare} have no type"
            assert signature.return_annotation is not inspect.Signature.empty, where
