"""Common parts of the commands: error messages and exit statuses."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import json
import os
import re
import select
import signal
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args, get_origin, get_type_hints

import tyro
from rich.console import Console
from rich.text import Text

from endless_gym.program.printable import printable, printable_lines
from endless_gym_agents.common import ranges

T = TypeVar("T")

#: Exit status after SIGINT, by the convention of shells: 128 + 2.
INTERRUPTED = 130
#: What asks a command to stop: Ctrl-C, a scheduler or `docker stop`, and the end of the terminal.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextlib.contextmanager
def on_stop_signals(handler: Callable[[int, Any], object]) -> Iterator[None]:
    """Handle `STOP_SIGNALS`. A SIGHUP that is ignored, as under `nohup`, stays ignored."""
    before: dict[signal.Signals, Any] = {}
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
    """A console for text from files and other processes, without markup and with control characters escaped. It goes silent when
    nobody can read it any more, so that the work goes on.
    """

    def __init__(self, **arguments: Any) -> None:
        """As for `Console`."""
        super().__init__(markup=False, emoji=False, **{"highlight": False} | arguments)

    def render_str(self, text: str, **arguments: Any) -> Text:
        """As `Console.render_str`, which all texts and the cells of tables pass."""
        return super().render_str(printable_lines(text), **arguments)

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
        print(f"{name}: {printable(error.msg)}", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"{name}: {printable(' '.join(str(error).split()))}", file=sys.stderr)
        return 1
    return 0


def main(
    name: str, arguments: type[T], execute: Callable[[T], object], text: str | None, given: list[str] | None = None
) -> int:
    """Parse and check the arguments `given` to a command, by default the process's, and `run` it.

    `text` is the docstring of its module.
    """
    parsed = parse(arguments, name, text, given)

    def work() -> None:
        ranges.check(parsed)
        execute(parsed)

    return run(name, work)


def parse(
    arguments: type[T], name: str, text: str | None, given: Sequence[str] | None = None, default: T | None = None
) -> T:
    """Parse the arguments `given` to a command as for `main`; the values of a repeated flag accumulate."""
    given = joined(_repeatable(arguments), sys.argv[1:] if given is None else given)
    known = tyro.MISSING_NONPROP if default is None else default
    return tyro.cli(arguments, prog=name, description=description(text), args=given, default=known)


def flags(values: Mapping[str, Any]) -> list[str]:
    """Command-line arguments for flags, without dashes, and their values; a list is several values."""
    arguments: list[str] = []
    for name, value in values.items():
        if isinstance(value, bool):
            group, dot, entry = name.rpartition(".")
            arguments.append(f"--{name}" if value else f"--{group}{dot}no-{entry}")
        else:
            arguments += [f"--{name}", *(map(str, value) if isinstance(value, list) else [str(value)])]
    return arguments


def assignments(values: Mapping[str, Any]) -> tuple[str, ...]:
    """Values by name, each as NAME=VALUE with a JSON value, as `--environment.option` takes them."""
    return tuple(f"{name}={json.dumps(value)}" for name, value in values.items())


def folder_name(env: str) -> str:
    """An environment's id as a folder, without the `?` and `&` of arguments, which a shell reads otherwise."""
    return re.sub("[?&]", "_", env)


def check_installed(user: str, package: str, extra: str = "train") -> None:
    """Check that a package of an extra of this package is installed.

    Raises:
        ModuleNotFoundError: It is not; the message names its user and the extra.
    """
    if importlib.util.find_spec(package) is None:
        raise ModuleNotFoundError(
            f"{user} needs {package}, which is not installed: pip install './agents[{extra}]', or the wheel file with "
            f"`[{extra}]` appended",
            name=package,
        )


def check_outputs(outputs: Iterable[Path | None], inputs: Iterable[Path]) -> None:
    """Check that a command does not write into a file that it reads, by whatever name, nor twice into one file.

    Raises:
        ValueError: It would.
    """
    given, read = [output for output in outputs if output is not None], list(inputs)
    for number, output in enumerate(given):
        for other in (*read, *given[:number]):
            if output.resolve() == other.resolve() or (output.is_file() and other.is_file() and output.samefile(other)):
                raise ValueError(f"cannot write {output}, which is the file {other}; choose another file")


def joined(repeatable: Collection[str], given: Sequence[str]) -> list[str]:
    """The arguments with all values of each repeatable flag behind its first occurrence; tyro takes those of the last one."""
    parts: list[list[str]] = []
    of_flag: dict[str, list[str]] = {}
    values: list[str] | None = None
    for argument in given:
        flag, equals, value = argument.partition("=")
        flag = flag.replace("_", "-")
        if flag in repeatable:
            if flag not in of_flag:
                parts.append(of_flag.setdefault(flag, [flag]))
            of_flag[flag] += [value] if equals else []
            values = None if equals else of_flag[flag]
        elif values is None or argument.startswith("--"):
            parts.append([argument])
            values = None
        else:
            values.append(argument)
    return [argument for part in parts for argument in part]


def _repeatable(arguments: Any, prefix: str = "--") -> set[str]:
    """The flags that take any number of values."""
    names: set[str] = set()
    for name, hint in get_type_hints(arguments, include_extras=True).items():
        kind, *annotations = get_args(hint) if get_origin(hint) is Annotated else (hint,)
        flag = "" if any(getattr(each, "name", None) == "" for each in annotations) else name.replace("_", "-")
        if dataclasses.is_dataclass(kind):
            names |= _repeatable(kind, f"{prefix}{flag}." if flag else prefix)
        elif get_origin(kind) is tuple and Ellipsis in get_args(kind):
            names.add(prefix + flag)
    return names


def description(text: str | None) -> str:
    """The part of a module's docstring before its examples, as the description in a command's help."""
    return (text or "").split("```")[0].strip()
