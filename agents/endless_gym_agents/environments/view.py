"""A page in the browser that shows the environments of a training run: `endless view` as a child process."""

from __future__ import annotations

import os
import subprocess
from typing import Any

from endless_gym.program import OWN_GROUP, program
from endless_gym.vector import EndlessVectorEnv


class ViewProcess:
    """The server of a page that shows one engine. It ends with `end` and with this process.

    Attributes:
        url: The address of the page, with its token.
    """

    def __init__(self, envs: EndlessVectorEnv) -> None:
        """Start the server.

        Args:
            envs: Environments of `serve`.

        Raises:
            RuntimeError: The server cannot start.
        """
        engine: Any = envs._engine
        self._process = subprocess.Popen(
            [*program(), "view", engine.service, f"--child={os.getpid()}"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            **OWN_GROUP,
        )
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if "http://" not in line:
            self.end()
            raise RuntimeError(
                f"the page cannot be served: `endless view` ended with status {self._process.returncode}"
            )
        self.url = line.split()[-1]

    def end(self) -> None:
        """Stop the server, and wait until it has ended."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
