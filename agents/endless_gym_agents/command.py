"""Common parts of the commands: error messages and exit statuses."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import tyro
from rich.console import Console

T = TypeVar("T")

#: Exit status after SIGINT, by the convention of shells: 128 + 2.
INTERRUPTED = 130
#: What asks a command to stop: Ctrl-C, a scheduler or `docker stop`, and the end of the terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def on_stop_signals(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Handle `STOP_SIGNALS`. A SIGHUP that is ignored, as under `nohup`, stays ignored."""
    before: dict[int, Any] = {}
    try:
        # Only the main thread can install handlers, and only it is interrupted.
        with contextlib.suppress(ValueError):
            for number in STOP_SIGNALS:
                if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                    before[number] = signal.signal(number, handler)
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def drop_lost_outputs() -> None:
    """Redirect standard output and error to `/dev/null` if their terminal is closed or the reader of their pipe has ended."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for output in (1, 2):
        poll = select.poll()
        poll.register(output, 0)  # reports errors and hang-ups only
        if poll.poll(0):
            os.dup2(nowhere, output)
    os.close(nowhere)


class Terminal(Console):
    """A console on standard output that goes silent when nobody can read it any more, so that the work goes on."""

    def print(self, *objects: Any, **arguments: Any) -> None:
        """Print as `Console.print`, without wrapping lines."""
        try:
            super().print(*objects, **{"soft_wrap": True} | arguments)
        except OSError:
            drop_lost_outputs()

    def on_broken_pipe(self) -> None:
        """As for a closed terminal; rich would end the process."""
        drop_lost_outputs()


def run(name: str, work: Callable[[], object]) -> int:
    """Run a command, and report user errors in one line on standard error.

    Args:
        name: Name of the command.
        work: The command. `ValueError`, `OSError`, `ModuleNotFoundError` and `KeyboardInterrupt` are reported without traceback.

    Returns:
        The exit status.
    """
    try:
        work()
    except KeyboardInterrupt:
        print(f"{name}: stopped", file=sys.stderr)
        return INTERRUPTED
    except ModuleNotFoundError as error:
        print(f"{name}: {error.name} is not installed", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


def main(
    name: str, arguments: type[T], execute: Callable[[T], object], text: str | None, given: list[str] | None = None
) -> int:
    """Parse the arguments `given` to a command, by default the process's, and `run` it; `text` is its module's docstring."""
    parsed = tyro.cli(arguments, prog=name, description=description(text), args=given)
    return run(name, lambda: execute(parsed))


def description(text: str | None) -> str:
    """The part of a module's docstring before its examples, as the description in a command's help."""
    return (text or "").split("```")[0].strip()
