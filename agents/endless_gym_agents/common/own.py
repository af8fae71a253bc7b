"""Classes in a module or a file, of the package or your own, named by `--agent`, `--encoder` and `--environment.wrapper`."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

#: The class of each memory, as `module:Class`, by the name that `--agent` takes.
MEMORIES = {
    "mingru": "endless_gym_agents.memories.mingru:MinGRU",
    "lru": "endless_gym_agents.memories.lru:LRU",
    "mamba2": "endless_gym_agents.memories.mamba2:Mamba2",
    "gated-deltanet": "endless_gym_agents.memories.gated_deltanet:GatedDeltaNet",
    "retnet": "endless_gym_agents.memories.retnet:RetNet",
    "mlstm": "endless_gym_agents.memories.mlstm:MLSTM",
    "ffm": "endless_gym_agents.memories.ffm:FFM",
    "shm": "endless_gym_agents.memories.shm:SHM",
}


def resolved(name: str) -> str:
    """The name `module:Class` or `file.py:Class` with an absolute path, so that it holds in other working folders."""
    place, _, member = name.rpartition(":")
    return f"{Path(place).resolve()}:{member}" if place.endswith(".py") else name


def load(flag: str, name: str, base: type[T]) -> type[T]:
    """The class of a name `module:Class` or `file.py:Class`. Its module is imported, and thereby executed.

    Args:
        flag: The flag that gave the name, for messages.
        name: The name.
        base: The class that it must be derived from.

    Raises:
        ValueError: There is no such module, file or class, or it is not derived from `base`.
    """
    place, _, member = name.rpartition(":")
    try:
        found = getattr(_module(place), member)
    except (AttributeError, ImportError, OSError, ValueError) as error:
        raise ValueError(
            f"{flag} must be module:Class or file.py:Class of a class that can be imported, got `{name}`: {error}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, base)):
        raise ValueError(f"{flag} must name a class derived from {base.__name__}, got `{name}`, {found!r}")
    return found


def _module(place: str) -> Any:
    if not place.endswith(".py"):
        return importlib.import_module(place)
    # One module for each file, so that its classes are the same in every call.
    name = f"endless_gym_agents_own_{Path(place).resolve()}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, place)
        if spec is None or spec.loader is None or not Path(place).is_file():
            raise FileNotFoundError(f"no file {place}")
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]
