"""Reads files whose paths come from users."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO


def opened(path: str | Path) -> BinaryIO:
    """Open a regular file for reading. Opening a FIFO would wait for a writer, and a device may never end.

    Raises:
        OSError: The file cannot be opened, or is not a regular file.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(f"{path} is not a regular file")
    return os.fdopen(descriptor, "rb")


def text(path: str | Path) -> str:
    """The text of a regular file, as long as it is when it is opened.

    Raises:
        OSError: As for `opened`.
        UnicodeDecodeError: The text is not UTF-8.
    """
    with opened(path) as file:
        return file.read(os.fstat(file.fileno()).st_size).decode()
