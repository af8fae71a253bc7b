"""Exported agents, in the format that the browser page reads."""

import json
import os
import stat
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents_helpers import changed, saved, settings
from safetensors import safe_open
from safetensors.torch import load_file

from endless_gym_agents.common import atomic
from endless_gym_agents.evaluation import enjoy, export, protocol
from endless_gym_agents.training import checkpoint

ID = "MortarMayhem-Grid-v0"
ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "engine" / "page" / "files").glob("*.safetensors"))


def trained(tmp_path: Path, **changes: Any) -> Path:
    given = settings("gru", env=ID, environment={"option": ("command_count=[1,2]",)})
    saved(tmp_path, changed(given, **changes), update=7, steps=70)
    return tmp_path


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_the_committed_file_computes_the_committed_vectors(file: Path) -> None:
    committed = json.loads((ROOT / "bindings" / "web" / "tests" / "agents" / f"{file.stem}.json").read_text())
    loaded = checkpoint.load(file)
    assert committed["env"] == file.stem.removesuffix("-none")
    recorded = export.record_vectors(loaded.agent, len(committed["features"]))
    for exact in ("reset", "features", "action"):
        assert recorded[exact] == committed[exact]
    # Logits have sizes around 10.
    np.testing.assert_allclose(recorded["logits"], committed["logits"], rtol=1e-5, atol=1e-4)
    assert sum(recorded["reset"]) >= 2
    # Visitors of the page should see it succeed, unless it has no memory.
    evaluation = header(file)["evaluation"][0]
    if file.stem.startswith("Endless"):
        assert (evaluation["mean_reward"] > 0.4) != file.stem.endswith("-none")
    else:
        assert evaluation["success"] > 0.9


def header(file: Path) -> dict[str, Any]:
    with safe_open(file, "pt") as content:
        return json.loads(content.metadata()["endless"])


def test_an_exported_agent_is_read_back(tmp_path: Path) -> None:
    loaded = checkpoint.load(trained(tmp_path))
    file, evaluation = tmp_path / "agent.safetensors", export.evaluations(loaded.agent)
    file.write_bytes(export.export(loaded, evaluation))
    assert header(file)["evaluation"] == evaluation
    assert [each["options"] for each in evaluation] == [{"command_count": [1]}, {"command_count": [2]}]
    assert all(each["episodes"] == 150 and 0 <= each["success"] < 0.5 for each in evaluation)
    read = checkpoint.load(file)
    assert (read.update, read.steps) == (7, 70)
    assert read.settings.options() == loaded.agent.settings.options() == {"command_count": [1, 2]}
    assert export.record_vectors(read.agent, 40) == export.record_vectors(loaded.agent, 40)
    exported = read.agent.state_dict()
    assert all(torch.equal(tensor, exported[name]) for name, tensor in loaded.agent.state_dict().items())


def test_decays_that_are_no_weights_are_not_rounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "evaluations", lambda agent: [])
    run, file = trained(tmp_path, agent="retnet", agent_option=("heads=8",)), tmp_path / "agent.safetensors"
    export.execute(export.ExportArguments(run, out=file))
    read = checkpoint.load(file).agent.state_dict()
    assert read["memory.cell.layers.0.gamma"].tolist() == [1 - 2.0 ** (-5 - head) for head in range(8)]
    assert torch.equal(read["body.0.weight"], read["body.0.weight"].bfloat16().float())


def described(content: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """A file with its description, the JSON text of the format, changed."""
    length = 8 + int.from_bytes(content[:8], "little")
    description = json.loads(content[8:length])
    change(description)
    text = json.dumps(description, separators=(",", ":")).encode()
    return struct.pack("<Q", len(text)) + text + content[length:]


def changes(content: bytes) -> Iterator[tuple[str, bytes]]:
    """The file with each part of its description, or a bit of the data, changed."""
    yield "data", content[:-1] + bytes([content[-1] ^ 1])
    name, entry = (
        "encoder.vector.0.weight",
        json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["encoder.vector.0.weight"],
    )
    for dtype in ("I32", "U32", "BF16", "F64"):
        yield dtype, described(content, lambda all, given=dtype: all[name].update(dtype=given))
    for shape in (entry["shape"][::-1], [], [entry["shape"][0] * entry["shape"][1]]):
        yield str(shape), described(content, lambda all, given=shape: all[name].update(shape=given))
    yield "offsets", described(content, lambda all: all[name].update(data_offsets=[0, 4]))
    yield "name", described(content, lambda all: all.update({"other": all.pop(name)}))
    for part in ("endless", "crc32"):
        yield f"no {part}", described(content, lambda all, key=part: all["__metadata__"].pop(key))
        yield part, described(content, lambda all, key=part: all["__metadata__"].update({key: "12345678"}))
    header = json.loads(json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])["__metadata__"]["endless"])
    for key, value in header.items():
        for other in ({key: 1 if value != 1 else 2}, {key: 3}, {f"{key}.": value}):
            text = json.dumps({each: header[each] for each in header if each != key} | other)
            yield f"{key} {other}", described(content, lambda all, text=text: all["__metadata__"].update(endless=text))


@pytest.mark.parametrize("file", FILES[:1], ids=lambda file: file.stem)
def test_a_file_with_any_part_changed_is_refused(file: Path, tmp_path: Path) -> None:
    content, other = file.read_bytes(), tmp_path / "other.safetensors"
    other.write_bytes(described(content, lambda all: all))
    assert checkpoint.load(other).update == checkpoint.load(file).update
    for what, damaged in changes(content):
        other.write_bytes(damaged)
        with pytest.raises(ValueError, match="safetensors"):
            checkpoint.load(other)
            pytest.fail(f"{what} is read")


