"""An engine in a child process."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
import weakref
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

from endless_gym import _native
from endless_gym.arguments import integer, named
from endless_gym.arguments import timeout as checked_timeout
from endless_gym.create import connect
from endless_gym.display.rendering import VECTOR_MODES, View, checked_view, modes_of
from endless_gym.episodes import EpisodeOptions, validate_episode_options
from endless_gym.program import OWN_GROUP, program
from endless_gym.program.engine_log import EngineLog, level
from endless_gym.requests.configuration import INSTEAD, AutoresetMode, AutoresetName, Options, checked_arguments
from endless_gym.specs import Frames, ObservationName, json_text, spec
from endless_gym.vector import EndlessVectorEnv

_numbers = count()


class EngineProcess:
    """A child process that serves environments until `end` is called, this object is deleted, or this process ends."""

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Start the process, which reads the JSON object of its `EngineConfig` from its standard input."""
        self.service = config["service"]
        self._process = subprocess.Popen(
            [*program(spec(config["pool"]["id"]).native), *level(), "serve", f"--child={os.getpid()}", "--config=-"],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            **OWN_GROUP,
        )
        if self._process.stdin is not None:
            # If the process has ended, `connect` reports it with its message.
            with contextlib.suppress(BrokenPipeError):
                self._process.stdin.write(json_text(config).encode())
                self._process.stdin.flush()
        self._log = EngineLog(self._process)
        self._clients: list[_native.Backend] = []
        # Also called when the interpreter exits. It must not refer to this object, which would then never be deleted.
        self._end = weakref.finalize(self, _end, self._process, self._log, self._clients, os.getpid())

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def connect(self, timeout: float, **kwargs: Any) -> EndlessVectorEnv:
        """Waits up to `timeout` seconds for the engine to start, and connects as its trainer; `kwargs` are those of `connect`."""
        end = time.monotonic() + timeout
        while True:
            if (status := self._process.poll()) is not None:
                ended = f"ended with status {status}"
                if status < 0:
                    ended = f"was ended by a signal, {signal.strsignal(-status)}"
                if status == -signal.SIGKILL:
                    ended += ", as the system does where a container or a batch job has used up its memory"
                raise RuntimeError(self._log.message() or f"the engine {ended}")
            if self.service in _native.running_engines():
                envs = connect(self.service, timeout=timeout, engine=self, **kwargs)
                self._clients.append(envs._backend)
                return envs
            if time.monotonic() >= end:
                raise TimeoutError(f"the engine did not start within {timeout} seconds")
            time.sleep(0.01)

    def end(self) -> None:
        """Stops the process and waits for its end. Does nothing in a process that was forked from the one that started it."""
        self._end()


