"""The program `endless`, which is part of the package."""

import sys

from endless_gym import _native

# Loads the native module from its file, without the package, which would import numpy and Gymnasium.
_PROGRAM = """
import sys
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location("_native", sys.argv[1])
native = module_from_spec(spec)
spec.loader.exec_module(native)
itself = [sys.executable, "-I", "-S", "-c", sys.orig_argv[sys.orig_argv.index("-c") + 1], sys.argv[1]]
sys.exit(native.endless(sys.argv[2:], itself))
"""


def program() -> list[str]:
    """The command line that starts the program `endless`."""
    return [sys.executable, "-I", "-S", "-c", _PROGRAM, str(_native.__file__)]


def main() -> int:
    """Run the program with the arguments of this process; returns the exit status."""
    return _native.endless(sys.argv[1:], program())
