"""Checkpoints: the state from which a run resumes, and the agent for evaluation.

```python
import endless_gym_agents

loaded = endless_gym_agents.load("runs/mine")    # the last checkpoint of a run, or a checkpoint file
agent, steps = loaded.agent, loaded.steps
```
"""

from __future__ import annotations

import contextlib
import glob
import io
import json
import math
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import Agent, make_agent
from endless_gym_agents.common import atomic, ranges, regular
from endless_gym_agents.settings import Settings, Transformer, from_dict
from endless_gym_agents.training.logs import PROGRESS

#: Version of a checkpoint's content. It changes when an older checkpoint can no longer be resumed or evaluated.
CHECKPOINT_VERSION = 1

#: Version of the files of `endless learn` and of exported agents.
FILE_VERSION = 2

#: Names inside the folder of a run: the settings, the folder of the checkpoints, and the last checkpoint in it. Checkpoints of
#: `endless learn`, the trainer in Rust, end with `RUST_SUFFIX` instead.
SETTINGS = "settings.json"
FOLDER = "checkpoints"
LAST = "last.pt"
RUST_SUFFIX = ".safetensors"

#: Longest header of such a file in bytes: far more than a network needs, and few enough to read at once.
_MAX_HEADER = 4 << 20

#: How the file of a checkpoint in parts begins, which lists their checksums.
_PARTS = b'{"parts": ['


@dataclass
class Checkpoint:
    """A loaded checkpoint.

    Attributes:
        settings: Settings of the run.
        agent: The agent with the weights of the checkpoint, in evaluation mode.
        update: Number of updates so far.
        steps: Number of environment steps so far.
        state: The saved state; see `save`.
    """

    settings: Settings
    agent: Agent
    update: int
    steps: int
    state: dict[str, Any]

    def resumable(self) -> dict[str, Any]:
        """The saved state, with everything that a run needs to resume.

        Raises:
            ValueError: It has only what evaluation needs.
        """
        if missing := [name for name in ("optimizer", "generators", "player", "episodes") if name not in self.state]:
            raise ValueError(
                f"the checkpoint cannot be resumed: it has no {', '.join(missing)}; start a new run with --init-from"
            )
        return self.state


@contextlib.contextmanager
def checked(run: Path) -> Iterator[None]:
    """Report a state of the last checkpoint of a run that does not fit the run as `ValueError`."""
    try:
        yield
    except (AttributeError, IndexError, KeyError, RuntimeError, TypeError, ValueError) as error:
        raise ValueError(
            f"checkpoint {run / FOLDER / LAST} cannot be resumed, as its state is invalid: {error}"
        ) from error


