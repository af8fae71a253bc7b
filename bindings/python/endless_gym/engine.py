"""An engine in a child process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

from endless_gym import _native
from endless_gym.program import program
from endless_gym.specs import Frames, json_text, spec
from endless_gym.vector import AutoresetMode, EndlessVectorEnv, Options, autoreset_mode, connect, contents

_numbers = count()

#: The engine gets its own process group, so that Ctrl-C reaches only this process, which then ends the engine. A new session is
#: the fallback before Python 3.11: the Linux scheduler divides CPU time among sessions first (autogroup), which made steps a
#: third slower.
_OWN_GROUP: dict[str, Any] = {"process_group": 0} if sys.version_info >= (3, 11) else {"start_new_session": True}


class EngineProcess:
    """A child process that serves environments. It ends with `end`, and when this process ends."""

    def __init__(self, arguments: list[str]) -> None:
        self.service = f"python-{os.getpid()}-{next(_numbers)}"
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [*program(), "serve", "--child", "--service", self.service, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            **_OWN_GROUP,
        )

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def connect(self, timeout: float, copy: bool) -> EndlessVectorEnv:
        """Wait until the engine runs, and connect to it as its trainer."""
        end = time.monotonic() + timeout
        while True:
            if (status := self._process.poll()) is not None:
                self._errors.seek(0)
                message = self._errors.read().decode(errors="replace").strip().removeprefix("endless: ")
                raise RuntimeError(message or f"the engine ended with status {status}")
            if self.service in _native.running_engines():
                return connect(self.service, timeout=timeout, copy=copy, engine=self)
            if time.monotonic() >= end:
                raise TimeoutError(f"the engine has not started within {timeout} seconds")
            time.sleep(0.01)

    def end(self) -> None:
        """End the process and wait until it has exited."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()


def serve(
    id: str,
    num_envs: int = 1,
    num_threads: int | None = None,
    *,
    groups: int = 1,
    seed: int | None = None,
    seeds: range | Sequence[int] | None = None,
    options: Options | Sequence[Options] | None = None,
    autoreset: str | AutoresetMode = "next_step",
    observation: str = "rgb",
    frames: Frames | None = None,
    batches_held: int = 4,
    timeout: float = 30.0,
    copy: bool = False,
) -> EndlessVectorEnv:
    """Start an engine in a child process, and connect to its environments. The engine ends when they are closed.

    ```python
    with endless_gym.serve("Endless-MortarMayhem-v0", num_envs=256, groups=2) as envs:
        observation, info = envs.reset()
    ```

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Environments in each group.
        num_threads: Threads of the engine; `None` for one per core.
        groups: Number of groups, which are stepped independently with `send` and `recv`.
        seed: As for `make_vec`.
        seeds: As for `make_vec`.
        options: As for `make_vec`.
        autoreset: `next_step`, `same_step` or `disabled`, as Gymnasium defines them.
        observation: `rgb`, `features` or `rgb+features`.
        frames: As for `make_vec`.
        batches_held: Number of steps of a group whose arrays can be held at the same time, 1 to 16.
        timeout: Seconds to wait for the start of the engine, and for each of its answers.
        copy: Return writeable copies instead of read-only views into shared memory.

    Raises:
        RuntimeError: The engine cannot start; the message contains the reason.
        TimeoutError: The engine has not started within `timeout` seconds.
    """
    described, mode = spec(id), autoreset_mode(autoreset)
    frames, features = contents(observation, frames)
    arguments: dict[str, Any] = {
        "--env": described.id,
        "--num-envs": num_envs,
        "--threads": num_threads or 0,
        "--groups": groups,
        "--batches-held": batches_held,
        "--autoreset": mode.name.lower(),
    }
    if seed is not None:
        arguments["--seed"] = seed
    if isinstance(seeds, range):
        arguments["--seed-range"] = f"{seeds.start}..{seeds.stop}"
    elif seeds is not None:
        arguments["--seed-list"] = ",".join(map(str, seeds))
    command = [f"{name}={value}" for name, value in arguments.items()]
    if options is None or isinstance(options, Mapping):
        command += [f"--option={name}={json_text(value)}" for name, value in (options or {}).items()]
    else:
        command += [f"--env-options={json_text(dict(each))}" for each in options]
    command += ["--final-observation"] if mode is AutoresetMode.SAME_STEP else []
    command += ["--features"] if features else []
    command += frames.command() if frames else ["--no-frames"]
    engine = EngineProcess(command)
    try:
        return engine.connect(timeout, copy)
    except BaseException:
        engine.end()
        raise
