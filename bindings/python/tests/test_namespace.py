"""Who can use the files of engines, which directories and names are refused, and what limits of resources do."""

import contextlib
import os
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from support import engine_of_program, segments

import endless_gym
from endless_gym.program import program

ID = "MortarMayhem-Grid-v0"


@pytest.fixture
def parent(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder whose path is short enough for that of a root directory; `root` in it is the namespace."""
    with TemporaryDirectory(prefix="eg-", dir="/tmp") as folder:
        monkeypatch.setenv("ENDLESS_GYM_ROOT", f"{folder}/root")
        yield Path(folder)


@pytest.mark.parametrize("umask", [0, 0o077])
def test_only_the_owner_can_use_the_files_whatever_the_umask(umask: int, parent: Path) -> None:
    before = os.umask(umask)
    try:
        with endless_gym.serve(ID, 2) as envs, endless_gym.watch(envs._engine.service) as batches:
            envs.reset()
            next(batches)
            root = parent / "root"
            files = [root, *(Path("/dev/shm") / name for name in segments()), *root.glob("*")]
            open_to_others = [str(file) for file in files if file.is_file() and file.stat().st_mode & 0o077]
            assert len(files) > 5 and not open_to_others and not root.stat().st_mode & 0o077
    finally:
        os.umask(before)


def refused(reason: str) -> None:
    for call in (endless_gym.running_engines, lambda: endless_gym.serve(ID, 1), lambda: endless_gym.connect("gym")):
        with pytest.raises((RuntimeError, OSError), match=reason):
            call()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a directory to another user")
def test_a_root_directory_that_another_user_exchanged_is_not_followed(parent: Path) -> None:
    """Who can write to the parent directory can rename the root and make another."""
    parent.chmod(0o777)
    root = parent / "root"
    with endless_gym.serve(ID, 2) as envs:
        envs.reset()
        root.rename(parent / "taken")
        root.mkdir(mode=0o700)
        os.chown(root, 65534, 65534)
        refused("belongs to user 65534")
        assert not list(root.iterdir())
        root.rmdir()
        root.symlink_to(parent / "taken")
        refused("it must be a directory")
        root.unlink()


def test_engines_whose_names_begin_alike_are_told_apart(parent: Path) -> None:
    names = ["gym", "gym1", "gym.1", "GYM", "g" * 64, "g" * 63]
    with contextlib.ExitStack() as engines:
        for number, name in enumerate(names):
            engines.enter_context(engine_of_program(name, ID, f"--num-envs={number + 1}"))
        with contextlib.ExitStack() as connected:
            for number, name in enumerate(names):
                envs = connected.enter_context(contextlib.closing(endless_gym.connect(name, timeout=30)))
                assert envs.num_envs == number + 1
        assert sorted(endless_gym.running_engines()) == sorted(names)


@pytest.mark.parametrize(("limit", "value", "option"), [("NOFILE", 12, "ulimit -n"), ("FSIZE", 0, "ulimit -f")])
def test_an_engine_survives_an_observer_that_cannot_attach(limit: str, value: int, option: str, parent: Path) -> None:
    text = f"""
import resource, endless_gym
resource.setrlimit(resource.RLIMIT_{limit}, ({value}, {value}))
with endless_gym.watch("gym", timeout=5) as batches:
    next(batches)
"""
    actions = np.zeros(128, dtype=np.int64)
    with (
        engine_of_program("gym", ID, "--num-envs=128"),
        contextlib.closing(endless_gym.connect("gym", timeout=30)) as envs,
    ):
        envs.reset(seed=1)
        observer = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=60)
        error = observer.stderr.strip().splitlines()
        assert observer.returncode == 1 and option in error[-1], error
        for _ in range(3):
            envs.step(actions)
    assert not segments()


@pytest.fixture
def group() -> Iterator[Callable[[str, int], Path]]:
    """Makes control groups with a limit, for which a test needs root, or a group of its own that it may divide."""
    made = []

    def make(controller: str, limit: int) -> Path:
        root = Path("/sys/fs/cgroup")
        is_v2 = (root / "cgroup.controllers").exists()
        folder = (root if is_v2 else root / controller) / f"endless-{os.getpid()}"
        names = {"pids": "pids.max", "memory": "memory.max" if is_v2 else "memory.limit_in_bytes"}
        try:
            folder.mkdir()
            made.append(folder)
            (folder / names[controller]).write_text(str(limit))
        except OSError as error:
            pytest.skip(f"control groups cannot be made here: {error}")
        return folder

    yield make
    for folder in made:
        folder.rmdir()


@pytest.mark.parametrize(
    ("controller", "limit", "num_envs", "message"),
    [
        *(("pids", limit, 4, r"cannot start (a thread|[0-9] threads): Resource temporarily") for limit in range(1, 5)),
        ("memory", 200 << 20, 8192, "control group of this process .* is limited to 209 MB"),
        ("memory", 4 << 20, 4, "Killed, as the system does where a container or a batch job"),
    ],
)
def test_an_engine_says_which_limit_of_its_control_group_is_too_low(
    controller: str,
    limit: int,
    num_envs: int,
    message: str,
    group: Callable[[str, int], Path],
    parent: Path,
    tmp_path: Path,
) -> None:
    """The last limit is too low for the program."""
    folder, start = group(controller, limit), tmp_path / "start"
    start.write_text(f"""#!/bin/sh\necho $$ > {folder}/cgroup.procs\nexec {shlex.join(program())} "$@"\n""")
    start.chmod(0o755)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("endless_gym.engine.program", lambda native: [str(start)])
        with pytest.raises(RuntimeError, match=message) as raised:
            endless_gym.serve(ID, num_envs, num_threads=4)
    assert "\n" not in str(raised.value)
    # The next engine removes what a killed one left.
    with endless_gym.serve(ID, 4) as envs:
        envs.reset(seed=1)
    assert not segments()