def save(run: Path, state: dict[str, Any], keep: bool, megabytes: float = 0.0) -> Path:
    """Write a checkpoint as the last one of a run, atomically.

    The parts of a large `last.pt` are files `last.pt.1-CHECKSUM` and so on, and `last.pt` then lists their checksums. Former
    parts stay until it is replaced.

    Args:
        run: Folder of the run.
        state: `settings` (from `to_dict`), `update`, `steps`, `model`; and to resume, `optimizer`, `generators`, `player` (the
            state of the rollout collector) and `episodes`.
        keep: Also keep the checkpoint under the number of its update.
        megabytes: Size of the parts that a larger checkpoint is divided into; 0 for no parts.

    Returns:
        Path of the last checkpoint.

    Raises:
        OSError: A file cannot be written, as on a full disk. The former checkpoint stays the last one.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    # torch reports a file that cannot be written without the reason.
    content = io.BytesIO()
    torch.save({"version": CHECKPOINT_VERSION} | state, content)
    if keep:
        # First, since a run that resumes from the last one does not write its number again.
        _write(folder / f"update-{state['update']:06d}.pt", content.getbuffer(), megabytes)
    _write(folder / LAST, content.getbuffer(), megabytes)
    return folder / LAST


def _write(file: Path, content: memoryview, megabytes: float) -> None:
    size = math.ceil(1e6 * megabytes)
    pieces = [content[start:][:size] for start in range(0, len(content), size)] if 0 < size < len(content) else []
    checksums = list(map(zlib.crc32, pieces))
    try:
        for number, piece in enumerate(pieces, 1):
            atomic.write(_part(file, number, checksums[number - 1]), piece)
        atomic.write(file, json.dumps({"parts": checksums}) if pieces else content)
    finally:
        remove_unlisted(file)


def remove_unlisted(file: Path) -> None:
    """Remove parts of a checkpoint that is no longer there, and of one that was not completed."""
    for part in set(_parts(file)).difference(_listed(file) or []):
        part.unlink()


def _part(file: Path, number: int, checksum: int) -> Path:
    return file.with_name(f"{file.name}.{number}-{checksum:08x}")


def _parts(file: Path) -> list[Path]:
    """The files that are parts of a checkpoint according to their names."""
    return list(file.parent.glob(f"{glob.escape(file.name)}.[0-9]*-*"))


def _listed(file: Path) -> list[Path] | None:
    """The parts that a checkpoint lists; None if it is one file, or not there.

    Raises:
        ValueError: The list is invalid.
    """
    if not file.exists():
        return None
    with regular.opened(file) as content:
        start = content.read(len(_PARTS))
        if start != _PARTS:
            return None
        try:
            return [_part(file, *each) for each in enumerate(json.loads(start + content.read())["parts"], 1)]
        except (RecursionError, TypeError, ValueError) as error:
            raise ValueError(f"{file} is not a checkpoint, or is truncated: {error}") from error


def files(run: str | Path) -> list[Path]:
    """The numbered checkpoints of a run in order of their updates, or the last checkpoint if there are none."""
    file = last(run)
    return sorted(file.parent.glob(f"update-*{file.suffix}")) or [file]


def last(run: str | Path) -> Path:
    """The last checkpoint of a run, which may not exist."""
    file = Path(run) / FOLDER / LAST
    of_rust = file.with_suffix(RUST_SUFFIX)
    return of_rust if of_rust.exists() and not file.exists() else file


def protected(path: str | Path) -> list[Path]:
    """The files that a program that reads this checkpoint must not overwrite: it, and the settings, log and checkpoints.

    Args:
        path: As for `load`.
    """
    file = last(path) if Path(path).is_dir() else Path(path)
    if file.parent.name != FOLDER:
        return [file, *_parts(file)]
    run = file.parent.parent
    return [file, run / SETTINGS, run / PROGRESS, *file.parent.glob("*")]


def load(path: str | Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Load a checkpoint.

    Args:
        path: A checkpoint file, or the folder of a run for its last checkpoint.
        device: Device of the agent.

    Raises:
        FileNotFoundError: There is no such checkpoint.
        ValueError: The file is not a checkpoint, is truncated or damaged, or of another version, its weights do not fit its
            settings, or are not finite.
    """
    file = Path(path)
    if file.is_dir():
        file = last(file)
    if not file.exists():
        raise FileNotFoundError(
            f"no checkpoint {file}; expected the folder of a run, or a file of its folder `{FOLDER}`"
        )
    if file.suffix == RUST_SUFFIX:
        state, expected, size = _read_of_rust(file), FILE_VERSION, file.stat().st_size
    else:
        with _opened(file) as content:
            state, expected, size = _read(content, file), CHECKPOINT_VERSION, content.seek(0, io.SEEK_END)
    if (version := state.get("version")) != expected:
        raise ValueError(
            f"checkpoint {file} must be of version {expected}, got {version}; use the version of endless-gym that wrote it"
        )
    if missing := [name for name in ("settings", "update", "steps", "model") if name not in state]:
        raise ValueError(f"checkpoint {file} is incomplete: it has no {', '.join(missing)}")
    try:
        # A small file may have tensors of any size, whose strides repeat a few numbers.
        claimed = sum(weights.nbytes for weights in state["model"].values())
        if claimed > size:
            raise ValueError(f"its weights claim {claimed} bytes, and the file has {size}")
        agent, settings = _agent(state, device)
    except Exception as error:  # of settings of any content, `load_state_dict`, and modules of the user's own
        reason = str(error).replace("\n\t", " ")
        raise ValueError(
            f"checkpoint {file} cannot be used, as its settings or weights are invalid: {reason}"
        ) from error
    broken = [name for name, weights in agent.state_dict().items() if not bool(weights.isfinite().all())]
    if broken:
        raise ValueError(
            f"checkpoint {file} has weights that are not finite, in {broken[0]}: its run had diverged; use an earlier "
            "checkpoint, or train again with a smaller --ppo.learning-rate"
        )
    agent.eval()
    return Checkpoint(settings, agent, state["update"], state["steps"], state)


