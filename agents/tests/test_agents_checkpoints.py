"""Checkpoints that are truncated, damaged, foreign, forged or cannot be written."""

import errno
import itertools
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents_helpers import assert_equal_runs, changed, same, saved, settings, small

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import make_agent
from endless_gym_agents.settings import to_dict
from endless_gym_agents.training import checkpoint, train


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The last checkpoint of a run."""
    run = tmp_path_factory.mktemp("run")
    saved(run, settings("gru"))
    return run / "checkpoints" / "last.pt"


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one update."""
    run = tmp_path_factory.mktemp("trained") / "run"
    flags = ["--environment.num-envs", "8", "--ppo.updates", "1", "--ppo.steps", "16", "--recurrence.hidden-size", "16"]
    arguments = ["--env", "MortarMayhem-Grid-v0", "--preset", "quick", "--run", str(run), *flags]
    return train.train(train.parse(arguments))


def other(file: Path, to: Path, **state: Any) -> Path:
    """A whole checkpoint with other entries; `None` removes one."""
    content = torch.load(file, weights_only=True) | state
    torch.save({name: part for name, part in content.items() if part is not None}, to)
    return to


def contents(folder: Path) -> dict[str, bytes]:
    return {each.name: each.read_bytes() for each in folder.iterdir()}


