"""Common parts of the commands: error messages and exit statuses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TypeVar

import tyro

T = TypeVar("T")

#: Exit status after SIGINT, by the convention of shells: 128 + 2.
INTERRUPTED = 130


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
