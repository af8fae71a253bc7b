"""The page about environments of one's own leads to a trained agent, with the commands and files that it shows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from test_snippets import ROOT, SHELL, blocks

PAGE = ROOT / "docs/environments/own.md"


@pytest.mark.slow
@pytest.mark.libraries
@pytest.mark.timeout(1800)
def test_the_page_leads_from_an_empty_folder_to_a_trained_agent(tmp_path: Path) -> None:
    # Crates that the workspace has, or packages unpacked in the folder ENDLESS_CRATES, instead of those of crates.io.
    packages = os.environ.get("ENDLESS_CRATES")
    crates = [ROOT, ROOT / "bindings/python", ROOT / "bindings/web"]
    folders = Path(packages).glob("*") if packages else crates
    manifests = [folder / "Cargo.toml" for folder in folders]
    names = {re.search(r'^name = "(.+)"', path.read_text(), re.M)[1]: path.parent for path in manifests}
    assert {"endless-gym-python", "endless-gym-web"} <= names.keys()
    config = tmp_path / ".cargo/config.toml"
    config.parent.mkdir()
    patches = "".join(f'{name} = {{ path = "{folder}" }}\n' for name, folder in names.items())
    config.write_text(f"[net]\noffline = true\n[patch.crates-io]\n{patches}")

    # A new environment with the packages of this one, and without those that are installed there.
    venv = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", venv], check=True)
    (site,) = venv.glob("lib/python*/site-packages")
    (site / "tests.pth").write_text(sysconfig.get_path("purelib"))
    variables = {
        "PATH": f"{venv / 'bin'}:{Path(sys.executable).parent}:{os.environ['PATH']}",
        # `endless-train` belongs to the Python of the tests.
        "PYTHONPATH": f"{site}:{os.environ.get('PYTHONPATH', '')}".rstrip(":"),
        # Not that of the workspace: as a dependency, the binding would replace the module of the workspace's build.
        "CARGO_TARGET_DIR": str(tmp_path / "target"),
        "CARGO_INCREMENTAL": "0",
        "CARGO_PROFILE_DEV_DEBUG": "false",
        "MATURIN_PEP517_ARGS": "--profile dev",
        "PIP_NO_BUILD_ISOLATION": "0",
        "PIP_NO_DEPS": "1",
        "PIP_NO_INDEX": "1",
        "OMP_NUM_THREADS": "1",
        "CUDA_VISIBLE_DEVICES": "",
    }
    code = "".join(block.code for block in blocks(PAGE) if block.language in SHELL)
    run(["bash", "-euo", "pipefail", "-c", code], tmp_path, variables)
    assert list(tmp_path.glob("t_maze/runs/*/*/checkpoints/*.pt"))
    run([venv / "bin/python", Path(__file__).parent / "own_crate.py"], tmp_path, variables)


def run(command: list[str | Path], folder: Path, variables: dict[str, str]) -> None:
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | variables,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert done.returncode == 0, done.stdout


def test_the_page_shows_files_of_the_template() -> None:
    shown = re.findall(r"^\[(engine/cli/template/.+)\]\(\.\./\.\./\1\)$", PAGE.read_text(), re.M)
    assert {Path(file).name for file in shown} == {"task.rs", "main.rs", "lib.rs", "__init__.py", "example.py"}
    assert all((ROOT / file).exists() for file in shown)