def _end(process: subprocess.Popen[bytes], log: EngineLog, clients: list[_native.Backend], owner: int) -> None:
    """Stops an engine that the process `owner` started, and waits for its end."""
    if owner != os.getpid():
        # Keeps Popen from warning about a running child.
        process.returncode = 0
        return
    # Another thread may still use them when the interpreter exits. If this process is killed from here on, the engine removes
    # their shared memory.
    for client in clients:
        client.close()
    if process.stdin is not None:
        # Closing it is not enough: processes that were forked from this one keep it open.
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(b"\n")
            process.stdin.flush()
        with contextlib.suppress(BrokenPipeError):
            process.stdin.close()
    # A stopped process would not end.
    process.send_signal(signal.SIGCONT)
    try:
        process.wait(10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    log.close()
    if process.returncode:
        # Listing the engines removes the shared memory of dead ones. Nothing here depends on it.
        with contextlib.suppress(OSError, RuntimeError):
            _native.running_engines()


_NAME = "the engine names itself; `endless serve --service NAME` takes a name, for `connect`"


@named(instead={**INSTEAD, "name": _NAME, "service": _NAME})
def serve(  # noqa: D417
    id: str,
    num_envs: int = 1,
    num_threads: int | None = None,
    *,
    groups: int = 1,
    seed: int | None = None,
    seeds: range | Sequence[int] | None = None,
    options: Options | Sequence[Options] | None = None,
    autoreset: AutoresetName | AutoresetMode = "next_step",
    observation: ObservationName | None = None,
    frames: Frames | None = None,
    batches_held: int = 4,
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_every: float | None = None,
    resume: bool = False,
    timeout: float = 30.0,
    copy: bool = False,
    pin_memory: bool = False,
    independent_episodes: bool = False,
    state: bool = False,
    first_env: int = 0,
    total_envs: int | None = None,
    render_mode: str | None = None,
    view: View | None = None,
    episode_options: EpisodeOptions | None = None,
    episode_info: bool = False,
) -> EndlessVectorEnv:
    """Start an engine in a child process, and connect to it. It stops when the environments are closed or no longer referenced,
    or when this process ends.

    Examples:
        >>> import endless_gym
        >>> with endless_gym.serve("Endless-MortarMayhem-v0", num_envs=16, groups=2, seed=0) as envs:
        ...     observation, info = envs.reset()
        >>> observation.shape, envs.num_groups
        ((16, 84, 84, 3), 2)

    Args:
        id: Environment id, such as `Endless-MortarMayhem-v0`.
        num_envs: Environments in each group.
        num_threads: Threads of the engine; `None` or 0 for one per core.
        groups: Groups of environments for `send` and `recv`, 1 to 64.
        batches_held: Batches of a group whose arrays may be referenced at the same time, 1 to 16, less what `pin_memory` and
            `episode_info` take where the engine would lend more than 16.
        checkpoint: File to which the engine saves all environments when it is closed or ended by a signal, and when
            `EndlessVectorEnv.checkpoint` is called.
        checkpoint_every: Seconds between further saves while the engine runs; `None` for none.
        resume: Continue from `checkpoint` if it exists; `EndlessVectorEnv.adopt` returns the observations. Without `resume`, an
            existing file is an error.
        timeout: Seconds to wait for the engine to start, and for each of its answers.
        copy: Return writable copies instead of read-only views of shared memory.
        pin_memory: As for `connect`; the engine lends one extra batch for it, up to 16 in all.
        episode_options: As for `connect`.
        episode_info: As for `connect`; the engine lends one extra batch for it, up to 16 in all.

    The other arguments are those of `make_vec`.

    Raises:
        TypeError: A number is not an integer.
        ValueError: An argument is out of its range, `checkpoint_every` or `resume` is given without `checkpoint`, or both `copy`
            and `pin_memory` are given.
        RuntimeError: The engine cannot start; the message says why.
    """
    given = checked_arguments(
        id,
        num_envs,
        num_threads,
        groups,
        seed,
        seeds,
        options,
        autoreset,
        observation,
        frames,
        independent_episodes,
        state,
        first_env,
        total_envs,
    )
    timeout = checked_timeout(timeout)
    checked_view(render_mode, view, modes_of(given.described, VECTOR_MODES))
    validate_episode_options(episode_options)
    if checkpoint is None and (checkpoint_every is not None or resume):
        raise ValueError("checkpoint must name a file if checkpoint_every or resume is given")
    saved: dict[str, Any] | None = None
    if checkpoint is not None:
        every = None if checkpoint_every is None else checked_timeout(checkpoint_every)
        saved = {"path": os.fspath(checkpoint), "every_seconds": every, "resume": bool(resume)}
    batches = integer("batches_held", batches_held, 1, _native.MAX_BATCHES_HELD)
    config = {
        "service": f"python-{os.getpid()}-{next(_numbers)}",
        # The environments of one group, with the options of all groups.
        "pool": {**given.pools[0], "options": given.options},
        "groups": len(given.pools),
        "threads": given.num_threads,
        "batches_held": min(batches + bool(episode_info) + bool(pin_memory), _native.MAX_BATCHES_HELD),
        "checkpoint": saved,
    }
    engine = EngineProcess(config)
    try:
        return engine.connect(
            timeout,
            copy=copy,
            pin_memory=pin_memory,
            render_mode=render_mode,
            view=view,
            episode_options=episode_options,
            episode_info=episode_info,
        )
    except BaseException:
        engine.end()
        raise
