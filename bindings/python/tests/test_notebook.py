"""The notebook runs from its first cell to its last."""

from __future__ import annotations

import json
import os
import re
import subprocess
from collections import Counter
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parent.parent / "examples/quickstart.ipynb"


def test_notebook_is_stored_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 5
    assert not any(cell["outputs"] or cell["execution_count"] for cell in code), "clear all outputs before saving"
    assert NOTEBOOK.stat().st_size < 500_000


def test_notebook_links_lead_to_files() -> None:
    text = "".join("".join(cell["source"]) for cell in json.loads(NOTEBOOK.read_text())["cells"])
    links = [part.split(")")[0] for part in text.split("](")[1:]]
    assert len(links) >= 5
    assert [link for link in links if not (NOTEBOOK.parent / link).exists()] == []


@pytest.mark.slow
@pytest.mark.libraries
def test_notebook_runs(tmp_path: Path, libraries_python: str) -> None:
    text, minute = NOTEBOOK.read_text(), '"minutes = 1.0"'
    assert text.count(minute) == 1
    (tmp_path / "short.ipynb").write_text(text.replace(minute, '"minutes = 0.05"'))
    folders = dict.fromkeys(("HOME", "IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "TMPDIR"), str(tmp_path))
    # Jupyter's runtime folder has Unix sockets, whose paths must be short; the data folder's default would be in HOME.
    ran = subprocess.run(
        [Path(libraries_python).parent / "jupyter-execute", "short.ipynb", "--output=run"],
        cwd=tmp_path,
        env=os.environ | folders | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    cells = json.loads((tmp_path / "run.ipynb").read_text())["cells"]
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    kinds = Counter(kind for output in outputs for kind in output.get("data", {}))
    assert kinds["image/png"] == 3, "the environments, a vector environment, the learning curve"
    assert kinds["image/webp"] == 1, "the film"
    printed = "".join("".join(output["text"]) for output in outputs if output["output_type"] == "stream")
    assert re.search(r"[1-9]\d* of 2000 updates done", printed)
    assert "Traceback" not in printed
