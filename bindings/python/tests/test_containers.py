"""The containers of `compose.yaml` and `docs/operate/pod.yaml` work in IPC namespaces that have only /dev/shm in common."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

yaml = pytest.importorskip("yaml")
pytestmark = pytest.mark.libraries

ROOT = Path(__file__).parents[3]


@dataclass(frozen=True)
class Container:
    """The command of a container, and its surroundings."""

    command: list[str]
    environment: dict[str, str]
    user: Any
    #: Bytes of /dev/shm.
    shm: int
    #: The health check command.
    health: list[str]


def size(text: str) -> int:
    number, unit = re.fullmatch(r"(\d+)(gb|Gi)", text).groups()
    return int(number) * {"gb": 2**30, "Gi": 2**30}[unit]


def compose() -> tuple[Container, Container]:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    engine, trainer = services["engine"], services["trainer"]
    # They share memory and process ids, and the trainer waits for the engine.
    assert (engine["ipc"], trainer["ipc"], trainer["pid"]) == ("shareable", "service:engine", "service:engine")
    assert trainer["depends_on"] == {"engine": {"condition": "service_healthy"}}
    test = engine["healthcheck"]["test"]
    assert test[0] == "CMD"
    return tuple(
        Container(
            each["entrypoint"] + each["command"], each["environment"], each["user"], size(engine["shm_size"]), test[1:]
        )
        for each in (engine, trainer)
    )


def pod() -> tuple[Container, Container]:
    spec = yaml.safe_load((ROOT / "docs/operate/pod.yaml").read_text())["spec"]
    ((engine,), (trainer,), (volume,)) = spec["initContainers"], spec["containers"], spec["volumes"]
    assert spec["shareProcessNamespace"] is True
    assert engine["restartPolicy"] == "Always"
    assert volume["emptyDir"]["medium"] == "Memory"
    for each in (engine, trainer):
        assert each["volumeMounts"] == [{"name": volume["name"], "mountPath": "/dev/shm"}]
        # Memory in /dev/shm counts towards the limit of the container that writes to it.
        assert size(each["resources"]["limits"]["memory"]) > size(volume["emptyDir"]["sizeLimit"])
    return tuple(
        Container(
            each["command"] + each["args"],
            {variable["name"]: variable["value"] for variable in each["env"]},
            tuple(sorted(spec["securityContext"].items())),
            size(volume["emptyDir"]["sizeLimit"]),
            engine["startupProbe"]["exec"]["command"],
        )
        for each in (engine, trainer)
    )


FILES = pytest.mark.parametrize("containers", [compose, pod])


@FILES
def test_both_containers_have_one_user_and_one_root(containers: Any) -> None:
    engine, trainer = containers()
    assert engine.user == trainer.user
    assert engine.environment == trainer.environment
    assert engine.environment["ENDLESS_GYM_ROOT"].startswith("/dev/shm/")
    assert engine.health == ["endless", "status", "mortar"]
    arguments = dict(zip(engine.command[2::2], engine.command[3::2], strict=True))
    assert engine.command[:2] == ["endless", "serve"]
    # Each group has `--batches-held` + 2 batches, with 84 x 84 x 3 bytes and some numbers for each environment.
    needed = int(arguments["--num-envs"]) * int(arguments["--groups"]) * 5 * 22_000
    assert needed < engine.shm / 2


def test_compose_file_builds_the_image_that_it_runs() -> None:
    services = yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]
    assert (ROOT / services["engine"]["build"] / "Dockerfile").exists()
    assert {service["image"] for service in services.values()} == {"endless-gym"}
    # `useradd` of the image numbers its first user 1000.
    assert "USER endless" in (ROOT / "Dockerfile").read_text()
    assert {service["user"] for service in services.values()} == {"1000:1000"}


@pytest.fixture
def shared() -> Iterator[Path]:
    """A folder that stands for the /dev/shm of both containers."""
    folder = tempfile.mkdtemp(prefix="containers-", dir="/dev/shm")
    yield Path(folder)
    shutil.rmtree(folder)


def namespaces() -> list[str]:
    """A prefix for commands that gives them their own mount and IPC namespaces; empty if that is not permitted."""
    for unshare in (["unshare", "--mount", "--ipc"], ["unshare", "--mount", "--ipc", "--map-root-user"]):
        with contextlib.suppress(FileNotFoundError):
            mount = [*unshare, "mount", "--bind", "/dev/shm", "/dev/shm"]
            if subprocess.run(mount, capture_output=True).returncode == 0:
                return unshare
    return []


@FILES
def test_the_trainer_uses_the_engine(containers: Any, shared: Path, tmp_path: Path) -> None:
    engine, trainer = containers()
    unshare = namespaces()
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ENDLESS_")}

    def environment(container: Container) -> dict[str, str]:
        changed = dict(container.environment)
        if not unshare:
            changed["ENDLESS_GYM_ROOT"] = str(shared / "endless")
        return kept | changed | {"PATH": path}

    def command(given: list[str]) -> list[str]:
        if not unshare:
            return given
        return [*unshare, "sh", "-euc", 'mount --bind "$0" /dev/shm; exec "$@"', str(shared), *given]

    with (tmp_path / "log").open("w") as log:
        serving = subprocess.Popen(
            command(engine.command),
            env=environment(engine),
            stdout=log,
            stderr=log,
            cwd=tmp_path,
            start_new_session=True,
        )
        try:
            deadline = time.monotonic() + 100
            while subprocess.run(command(engine.health), env=environment(engine), capture_output=True).returncode:
                assert serving.poll() is None, (tmp_path / "log").read_text()
                assert time.monotonic() < deadline, "the health check never succeeded"
                time.sleep(0.2)
            trained = subprocess.run(
                command(trainer.command),
                env=environment(trainer),
                capture_output=True,
                text=True,
                timeout=150,
                cwd=tmp_path,
            )
            assert trained.returncode == 0, trained.stderr
            assert trained.stdout == "51200 environment steps\n"
        finally:
            # Like `docker stop` and the end of a pod.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(serving.pid, signal.SIGTERM)
            try:
                serving.wait(60)
            except subprocess.TimeoutExpired:
                os.killpg(serving.pid, signal.SIGKILL)
                raise
    assert serving.returncode == 0, (tmp_path / "log").read_text()
    # Only the root directory remains.
    assert sorted(path.name for path in shared.iterdir()) == ["endless"]
    # An engine that has ended is not healthy.
    assert subprocess.run(command(engine.health), env=environment(engine), capture_output=True).returncode == 1
