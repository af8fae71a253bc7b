"""`endless record`: record episodes of a scripted expert or of random actions as a Minari data set.

The data set is for `minari.load_dataset(NAME)`.
The metadata of an episode has its seed, options, error rate, return and final infos.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

from endless_gym.program.printable import printable
from endless_gym.recording.recorder import Recording, record
from endless_gym.specs import Frames

#: Exit statuses: after an error; after SIGINT, by the convention of shells: 128 + 2.
FAILURE, INTERRUPTED = 1, 130


def main(arguments: Sequence[str]) -> int:
    """Run `endless record` with these arguments, and return its exit status."""
    given = _parser().parse_args(arguments)
    return run("endless record", lambda: _execute(given))


def run(name: str, work: Callable[[], object]) -> int:
    """Run a command that records, and report user errors in one line on standard error; return the exit status.

    SIGTERM and SIGHUP stop it like Ctrl-C, so that nothing half-written is left.
    """
    signals = (signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(number, _interrupt) for number in signals]
    try:
        work()
    except KeyboardInterrupt:
        print(f"{name}: stopped, and wrote nothing", file=sys.stderr)
        return INTERRUPTED
    except (ImportError, OSError, TypeError, ValueError) as error:
        print(f"{name}: {printable(' '.join(str(error).split()))}", file=sys.stderr)
        return FAILURE
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
    return 0


def _interrupt(number: int, frame: object) -> None:
    raise KeyboardInterrupt


def show(recording: Recording, as_json: bool) -> None:
    """Print what was recorded."""
    per_minute = recording.episodes / recording.seconds * 60
    numbers = {**asdict(recording), "path": str(recording.path), "episodes_per_minute": per_minute}
    if as_json:
        print(json.dumps(numbers))
        return
    print(f"{recording.episodes:,} episodes, {recording.steps:,} steps, {recording.megabytes:,.1f} MB")
    print(f"mean return {recording.mean_return:.3f}, mean length {recording.mean_length:.1f}")
    print(f"{recording.seconds:.1f} s, {per_minute:,.0f} episodes per minute")
    print(f"{printable(recording.path)}\nminari.load_dataset({recording.dataset!r})")


@contextmanager
def progress(episodes: int) -> Iterator[Callable[[int], None]]:
    """A progress bar on standard error, hidden if that is not a terminal."""
    try:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    except ImportError as error:
        raise ImportError(
            f"{error.name} is not installed: pip install './bindings/python[minari]', or the wheel file with `[minari]` appended"
        ) from error
    columns = (
        TextColumn("recording"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("episodes"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("recording", total=episodes)
        yield lambda done: bar.update(task, completed=done)


def write(given: argparse.Namespace, id: str, **arguments: Any) -> None:
    """Record as the arguments of `parser` say, with further ones of `record`, and print what was recorded."""
    with progress(given.episodes) as bar:
        recording = record(
            id,
            given.episodes,
            error_rates=given.error_rates or [0.0],
            seed=given.seed,
            action_seed=given.action_seed,
            max_steps=given.max_steps,
            dataset=given.name,
            root=given.root,
            overwrite=given.overwrite,
            author=given.author,
            num_threads=given.threads,
            progress=bar,
            **arguments,
        )
    show(recording, given.json)


def _execute(given: argparse.Namespace) -> None:
    if given.options and given.option:
        raise ValueError("--option and --options cannot be given together")
    format = Frames(given.grayscale, given.channels_first, given.row_major, given.frame_stack)
    write(
        given,
        given.id,
        policy=given.policy,
        options=[_object(text) for text in given.options] or _parameters(given.option),
        observation=given.observation,
        frames=None if format == Frames() else format,
    )


def _parameters(given: Sequence[str]) -> dict[str, Any]:
    """Reset parameters from `NAME=VALUE`."""
    options = {}
    for text in given:
        name, equals, value = text.partition("=")
        if not equals:
            raise ValueError(f"--option must be NAME=VALUE, such as arena_size=6, got {text}")
        try:
            options[name] = json.loads(value)
        except json.JSONDecodeError:
            # The parameter's own check reports the allowed values.
            options[name] = value
    return options


def _object(text: str) -> dict[str, Any]:
    try:
        options = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"--options must be a JSON object, got {text}: {error}") from None
    if not isinstance(options, dict):
        raise ValueError(f"--options must be a JSON object, got {text}")
    return options


def parser(name: str, description: str, default: str) -> argparse.ArgumentParser:
    """A parser with the arguments of every command that records; `default` is the data set's default id."""
    parser = argparse.ArgumentParser(prog=name, description=description, allow_abbrev=False)
    add = parser.add_argument
    add("--episodes", type=int, default=1000, metavar="N", help="number of episodes [default: 1000]")
    add(
        "--error-rate",
        "--error-rates",
        dest="error_rates",
        type=float,
        nargs="+",
        action="extend",
        metavar="P",
        help="probability that a step takes a random action instead of the policy's; episodes cycle through several [default: 0]",
    )
    add("--seed", type=int, default=0, help="episode i has the seed SEED + i [default: 0]")
    add(
        "--action-seed",
        type=int,
        default=0,
        metavar="SEED",
        help="seed of an agent's and of random actions [default: 0]",
    )
    add(
        "--max-steps",
        type=int,
        metavar="N",
        help="truncate episodes after N steps [default: 1000 in environments without a step limit]",
    )
    add("--name", metavar="DATASET", help=f"id of the data set [default: {default}]")
    add(
        "--root",
        metavar="FOLDER",
        help="folder of the data sets [default: MINARI_DATASETS_PATH, or ~/.minari/datasets]",
    )
    add("--overwrite", action="store_true", help="replace a data set of that id")
    add("--author", metavar="NAME", help="author in the metadata [default: none]")
    add("--threads", type=int, default=0, metavar="N", help="threads that play; 0 for one per core [default: 0]")
    add("--json", action="store_true", help="print JSON [default: text]")
    return parser


def _parser() -> argparse.ArgumentParser:
    made = parser("endless record", __doc__.partition(": ")[2], "endless-gym/ID/expert-v0, or random-v0")
    add = made.add_argument
    add("id", metavar="ID", help="environment id; `endless list` lists them")
    add("--film", metavar="FILE", help="write a film instead; `endless record --film FILE --help` lists its options")
    add("--policy", choices=("expert", "random"), default="expert", help="who plays [default: expert]")
    add(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="reset parameter of all episodes; may be repeated",
    )
    add(
        "--options",
        action="append",
        default=[],
        metavar="JSON",
        help="reset parameters as a JSON object; if repeated, episodes cycle through them",
    )
    add(
        "--observation", metavar="KIND", help="rgb, features or rgb+features [default: rgb, or features without frames]"
    )
    add("--grayscale", action="store_true", help="frames without colours")
    add("--channels-first", action="store_true", help="frames with the channel as the first axis")
    add("--row-major", action="store_true", help="frames indexed [row][column] [default: [x][y]]")
    add("--frame-stack", type=int, default=1, metavar="N", help="stack the last N frames [default: 1]")
    return made
