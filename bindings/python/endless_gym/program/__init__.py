"""The command that starts the program `endless` in a new process."""

import sys
from types import ModuleType
from typing import Any

from endless_gym import _native

# Ctrl-C must end the process until the program handles it: Python's handler would only take effect in the next line of Python,
# after the program's end. An ignored SIGINT stays ignored. `_signal` is built into the interpreter.
#
# Loads the native module from its file, so that neither this package nor numpy and Gymnasium are imported.
_PROGRAM = """
import _signal
import sys
if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:
    _signal.signal(_signal.SIGINT, _signal.SIG_DFL)
from importlib.util import module_from_spec, spec_from_file_location
spec = spec_from_file_location(sys.argv[1].rpartition("/")[2].partition(".")[0], sys.argv[1])
native = module_from_spec(spec)
spec.loader.exec_module(native)
executable = [sys.executable, "-I", "-S", "-c", sys.orig_argv[sys.orig_argv.index("-c") + 1], sys.argv[1]]
sys.exit(native.endless(sys.argv[2:], executable))
"""

#: Arguments of `Popen` for a process group of its own, so that only this process receives Ctrl-C, and then stops the child.
#: Python 3.10 can only start a session, which makes a step of an engine a third slower, since Linux schedules sessions as units.
OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"start_new_session": True}


def program(native: ModuleType = _native) -> list[str]:
    """The command that starts the program `endless` with the environments of a native module."""
    return [sys.executable, "-I", "-S", "-c", _PROGRAM, str(native.__file__)]