def test_another_version_and_weights_of_another_type_are_refused(tmp_path: Path) -> None:
    weights, file = load_file(FILES[0]), tmp_path / "other.safetensors"
    file.write_bytes(checkpoint.to_safetensors(weights, header(FILES[0]) | {"version": 1}))
    with pytest.raises(ValueError, match="must be of version 2, got 1; use the version of endless-gym that wrote it"):
        checkpoint.load(file)
    name = "encoder.vector.0.weight"
    for dtype in (torch.int32, torch.uint32):
        file.write_bytes(checkpoint.to_safetensors(weights | {name: weights[name].view(dtype)}, header(FILES[0])))
        with pytest.raises(ValueError, match=rf"weights must be float32, got {dtype} in {name}"):
            checkpoint.load(file)


def test_agents_that_the_page_cannot_compute_are_refused(tmp_path: Path) -> None:
    run = trained(tmp_path, agent="lstm")
    with pytest.raises(ValueError, match="--agent must be gru, mingru, gated-deltanet, mamba2, retnet, none, got lstm"):
        export.execute(export.ExportArguments(run, out=tmp_path / "agent.safetensors"))
    run = trained(tmp_path / "positive", agent="mingru", agent_option=("positive=true",))
    with pytest.raises(ValueError, match="mingru must have no --agent-option, got positive=true"):
        export.execute(export.ExportArguments(run, out=tmp_path / "agent.safetensors"))


def test_what_is_read_is_not_overwritten(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, other = trained(tmp_path / "run"), trained(tmp_path / "other")
    (run / "settings.json").write_text("{}")
    (run / "checkpoints" / "update-000001.pt").write_text("an earlier one")
    last = run / "checkpoints" / "last.pt"
    os.link(last, tmp_path / "linked.webp")
    (tmp_path / "symbolic.json").symlink_to(last)
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    monkeypatch.chdir(run)
    for source in (run, Path("."), last, tmp_path / "linked.webp"):
        with pytest.raises(ValueError, match=r"cannot write .*, which is the file .*; choose another file"):
            export.execute(export.ExportArguments(source, weights=tmp_path / "linked.webp"))
    for out in ("checkpoints/last.pt", last, "checkpoints/update-000001.pt", "settings.json", "../symbolic.json"):
        for execute in (
            lambda out: export.execute(export.ExportArguments(run, weights=Path(out))),
            lambda out: export.execute(export.ExportArguments(run, out=Path(out))),
            lambda out: export.execute(export.ExportArguments(run, vectors=Path(out))),
            lambda out: protocol.execute(protocol.EvalArguments((other, run), json=str(out), seeds=1, repetitions=1)),
        ):
            with pytest.raises(ValueError, match="cannot write"):
                execute(out)
    with pytest.raises(ValueError, match=r"cannot write .*linked\.webp"):
        enjoy.execute(enjoy.EnjoyArguments(run, out=tmp_path / "linked.webp"))
    with pytest.raises(ValueError, match="cannot write"):
        export.execute(export.ExportArguments(run, weights=Path("a"), vectors=Path("../run/a")))
    assert before == {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    # An exported file is no part of a run.
    export.execute(export.ExportArguments(last, weights=run / "weights.safetensors"))
    assert set(load_file(run / "weights.safetensors")) == set(checkpoint.load(run).agent.state_dict())


def test_a_write_follows_no_link_and_keeps_a_mode(tmp_path: Path) -> None:
    file, former = tmp_path / "agent.safetensors", b"former" * 1000
    # A link that another user planted under the name of the temporary file.
    (tmp_path / "victim").write_text("kept")
    (tmp_path / "agent.safetensors.new").symlink_to("victim")
    atomic.write(file, former)
    assert file.read_bytes() == former and (tmp_path / "victim").read_text() == "kept"
    assert not (tmp_path / "agent.safetensors.new").is_symlink()
    # A link is replaced, as by the Rust trainer, a mode is kept, and a pipe is no file to replace.
    (tmp_path / "link").symlink_to("agent.safetensors")
    atomic.write(tmp_path / "link", "new")
    assert not (tmp_path / "link").is_symlink() and file.read_bytes() == former
    for mode in (0o600, 0o666, 0o400):
        file.chmod(mode)
        atomic.write(file, "private")
        assert stat.S_IMODE(file.stat().st_mode) == mode and file.read_text() == "private"
    reading, writing = os.pipe()
    atomic.write(f"/dev/fd/{writing}", b"piped")
    assert os.read(reading, 9) == b"piped"


def test_the_program_writes_both_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, out, vectors = trained(tmp_path / "run"), tmp_path / "a.safetensors", tmp_path / "a.json"
    export.execute(export.ExportArguments(run, out=out, vectors=vectors, vector_steps=12))
    assert f"{out.stat().st_size} bytes" in capsys.readouterr().out
    first = json.loads(vectors.read_text())
    assert len(first["logits"]) == 12
    export.execute(export.ExportArguments(out, vectors=vectors, vector_steps=12))
    assert json.loads(vectors.read_text()) == first
    with pytest.raises(ValueError, match="nothing to write"):
        export.execute(export.ExportArguments(run))
