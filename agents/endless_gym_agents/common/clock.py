"""Timing of the phases of an update."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager


class Clock:
    """Accumulates the seconds of named phases.

    Times are measured on the host. GPU kernels run asynchronously and count towards the phase that waits for them: those of a
    rollout towards `inference`, which waits for the actions, and those of an update towards `learning`, which ends with a copy of
    the metrics.

    Attributes:
        seconds: Accumulated seconds by phase.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the duration of the `with` block to the phase `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] += time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """Return the seconds by phase since the last call, and start again from 0."""
        taken, self.seconds = dict(self.seconds), defaultdict(float)
        return taken


def duration(seconds: float) -> str:
    """A duration for a line of text, such as `2.5 hours`."""
    for unit, size in (("days", 86_400.0), ("hours", 3_600.0), ("minutes", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} seconds"
