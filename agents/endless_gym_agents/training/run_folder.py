"""The folder of a run, and the lock of the process that trains in it."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import socket
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from endless_gym.program.printable import printable
from endless_gym_agents.common import atomic, command
from endless_gym_agents.settings import Settings
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import PROGRESS

#: File in the folder of a run while a process trains there. The process holds a lock on it; its text says which process that is.
LOCK = "lock"


class RunInUse(OSError):
    """Another process trains in the folder."""


@contextlib.contextmanager
def opened(settings: Settings, restarts: int = 0) -> Iterator[tuple[str, bool]]:
    """Make the folder of a new run, or open that of a run to resume, and hold its lock.

    A folder that this call made is removed again if nothing has been written into it.

    Args:
        settings: Settings of the run.
        restarts: How often `torchrun` has restarted the run.

    Yields:
        The folder, and whether it contains a run that has begun, to resume from its checkpoint.

    Raises:
        RunInUse: Another process trains in the folder.
        FileExistsError: The folder of a new run contains another run.
        FileNotFoundError: There is no run to resume.
        ValueError: The run was restarted, and its folder has no fixed name; or the name is not UTF-8.
    """
    if restarts and not (settings.run or settings.resume):
        raise ValueError("a run that torchrun starts again needs --run, to find its checkpoint; got no folder")
    try:
        f"{settings.run}{settings.resume}".encode()
    except UnicodeEncodeError:
        raise ValueError("the name of a run's folder must be UTF-8, since the settings of the run contain it") from None
    if settings.resume:
        checkpoint.read_settings(settings.resume)
    run = Path(settings.resume or settings.run) if settings.resume or settings.run else _new_folder(settings)
    is_new = not run.exists() or not any(run.iterdir())
    run.mkdir(parents=True, exist_ok=True)
    try:
        with locked(run):
            if (run / checkpoint.SETTINGS).exists() and not (settings.resume or restarts):
                raise FileExistsError(
                    f"{run} already contains a run; continue it with --resume {run}, or choose another folder"
                )
            progress = run / PROGRESS
            # The first checkpoint is older than the first row.
            has_begun = checkpoint.last(run).exists() or (progress.exists() and progress.stat().st_size > 0)
            yield str(run), has_begun and bool(settings.resume or restarts)
    finally:
        if is_new:
            with contextlib.suppress(OSError):  # It has files.
                run.rmdir()


def _new_folder(settings: Settings) -> Path:
    """Make the folder of a run without a given one; runs that start in the same second get different folders."""
    name = f"{settings.agent_name}-{settings.seed}-{time.strftime('%Y%m%d-%H%M%S')}"
    for suffix in itertools.chain([""], (f"-{number}" for number in itertools.count(2))):
        run = Path("runs", command.folder_name(settings.env), name + suffix)
        with contextlib.suppress(FileExistsError):
            run.mkdir(parents=True)
            break
    return run


@contextlib.contextmanager
def locked(run: Path) -> Iterator[None]:
    """Hold the lock of a folder. The operating system releases it when the process ends for any reason.

    Raises:
        RunInUse: Another process holds it.
    """
    path = run / LOCK
    while True:
        with path.open("a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                holder = file.read().strip() or "another process"
                raise RunInUse(f"{run} is in use by {holder}; wait until it ends, or choose another folder") from None
            except OSError as error:  # The file system has no locks.
                warnings.warn(f"{printable(run)} cannot be locked ({error}); start only one run in it", stacklevel=2)
            if os.fstat(file.fileno()).st_nlink == 0:
                continue  # The process that held the lock has removed the file.
            text = f"process {os.getpid()} on {socket.gethostname()} since {time.strftime('%Y-%m-%d %H:%M:%S')}\n"
            try:
                with atomic.named(path):
                    file.truncate(0)
                    # Without a buffer, which would be written again on a full disk when the file is closed.
                    os.write(file.fileno(), text.encode())
                yield
            finally:
                path.unlink(missing_ok=True)
            return
