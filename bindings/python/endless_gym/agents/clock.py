"""Timing of the phases of an update."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Clock:
    """Accumulates the seconds of named phases.

    GPU kernels run asynchronously. `synchronise` is called at the end of each phase, so that their time counts for the phase that
    launched them.

    Attributes:
        seconds: Accumulated seconds by phase.
    """

    def __init__(self, synchronise: Callable[[], None] | None = None) -> None:
        """Make a clock; `synchronise` waits for the device, as `torch.cuda.synchronize` does. None on the CPU."""
        self._synchronise = synchronise or (lambda: None)
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Add the duration of the `with` block to the phase `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._synchronise()
            self.seconds[name] += time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """Return the seconds by phase since the last call, and start again from 0."""
        taken, self.seconds = dict(self.seconds), defaultdict(float)
        return taken
