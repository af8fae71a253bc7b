"""Reads the standard error of an engine in a child process: log lines, which go to `logging`, and the reason for its end."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import threading
from collections import deque

from endless_gym.program.printable import printable

_logger = logging.getLogger("endless_gym.engine")

#: A line as the program logs it: time, level, target and text.
_LINE = re.compile(r"\S+Z +(ERROR|WARN|INFO|DEBUG|TRACE) (.*)")
_LEVELS = {"ERROR": 40, "WARN": 30, "INFO": 20, "DEBUG": 10, "TRACE": 5}

#: Number of lines to keep that are not log lines: the most recent ones.
_KEPT = 100


def level() -> list[str]:
    """Arguments that pass the logger's current level to the program, unless `ENDLESS_GYM_LOG` sets one."""
    if os.environ.get("ENDLESS_GYM_LOG"):
        return []
    effective = _logger.getEffectiveLevel()
    names = ((10, "debug"), (20, "info"), (30, "warn"), (40, "error"))
    return [f"--log={next((name for number, name in names if effective <= number), 'off')}"]


class EngineLog:
    """Reads the standard error of an engine in a thread until it ends: the engine must not wait for a reader."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process
        self._other: deque[str] = deque(maxlen=_KEPT)
        self._thread = threading.Thread(target=self._read, name=f"log of engine {process.pid}", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        stream = self._process.stderr
        if stream is None:
            return
        for raw in stream:
            line = printable(raw.decode(errors="replace").rstrip())
            if found := _LINE.fullmatch(line):
                _logger.log(_LEVELS[found[1]], "engine %d: %s", self._process.pid, found[2])
            else:
                self._other.append(line)

    def message(self) -> str:
        """The reason that the engine gave for its end; empty if it gave none. The engine must have ended."""
        self._thread.join(10)
        text = "\n" + "\n".join(self._other)
        return text.rpartition("\nendless: ")[2].strip()

    def close(self) -> None:
        """Log why the engine failed, if its exit status is an error. The engine must have ended."""
        if self._process.returncode and (message := self.message()):
            _logger.error("engine %d: %s", self._process.pid, message)
        self._thread.join(10)
        if self._process.stderr is not None and not self._thread.is_alive():
            self._process.stderr.close()