def test_a_checkpoint_in_parts_is_read_as_one_and_each_change_is_reported(file: Path, tmp_path: Path) -> None:
    whole = torch.load(file, weights_only=True)
    run = tmp_path / "run"
    for steps in (1, 2):
        last = checkpoint.save(run, whole | {"steps": steps}, True, 0.01)
    size = file.stat().st_size
    # Each save removes the parts of the former last checkpoint.
    names = [each.name.split("-")[0] for each in sorted(last.parent.glob("last*"))]
    assert names == ["last.pt", *(f"last.pt.{number}" for number in range(1, 1 + -(-size // 10_000)))]
    assert all(each.stat().st_size <= 10_000 for each in last.parent.iterdir())
    assert checkpoint.files(run) == [last.with_name("update-000001.pt")]
    assert set(last.parent.iterdir()) < set(checkpoint.protected(run))
    elsewhere = Path(shutil.copytree(last.parent, tmp_path / "elsewhere"))
    for given in (run, elsewhere / "last.pt", elsewhere / "update-000001.pt"):
        assert same(checkpoint.load(given).state, whole | {"steps": 2})
    assert set(checkpoint.protected(elsewhere / "last.pt")) == set(elsewhere.glob("last.pt*"))
    for part in elsewhere.glob("last.pt.*"):
        content = part.read_bytes()
        for other in (content[:-1], content[:-1] + bytes([content[-1] ^ 1])):
            part.write_bytes(other)
            with pytest.raises(ValueError, match=f"is damaged: its part {part.name} has changed since"):
                checkpoint.load(elsewhere / "last.pt")
        part.unlink()
        with pytest.raises(FileNotFoundError, match=f"has no part {part.name}; copy all files .*last.pt"):
            checkpoint.load(elsewhere / "last.pt")
        part.write_bytes(content)
    for text in ('{"parts": [', '{"parts": []}', '{"parts": [1', '{"parts": ["/etc"]}', '{"parts": [[]]}'):
        (elsewhere / "last.pt").write_text(text)
        with pytest.raises(ValueError, match="is not a checkpoint, or is truncated"):
            checkpoint.load(elsewhere / "last.pt")
    assert same(checkpoint.load(checkpoint.save(run, whole, False)).state, whole)
    assert sorted(each.name.split(".")[0] for each in last.parent.iterdir()).count("last") == 1


def test_a_run_that_saves_while_its_checkpoint_is_read(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, opened = torch.load(file, weights_only=True), checkpoint.regular.opened
    run = checkpoint.save(tmp_path, state, False, 0.01).parents[1]

    def saves(part: Path) -> Any:
        if ".pt." in part.name:
            monkeypatch.setattr(checkpoint.regular, "opened", opened)
            checkpoint.save(run, state | {"steps": 1}, False, 0.01)
        return opened(part)

    monkeypatch.setattr(checkpoint.regular, "opened", saves)
    assert checkpoint.load(run).steps == 1


def test_a_run_continues_exactly_in_another_folder_with_another_number_of_cores(tmp_path: Path) -> None:
    """As on another machine, from parts that were copied there."""
    given = replace(small("gru", tmp_path / "whole", 4, groups=1), checkpoint_megabytes=0.03)
    whole = train.train(given)
    half = train.train(changed(given, run=str(tmp_path / "first"), ppo={"updates": 2}))
    shutil.move(half, tmp_path / "second")
    assert len(list((tmp_path / "second" / "checkpoints").iterdir())) > 3
    command = [sys.executable, "-m", "endless_gym_agents.train", "--resume", "second", "--ppo.updates", "4"]
    core = min(os.sched_getaffinity(0))
    subprocess.run(["taskset", "-c", str(core), *command], cwd=tmp_path, check=True, timeout=120)
    assert_equal_runs(whole, tmp_path / "second")


def test_a_truncated_checkpoint_is_refused_at_any_length(file: Path, tmp_path: Path) -> None:
    content = file.read_bytes()
    for length in {*range(0, 200), *range(0, len(content), 997), *range(len(content) - 200, len(content))}:
        (tmp_path / "short.pt").write_bytes(content[:length])
        with pytest.raises(ValueError, match="is not a checkpoint, or is truncated"):
            checkpoint.load(tmp_path / "short.pt")


def test_a_changed_byte_is_reported_or_changes_nothing(file: Path, tmp_path: Path) -> None:
    content, whole = np.fromfile(file, np.uint8), checkpoint.load(file).state
    draws, refused = np.random.default_rng(3), 0
    for _ in range(100):
        damaged = content.copy()
        damaged[draws.integers(len(content))] ^= draws.integers(1, 256, dtype=np.uint8)
        damaged.tofile(tmp_path / "damaged.pt")
        try:
            state = checkpoint.load(tmp_path / "damaged.pt").state
        except ValueError as error:
            refused += 1
            assert re.search("damaged|truncated", str(error)), error
        else:
            assert all(torch.equal(state["model"][name], part) for name, part in whole["model"].items())
            assert state["settings"] == whole["settings"] and state["steps"] == whole["steps"]
    assert refused > 75


def test_the_message_names_what_is_wrong(file: Path, tmp_path: Path) -> None:
    given = torch.load(file, weights_only=True)
    weights, wide = given["model"], settings("gru", recurrence={"hidden_size": 17})
    name = next(iter(weights))
    for state, message in [
        ({"version": 7}, "must be of version 1, got 7"),
        ({"model": None}, "is incomplete: it has no model"),
        ({"settings": None, "steps": None}, "is incomplete: it has no settings, steps"),
        *(
            ({"model": weights | {name: torch.full_like(weights[name], value)}}, f"not finite, in {name}")
            for value in (torch.nan, torch.inf)
        ),
        ({"model": {key: part for key, part in weights.items() if key != name}}, f"there are no weights {name}"),
        ({"settings": to_dict(wide)}, r"must have shape \(.*17.*\) according to the settings, got"),
        ({"settings": to_dict(replace(wide, env="Other-v0"))}, "id must be one of"),
        ({"settings": 3}, "settings or weights are invalid"),
        ({"model": []}, "settings or weights are invalid"),
    ]:
        with pytest.raises(ValueError, match=message):
            checkpoint.load(other(file, tmp_path / "changed.pt", **state))
    for content, message in [([1], "a list, not a dict"), ({"version": Path()}, "not a checkpoint of endless-train")]:
        torch.save(content, tmp_path / "changed.pt")
        with pytest.raises(ValueError, match=message):
            checkpoint.load(tmp_path / "changed.pt")


@pytest.mark.parametrize(
    "claimed",
    [
        {"recurrence": {"layers": 10**9}},
        {"transformer": {"layers": 10**9}},
        {"transformer": {"window": 10**9}},
        {"recurrence": {"hidden_size": 10**6}},
        {"model": {"head_width": 10**7}},
        {"model": {"body_width": 10**12}},
    ],
)
def test_sizes_that_the_weights_do_not_have_are_refused_before_anything_is_built(
    claimed: dict[str, Any], file: Path, tmp_path: Path
) -> None:
    forged = other(file, tmp_path / "forged.pt", settings=to_dict(settings("gru", **claimed)))
    memory, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    with pytest.raises(ValueError, match=r"settings or weights are invalid"):
        checkpoint.load(forged)
    assert time.process_time() - start < 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 200_000  # kilobytes


@pytest.mark.parametrize("repeats", [True, False])
def test_weights_that_repeat_few_numbers_or_are_missing_take_no_memory(
    repeats: bool, file: Path, tmp_path: Path
) -> None:
    """The settings claim 3 GB in a file of a few kilobytes."""
    claimed = settings("gru", model={"head_width": 20_000, "body_width": 20_000})
    with torch.device("meta"):
        shapes = {
            name: part.shape for name, part in make_agent(claimed, spec(claimed.env), "meta").state_dict().items()
        }
    weights = {name: torch.zeros(()).expand(shape) for name, shape in shapes.items()} if repeats else {}
    forged = other(file, tmp_path / "forged.pt", settings=to_dict(claimed), model=weights, optimizer=None, player=None)
    assert forged.stat().st_size < 100_000
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"claim 3|there are no weights"):
        checkpoint.load(forged)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 200_000  # kilobytes


def test_a_compressed_checkpoint_is_refused_since_it_could_have_any_size(file: Path, tmp_path: Path) -> None:
    with zipfile.ZipFile(file) as source, zipfile.ZipFile(tmp_path / "c.pt", "w", zipfile.ZIP_DEFLATED) as target:
        for part in source.infolist():
            target.writestr(part.filename, source.read(part))
        target.writestr("archive/data/bomb", bytes(300_000_000))
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load(tmp_path / "c.pt")


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"optimizer": None, "player": None}, "cannot be resumed: it has no optimizer, player; start a new run"),
        ({"optimizer": {}}, "cannot be resumed, as its state is invalid"),
        ({"generators": {"actions": 3}}, "cannot be resumed, as its state is invalid"),
        ({"player": []}, "cannot be resumed, as its state is invalid"),
        ({"player": {"environments": b"1"}}, "cannot be resumed, as its state is invalid"),
        ({"episodes": 3}, "cannot be resumed, as its state is invalid"),
    ],
)
def test_a_checkpoint_without_the_state_of_the_run_cannot_be_resumed(
    state: dict[str, Any],
    message: str,
    trained: Path,
    tmp_path: Path,
    call: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copytree(trained, tmp_path / "run")
    last = tmp_path / "run" / "checkpoints" / "last.pt"
    other(last, last, **state)
    checkpoint.load(last)
    capsys.readouterr()
    assert call(train.main, "--resume", tmp_path / "run", "--ppo.updates", 2) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and message in error, error


def test_a_disk_that_is_full_after_some_parts_leaves_no_others(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, state = tmp_path / "run", torch.load(file, weights_only=True)
    folder = checkpoint.save(run, state, False, 0.004).parent
    former, write = contents(folder), checkpoint.atomic.write
    for number in range(1, len(former)):
        calls = itertools.count(1)

        def fails(*given: Any, calls: Iterator[int] = calls, number: int = number) -> None:
            if next(calls) == number:
                raise OSError(errno.ENOSPC, "No space left on device")
            write(*given)

        monkeypatch.setattr(checkpoint.atomic, "write", fails)
        with pytest.raises(OSError, match="No space left"):
            checkpoint.save(run, state | {"steps": 1}, False, 0.004)
        assert contents(folder) == former


def test_deep_settings_are_refused(tmp_path: Path) -> None:
    for text in ("[" * 100_000, '{"env":' * 100_000, "9" * 10_000):
        (tmp_path / "settings.json").write_text(text)
        with pytest.raises(ValueError, match=r"settings\.json is not of this version"):
            checkpoint.read_settings(tmp_path)
    with pytest.raises(ValueError, match=r"settings\.json is not of this version"):
        (tmp_path / "settings.json").write_text(json.dumps({"layers": 10**9}))
        checkpoint.read_settings(tmp_path)
