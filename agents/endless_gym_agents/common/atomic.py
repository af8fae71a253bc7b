"""Files that are replaced as a whole, so that a killed program or a full disk leaves the former content."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def named(file: Path) -> Iterator[None]:
    """Add the name of the file to errors that have none, such as those of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = str(file)
        raise


@contextlib.contextmanager
def replacing(file: str | Path) -> Iterator[Path]:
    """Yield the path of a new file in the same folder, which replaces `file` once the block has ended and it is on disk.

    The file keeps the mode of the one that it replaces. A link is replaced, and its target kept. What is not a regular file, such
    as a pipe or `/dev/stdout`, is yielded itself.

    Raises:
        OSError: The file cannot be written; it then has its former content, or the new one if only its folder cannot be flushed.
    """
    file = Path(file)
    if (file.exists() and not file.is_file()) or str(file).startswith(("/dev/std", "/dev/fd/", "/proc/")):
        yield file
        return
    new = file.with_name(f"{file.name}.new")
    # What a killed process left. It may also be a link, whose target must not be written.
    new.unlink(missing_ok=True)
    new.touch(exist_ok=False)
    try:
        with named(file):
            former = file if file.is_file() and not file.is_symlink() else new
            mode = stat.S_IMODE(former.stat().st_mode)
            new.chmod(mode | stat.S_IWUSR)
            yield new
            _flush(new)
            new.chmod(mode)
            new.replace(file)
    except BaseException:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    _flush(file.parent)


def _flush(path: Path) -> None:
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def write(file: str | Path, content: str | bytes | memoryview) -> None:
    """Replace a file by this content, text as UTF-8.

    Raises:
        OSError: As for `replacing`.
    """
    with replacing(file) as new:
        new.write_bytes(content.encode() if isinstance(content, str) else content)
