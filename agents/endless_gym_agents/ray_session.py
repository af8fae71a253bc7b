"""The connection to Ray, of a search and of the paper's experiments: started on this machine, or a cluster."""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

#: Bytes of a local Ray's object store. What runs on Ray shares only a few numbers.
_STORE = 100_000_000
#: Ray's setting whether it kills what its processes have started when these end, as an environment variable.
_KILL_CHILDREN = "RAY_kill_child_processes_on_worker_exit"


def check_installed(*names: str) -> None:
    """Check that Ray, and the further packages with these names, can be imported.

    Raises:
        ValueError: One is not installed.
    """
    for name in ("ray", *names):
        if importlib.util.find_spec(name) is None:
            raise ValueError(f"--ray needs Ray Tune, but {name} is not installed: pip install 'ray[tune]'")


def with_address(arguments: Sequence[str]) -> list[str]:
    """Command-line arguments in which `--ray` has an address, also if it was given without: `local`."""
    given = list(arguments)
    if "--ray" in given:
        after = given.index("--ray") + 1
        if after == len(given) or given[after].startswith("-"):
            given.insert(after, "local")
    return given


@contextmanager
def connected(address: str, spare_children: bool = False) -> Iterator[None]:
    """Connects this process to Ray, unless it is, and disconnects it. A local Ray ends then.

    Args:
        address: `local` to start Ray on this machine, or the address of a cluster.
        spare_children: Whether a local Ray lets processes live that its own have started, when these end.

    Raises:
        ValueError: There is no such cluster.
    """
    import ray

    if ray.is_initialized():
        yield
        return
    given: dict[str, Any] = {"address": address, "log_to_driver": False}
    if address == "local":
        given |= {"include_dashboard": False, "object_store_memory": _STORE}
        if (quoted := shlex.quote(sys.executable)) != sys.executable:
            # Ray starts its processes by a shell, to which it gives the interpreter's path without quotes.
            given["runtime_env"] = {"py_executable": quoted}
        if spare_children:
            os.environ.setdefault(_KILL_CHILDREN, "0")
    try:
        ray.init(**given)
    except ConnectionError as error:
        raise ValueError(f"--ray must be the address of a Ray cluster, got `{address}`: {error}") from None
    try:
        yield
    finally:
        ray.shutdown()


def gpus(wanted: float | None, device: str) -> float:
    """The GPUs of each run: those that are wanted, or by default 1 if Ray has any and the device is not `cpu`."""
    import ray

    if wanted is not None:
        return wanted
    return 1.0 if device != "cpu" and ray.cluster_resources().get("GPU") else 0.0
