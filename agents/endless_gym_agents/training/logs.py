"""Logs of a run: one line per update on the terminal, `progress.jsonl`, TensorBoard and Weights & Biases."""

from __future__ import annotations

import contextlib
import itertools
import json
import math
import os
import secrets
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from endless_gym.specs import Spec
from endless_gym_agents.common import atomic, regular
from endless_gym_agents.common.clock import duration
from endless_gym_agents.common.command import Terminal
from endless_gym_agents.settings import Settings, to_dict

#: Log file in the folder of a run, with one JSON object per update.
PROGRESS = "progress.jsonl"
#: Number of most recent episodes over which means are computed.
RECENT = 100
#: Seconds from which a run is announced as long: a day.
_LONG = 86_400.0


class MissingRow(ValueError):
    """The log of a run has no row of an update before its last one, or before the run's checkpoint."""


class Logger:
    """Writes the metrics of each update."""

    def __init__(self, run: Path, settings: Settings, update: int = 0, steps: int = 0) -> None:
        """Open the logs of a run.

        Args:
            run: Folder of the run.
            settings: Settings of the run.
            update: Number of updates so far. What follows their rows is cut off: rows of later updates, and the part of a row
                that a killed process wrote.
            steps: Number of environment steps so far.

        Raises:
            MissingRow: There is no row of one of these updates.
        """
        from torch.utils.tensorboard import SummaryWriter

        self.console = Terminal()
        self._updates = settings.ppo.updates
        self._recent: deque[float] = deque(maxlen=20)
        self._has_warned = False
        # Before it is opened for appending, which would wait if it were a FIFO.
        ends = [0, *(end for _, end in itertools.islice(_rows(run), update))]
        if len(ends) <= update:
            raise MissingRow(
                f"{run / PROGRESS} has no row of update {len(ends)}, and the checkpoint is of update {update}; {_help(run)}"
            )
        self._at_most = "at most " if settings.stop_when_learnt or settings.target_reward is not None else ""
        self._progress = (run / PROGRESS).open("ab")
        self._progress.truncate(ends[update])
        # The axis is environment steps, in which runs of different settings can be compared.
        self._board: Any = SummaryWriter(str(run), purge_step=steps + 1)  # type: ignore[no-untyped-call]
        rows = "\n".join(f"|{name}|{value}|" for name, value in _flat(to_dict(settings)))
        self._board.add_text("settings", f"|setting|value|\n|-|-|\n{rows}", steps)
        self._wandb: Any = _weights_and_biases(run, settings, self.console) if settings.wandb else None

    def update(self, metrics: dict[str, Any], seconds: dict[str, float]) -> None:
        """Log one update.

        Args:
            metrics: Metrics of the update by name, with `update`, `steps`, `steps_per_second`, `loss` and `entropy`.
            seconds: Seconds by phase.
        """
        row = metrics | {f"seconds/{name}": value for name, value in seconds.items()}
        numbers = {name: None if math.isnan(value) else value for name, value in row.items()}
        with atomic.named(Path(self._progress.name)):
            self._progress.write(f"{json.dumps(numbers)}\n".encode())
            self._progress.flush()
        update, steps = metrics["update"], metrics["steps"]
        for name, value in row.items():
            if name not in ("update", "steps"):
                self._board.add_scalar(name if "/" in name else f"learning/{name}", value, steps)
        self._board.add_scalar("update", update, steps)
        if self._wandb is not None:
            self._wandb.log(row, step=steps)
        total = sum(seconds.values()) or 1.0
        self._recent.append(total)
        left = (self._updates - update) * sum(self._recent) / len(self._recent)
        shares = " ".join(f"{name} {value / total:4.0%}" for name, value in seconds.items())
        reward = metrics.get("episode/reward")
        episodes = (
            "no episode has ended yet"
            if reward is None
            else (f"reward {reward:.4f} length {metrics['episode/length']:.1f}")
        )
        self.console.print(
            f"[bold]{update:>5}[/]/{self._updates} {steps:>11,} steps {metrics['steps_per_second']:>8,.0f}/s "
            f"{self._at_most}{duration(left):>12} left  "
            f"[green]{episodes}[/]  loss {metrics['loss']:.4f} entropy {metrics['entropy']:.3f}  [dim]{shares}[/]",
            markup=True,
        )

        if not self._has_warned and left > _LONG:
            self._has_warned = True
            self.print(
                f"at this speed the run takes {duration(left)} more; shorter: --preset quick (minutes), "
                "--total-steps, or a GPU"
            )

    def sync(self) -> None:
        """Wait until the rows are on disk. A checkpoint must not outlive the rows of its updates when the machine fails."""
        with atomic.named(Path(self._progress.name)):
            os.fsync(self._progress.fileno())

    def print(self, text: str) -> None:
        """Print a line on the terminal."""
        self.console.print(text)

    def close(self) -> None:
        """Close all files."""
        self._progress.close()
        self._board.close()
        if self._wandb is not None:
            self._wandb.finish()