def _opened(file: Path) -> BinaryIO:
    """Open a checkpoint. Its parts are joined.

    Raises:
        FileNotFoundError: A part is missing.
        ValueError: A part has changed, or the file that lists them.
    """
    if (listed := _listed(file)) is None:
        return regular.opened(file)
    joined = io.BytesIO()
    for part in listed:
        try:
            with regular.opened(part) as content:
                piece = content.read()
        except FileNotFoundError:
            if _listed(file) != listed:  # The run has saved another one.
                return _opened(file)
            message = f"checkpoint {file} has no part {part.name}; copy all files {file.name}.* with it"
            raise FileNotFoundError(message) from None
        if not part.name.endswith(f"-{zlib.crc32(piece):08x}"):
            raise ValueError(f"checkpoint {file} is damaged: its part {part.name} has changed since it was written")
        joined.write(piece)
    joined.seek(0)
    return joined


def _read(content: BinaryIO, file: Path) -> dict[str, Any]:
    """The saved state, in which nothing has been checked yet except that all of it is as it was written."""
    try:
        with zipfile.ZipFile(content) as archive:
            # `torch.save` does not compress. A small file could have parts that decompress to any size.
            compressed = [part.filename for part in archive.infolist() if part.compress_type != zipfile.ZIP_STORED]
            # `torch.load` does not compare the parts with their checksums.
            damaged = compressed[0] if compressed else archive.testzip()
    except (zipfile.BadZipFile, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        raise ValueError(f"{file} is not a checkpoint, or is truncated: {error}") from error
    if damaged is not None:
        raise ValueError(f"checkpoint {file} is damaged: its part {damaged} has changed since it was written")
    content.seek(0)
    try:
        # `weights_only` reads nothing but tensors and plain values, so an untrusted checkpoint cannot execute code.
        state = torch.load(content, map_location="cpu", weights_only=True)
    except Exception as error:  # of many types
        raise ValueError(f"{file} is not a checkpoint of endless-train: {str(error).splitlines()[0]}") from error
    if not isinstance(state, dict):
        raise ValueError(f"{file} is not a checkpoint of endless-train: it has a {type(state).__name__}, not a dict")
    return state


def _read_of_rust(file: Path) -> dict[str, Any]:
    """As `_read`, of a checkpoint of `endless learn`, without what only that program needs to resume."""
    with regular.opened(file) as content:
        if (header := int.from_bytes(content.read(8), "little")) > _MAX_HEADER:
            raise ValueError(
                f"{file} is not a file of safetensors, or has far more tensors than a network: its header claims {header} bytes, "
                f"at most {_MAX_HEADER} are allowed"
            )
    try:
        with safe_open(file, "pt") as content:
            metadata = content.metadata() or {}
            tensors = {name: content.get_tensor(name) for name in content.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{file} is not a file of safetensors, or is truncated: {error}") from error
    if "endless" not in metadata:
        raise ValueError(f"{file} is not a checkpoint of `endless learn`: it has weights only")
    try:
        header = json.loads(metadata["endless"])
        state = {name: header[name] for name in ("version", "settings", "update", "steps")}
        if state["version"] == FILE_VERSION and metadata.get("crc32") != _checksum(metadata["endless"], tensors):
            raise ValueError("its checksum differs")
        model = {name: tensor for name, tensor in tensors.items() if not name.startswith("state/")}
        if other := [f"{tensor.dtype} in {name}" for name, tensor in model.items() if tensor.dtype != torch.float32]:
            raise ValueError(f"its weights must be float32, got {other[0]}")
    except (KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"checkpoint {file} is damaged: {error}") from error
    return state | {"model": model}


def to_safetensors(tensors: Mapping[str, torch.Tensor], header: Mapping[str, Any] | None = None) -> bytes:
    """A file of an agent, as docs/train/rust.md describes it.

    Args:
        tensors: Weights by name, float32, on the CPU and contiguous.
        header: The header without its version, which is added; `None` for a file of weights alone.
    """
    text = "" if header is None else json.dumps({"version": FILE_VERSION, **header}, separators=(",", ":"))
    metadata = {"crc32": _checksum(text, tensors)} | ({"endless": text} if text else {})
    return save_tensors(dict(tensors), metadata)


def _checksum(header: str, tensors: Mapping[str, torch.Tensor]) -> str:
    """As in the crate `endless-gym-kernels`, which defines it."""
    names = {torch.float32: "F32", torch.int32: "I32", torch.uint8: "U8", torch.uint64: "U64"}
    total = zlib.crc32(header.encode())
    for name, tensor in sorted(tensors.items()):
        described = f"{name} {names.get(tensor.dtype)} {list(tensor.shape)}"
        total = zlib.crc32(tensor.numpy().tobytes(), zlib.crc32(described.encode(), total))
    return f"{total:08x}"


def _agent(state: dict[str, Any], device: torch.device | str) -> tuple[Agent, Settings]:
    """The agent of a saved state, and its settings."""
    settings, model = from_dict(state["settings"]), state["model"]
    ranges.check(settings)
    for layers in (settings.recurrence.layers, settings.transformer.layers):
        if layers > max(len(model), Transformer.layers):
            raise ValueError(f"{layers} layers need more weights than the checkpoint's {len(model)}")
    if not (":" in settings.agent or settings.encoder):
        # Without memory for the weights, whose sizes the settings may exaggerate.
        with torch.device("meta"):
            expected = make_agent(settings, spec(settings.env), "meta").state_dict()
        for name, tensor in expected.items():
            if name not in model:
                raise ValueError(f"there are no weights {name}")
            if model[name].shape != tensor.shape:
                given, wanted = tuple(model[name].shape), tuple(tensor.shape)
                raise ValueError(f"{name} must have shape {wanted} according to the settings, got {given}")
    agent = make_agent(settings, spec(settings.env), device)
    agent.load_state_dict(model)
    return agent, settings


def start_from(agent: Agent, path: str | Path) -> str:
    """Copy the weights of a checkpoint into an agent. The encoder and the heads keep their values where the shapes differ.

    Returns:
        A line of text that says which weights were copied.

    Raises:
        FileNotFoundError: As for `load`.
        ValueError: As for `load`, or the memories or the layers after them differ.
    """
    own = agent.state_dict()
    given = load(path).agent.state_dict()
    fitting = {name: part for name, part in given.items() if name in own and own[name].shape == part.shape}
    missing = sorted(own.keys() - fitting.keys())
    core = [name for name in missing if name.startswith(("memory.", "body."))]
    if core or not fitting:
        raise ValueError(
            f"--init-from {path}: its {', '.join(core)} do not fit this agent's; use the same --agent and sizes"
        )
    agent.load_state_dict(own | fitting)
    others = f"; newly initialised: {', '.join(missing)}" if missing else ""
    return f"started from {len(fitting)} of {len(own)} tensors of {path}{others}"


def read_settings(run: str | Path) -> Settings:
    """Read the settings of the run in folder `run`.

    Raises:
        FileNotFoundError: The folder contains no run.
        ValueError: The run is of another program, or of another version of this one.
    """
    if not (Path(run) / SETTINGS).exists():
        raise FileNotFoundError(f"no run in {run}; expected a folder with {SETTINGS}, as endless-train writes it")
    try:
        return from_dict(json.loads(regular.text(Path(run) / SETTINGS)))
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f"{Path(run) / SETTINGS} is not of this version of endless-train ({error})") from None
