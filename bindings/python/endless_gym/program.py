"""The command-line program `endless`."""

import os
import shutil
import signal
import sys

from endless_gym import _native

# Ctrl-C ends the process until the program handles it: Python's handler only makes a note for the next line of Python, which
# comes after the program's end. A SIGINT that is ignored stays so. `_signal` is compiled into the interpreter.
#
# Loads the native module from its file, so that neither this package nor numpy and Gymnasium are imported.
_PROGRAM = """
import _signal
import sys
if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location("_native", sys.argv[1])
native = module_from_spec(spec)
spec.loader.exec_module(native)
executable = [sys.executable, "-I", "-S", "-c", sys.orig_argv[sys.orig_argv.index("-c") + 1], sys.argv[1]]
sys.exit(native.endless(sys.argv[2:], executable))
"""


def program() -> list[str]:
    """The command that starts the program `endless`."""
    return [sys.executable, "-I", "-S", "-c", _PROGRAM, str(_native.__file__)]


def _is_film(arguments: list[str]) -> bool:
    """Whether these arguments of `record` ask for a film, which the program writes itself."""
    return any(argument.partition("=")[0] == "--film" for argument in arguments)


def _find_ffmpeg() -> None:
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
        # It needs Python's libraries, and so the whole package.
        from endless_gym.recording import command

        return command.main(sys.argv[2:])
    if sys.argv[1:2] == ["record"]:
        _find_ffmpeg()
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    return _native.endless(sys.argv[1:], program())
