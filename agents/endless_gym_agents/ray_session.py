"""The connection to Ray, on this machine or a cluster, for a search or for the paper's experiments."""

from __future__ import annotations

import importlib.util
import os
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from endless_gym import running_engines

#: Size of a local Ray's object store in bytes; small, since jobs share only a few numbers.
_STORE = 100_000_000
#: Environment variable that tells Ray whether to kill the children of its worker processes when the workers exit.
_KILL_CHILDREN = "RAY_kill_child_processes_on_worker_exit"


def check_installed(*names: str) -> None:
    """Check that Ray and the packages with these names are installed.

    Raises:
        ValueError: One of them is not installed.
    """
    for name in ("ray", *names):
        if importlib.util.find_spec(name) is None:
            raise ValueError(f"--ray needs Ray Tune, but {name} is not installed: pip install 'ray[tune]'")


def with_address(arguments: Sequence[str]) -> list[str]:
    """Command-line arguments in which `--ray` has an address: `local` if none was given."""
    given = list(arguments)
    if "--ray" in given:
        after = given.index("--ray") + 1
        if after == len(given) or given[after].startswith("-"):
            given.insert(after, "local")
    return given


@contextmanager
def connected(address: str, spare_children: bool = False) -> Iterator[None]:
    """Connect this process to Ray for the `with` block, unless it already is connected. A local Ray ends with the block.

    Args:
        address: `local` to start Ray on this machine, or the address of a cluster.
        spare_children: Whether the children of a local Ray's worker processes may outlive them.

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
            # Ray starts its processes through a shell and does not quote the interpreter's path.
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
        # Ray kills trainers that take long to stop. Listing the engines removes the shared memory of dead processes.
        running_engines()


def gpus(wanted: float | None, device: str) -> float:
    """GPUs per run: `wanted`, or by default 1 if Ray has any and the device is not `cpu`, else 0."""
    import ray

    if wanted is not None:
        return wanted
    return 1.0 if device != "cpu" and ray.cluster_resources().get("GPU") else 0.0
