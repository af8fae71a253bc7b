"""The entry point of `endless`: Python writes data sets (`endless record` without `--film`), the native module the rest."""

import os
import shutil
import signal
import sys

from endless_gym import _native
from endless_gym.program import program


def _is_film(arguments: list[str]) -> bool:
    """Whether these arguments of `record` request a film, which the native program writes."""
    return any(argument.partition("=")[0] == "--film" for argument in arguments)


def find_ffmpeg() -> None:
    """Let the program use the ffmpeg of the package imageio-ffmpeg if the system has none."""
    if "IMAGEIO_FFMPEG_EXE" in os.environ or shutil.which("ffmpeg"):
        return
    try:
        import imageio_ffmpeg
    except ImportError:
        return
    os.environ["IMAGEIO_FFMPEG_EXE"] = imageio_ffmpeg.get_ffmpeg_exe()


def main() -> int:
    """Run the program with this process's arguments, and return its exit status."""
    if sys.argv[1:2] == ["record"] and not _is_film(sys.argv[2:]):
        # Imported here, since only this command needs the whole package.
        from endless_gym.recording import command

        return command.main(sys.argv[2:])
    if sys.argv[1:2] == ["record"]:
        find_ffmpeg()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _native.endless(sys.argv[1:], program())
