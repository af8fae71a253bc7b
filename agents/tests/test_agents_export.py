"""Exported agents, in the format that the browser page reads."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents_helpers import changed, saved, settings

from endless_gym_agents import checkpoint, export

ID = "MortarMayhem-Grid-v0"
WEB = Path(__file__).resolve().parents[2] / "bindings" / "web"
FILE = WEB.parents[1] / "engine" / "view" / "page" / "files" / f"{ID}.agent.bin"


def trained(tmp_path: Path, **changes: Any) -> Path:
    given = settings("gru", env=ID, environment={"option": ("command_count=[1,2]",)})
    saved(tmp_path, changed(given, **changes), update=7, steps=70)
    return tmp_path


def test_the_committed_file_computes_the_committed_vectors() -> None:
    committed = json.loads((WEB / "tests" / "agents" / f"{ID}.json").read_text())
    header, agent = export.read(FILE)
    assert header["env"] == committed["env"] == ID
    recorded = export.record_vectors(agent, len(committed["features"]))
    for exact in ("reset", "features", "action"):
        assert recorded[exact] == committed[exact]
    np.testing.assert_allclose(recorded["logits"], committed["logits"], rtol=1e-5, atol=1e-5)
    assert sum(recorded["reset"]) >= 3
    # Visitors of the page should see it succeed.
    assert header["evaluation"][0]["success"] > 0.9


def test_an_exported_agent_is_read_back(tmp_path: Path) -> None:
    loaded = checkpoint.load(trained(tmp_path))
    file = tmp_path / "agent.bin"
    file.write_bytes(export.export(loaded))
    header, agent = export.read(file)
    assert (header["updates"], header["steps"], header["branches"]) == (7, 70, [4])
    assert header["options"] == {"command_count": [1, 2]}
    assert [each["options"] for each in header["evaluation"]] == [{"command_count": [1]}, {"command_count": [2]}]
    assert all(each["episodes"] == 150 and 0 <= each["success"] < 0.5 for each in header["evaluation"])
    assert loaded.agent.settings.options() == {"command_count": [1, 2]}
    assert export.record_vectors(agent, 40) == export.record_vectors(loaded.agent, 40)
    exported = agent.state_dict()
    for name, tensor in loaded.agent.state_dict().items():
        assert name.startswith("value.") or torch.equal(tensor, exported[name])


def test_a_broken_file_is_refused(tmp_path: Path) -> None:
    content, file = FILE.read_bytes(), tmp_path / "broken.bin"
    version = struct.pack("<I", 9)
    for broken, message in [
        (b"", "is not an exported agent; expected a file that starts with ENDLAGNT"),
        (content[:8] + version + content[12:], "must be of version 1, got 9; export it again"),
        (content[:40], "is truncated: its header has"),
        (content[:-1], "bytes of weights, got"),
        (content + b"more", "bytes of weights, got"),
    ]:
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=message):
            export.read(file)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"agent": "lstm"}, "--agent must be gru, got lstm"),
        ({"recurrence": {"layers": 2}}, "--recurrence.layers must be 1, got 2"),
        ({"recurrence": {"embedding": False}}, "--recurrence.embedding must be on"),
    ],
)
def test_unsupported_agents_are_refused(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        export.export(checkpoint.load(trained(tmp_path, **changes)))


def test_the_program_writes_both_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out, vectors = trained(tmp_path / "run"), tmp_path / "a.bin", tmp_path / "a.json"
    export.execute(export.ExportArguments(run, out=out, vectors=vectors, vector_steps=12))
    assert f"{out.stat().st_size} bytes" in capsys.readouterr().out
    first = json.loads(vectors.read_text())
    assert len(first["logits"]) == 12
    export.execute(export.ExportArguments(out, vectors=vectors, vector_steps=12))
    assert json.loads(vectors.read_text()) == first
    with pytest.raises(ValueError, match="nothing to write"):
        export.execute(export.ExportArguments(run))
    with pytest.raises(ValueError, match="--out needs a checkpoint"):
        export.execute(export.ExportArguments(out, out=tmp_path / "b.bin"))
