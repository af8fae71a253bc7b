"""Where the time of an update goes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class Clock:
    """Sums up seconds under names.

    A GPU works on after Python has moved on; `synchronise` is called before each reading, so that its time is not booked under
    what comes next.
    """

    def __init__(self, synchronise: Callable[[], None] | None = None) -> None:
        self._synchronise = synchronise or (lambda: None)
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def measure(self, name: str) -> Iterator[None]:
        """Adds the seconds of the `with` block to `name`."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self._synchronise()
            self.seconds[name] += time.perf_counter() - start

    def take(self) -> dict[str, float]:
        """The sums since the last call."""
        taken, self.seconds = dict(self.seconds), defaultdict(float)
        return taken