class SilentLogger(Logger):
    """The logger of all ranks but the first: writes nothing."""

    def __init__(self) -> None:
        """Open nothing."""

    def _nothing(self, *given: object) -> None:
        """Write nothing."""

    update = sync = print = close = _nothing  # type: ignore[assignment]


def means(episodes: Collection[dict[str, float]]) -> dict[str, float]:
    """Mean of each final info of the episodes under the key `episode/NAME`; empty without episodes."""
    names = next(iter(episodes), {})
    return {f"episode/{name}": sum(infos[name] for infos in episodes) / len(episodes) for name in names}


def learnt(spec: Spec, means: Mapping[str, float]) -> str | None:
    """Why the task counts as learnt according to the `means` of the last episodes, for a message; `None` if it does not."""
    reached = None if spec.learnt is None else means.get(f"episode/{spec.learnt.name}")
    if spec.learnt is None or reached is None or reached < spec.learnt.mean:
        return None
    return f"the last episodes have a mean {spec.learnt.name} of {reached:.3f}, and {spec.learnt.mean} is enough"


def read_progress(run: Path) -> list[dict[str, Any]]:
    """The rows of `progress.jsonl`, one per update, none without the file; an incomplete last line, from a killed process, is
    ignored.

    Raises:
        MissingRow: There is no row of an update before the last one.
    """
    return [row for row, _ in _rows(run)]


def update_seconds(rows: Iterable[Mapping[str, Any]]) -> list[float]:
    """Seconds of each update, of what `read_progress` returned."""
    return [sum(value for name, value in row.items() if name.startswith("seconds/")) for row in rows]


def _rows(run: Path) -> Iterator[tuple[dict[str, Any], int]]:
    """The rows as for `read_progress`, each with its end in bytes."""
    if not (run / PROGRESS).exists():
        return
    with regular.opened(run / PROGRESS) as file:
        lines, end = file.readlines(), 0
    for number, line in enumerate(lines, 1):
        row = None
        with contextlib.suppress(ValueError, RecursionError):
            row = json.loads(line) if line.endswith(b"\n") else None
        if row is None and number == len(lines):
            return
        if not isinstance(row, dict) or row.get("update") != number:
            raise MissingRow(
                f"{run / PROGRESS} must have the row of update {number} in line {number}, got {line[:40]!r}; {_help(run)}"
            )
        end += len(line)
        yield row, end


def _help(run: Path) -> str:
    return f"restore the file, or start a new run with --init-from {run}"


def _flat(values: dict[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _weights_and_biases(run: Path, settings: Settings, console: Console) -> Any:
    try:
        import wandb
    except ImportError:
        console.print(
            "--wandb needs Weights & Biases, which is not installed (pip install wandb); continuing without it"
        )
        return None
    # A resumed run keeps its id.
    kept = run / "wandb-id.txt"
    if not kept.exists():
        atomic.write(kept, secrets.token_hex(4))
    given: dict[str, Any] = {"id": regular.text(kept), "name": run.name, "dir": str(run), "config": to_dict(settings)}
    try:
        return wandb.init(project="endless-gym", resume="allow", **given)
    except wandb.Error as error:
        raise ValueError(f"Weights & Biases: {error}; or log to local files with WANDB_MODE=offline") from None
