"""Types of the native module, which the package wraps."""

from collections.abc import Callable, Iterable, Sequence
from os import PathLike
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

__version__: str

# Names of the autoreset modes: those of Gymnasium's `AutoresetMode` in lower case.
AUTORESET_MODES: tuple[str, ...]
DEFAULT_ENV_ID: str
# Names of the agents that the page plays.
PAGE_AGENTS: tuple[str, ...]
# Limits: environments in a group, groups, threads, and batches of a group that a trainer may hold.
MAX_ENVS: int
MAX_GROUPS: int
MAX_THREADS: int
MAX_BATCHES_HELD: int

# A seed `s`: environment `i` of group `g` is seeded with `s + g * num_envs + i`. Or a mask and seeds, one of each per
# environment: 0 does not reset, 1 starts the next episode, 2 starts one with the seed.
Reset = int | tuple[Sequence[int], Sequence[int]]
Arrays = tuple[NDArray[Any], ...]
LastRequest = Literal["none", "pending", "played", "not_played", "unknown"]
# An environment's number, the seed of its running episode, the JSON text of the options, and whether the last step ended it.
Episode = tuple[int, int | None, str, bool]
# Frames, features, vector observation and ground truth.
SingleArrays = tuple[
    NDArray[np.uint8] | None, NDArray[np.float32] | None, NDArray[np.float32] | None, NDArray[np.float64] | None
]

class Backend:
    """The groups of environments of a vector environment, in this process or in an engine process. Exists only in this stub.

    Both implementations raise the same exceptions with the same messages. The caller checks group numbers.
    """

    @property
    def groups(self) -> int: ...
    # The result of each group that the caller does not have yet; the caller sets the entries of those that it has to `None`.
    @property
    def kept(self) -> list[Arrays | None]: ...
    # Reset a group, and return its arrays.
    def reset(self, group: int, request: Reset | None = None, options: str | None = None) -> Arrays: ...
    # Step group 0, and return its arrays.
    def step(self, actions: Any) -> Arrays: ...
    # Step or reset a group; `receive` returns its arrays. The actions are copied.
    def send(self, actions: Any, group: int) -> None: ...
    def send_reset(self, group: int, request: Reset | None = None, options: str | None = None) -> None: ...
    # The number and the arrays of a group whose result is ready; `None` waits for any group.
    def receive(self, group: int | None) -> tuple[int, Arrays]: ...
    # The state of one environment.
    def snapshot(self, group: int, env: int) -> bytes: ...
    def restore(self, group: int, env: int, snapshot: bytes) -> None: ...
    # Set the options of next episodes, from the JSON text of a list of objects with `options` and `envs`.
    def set_options(self, group: int, sets: str) -> None: ...
    def running_episodes(self, group: int, envs: Sequence[int]) -> list[Episode]: ...
    # Release the environments. Arrays remain valid.
    def close(self) -> None: ...

class Pools(Backend):
    # `allocate` returns a tensor of that many zeroed bytes that nothing else uses; it must not run Python code.
    def __init__(
        self, configs: Sequence[str], num_threads: int, allocate: Callable[[int], Any] | None = None
    ) -> None: ...
    def layout(self) -> str: ...
    def ground_truth_view(self, env: int) -> NDArray[np.uint8]: ...

class Connection(Backend):
    def __init__(self, service: str, timeout: float) -> None: ...
    def specification(self) -> str: ...
    def checkpoint(self) -> list[int]: ...
    def reconnect(self, timeout: float) -> tuple[bool, int, list[tuple[int | None, int | None, LastRequest]]]: ...

class Single:
    def __init__(self, config: str) -> None: ...
    def reset(self, seed: int | None, options: str) -> SingleArrays: ...
    def step(self, action: Any) -> tuple[SingleArrays, float, bool, bool, tuple[float, int, list[float]] | None]: ...
    def rgb_array(self) -> NDArray[np.uint8]: ...
    def ground_truth_view(self, of_current_step: bool) -> NDArray[np.uint8]: ...
    def progress(self) -> list[tuple[str, float, float | None]]: ...
    def snapshot(self) -> bytes: ...
    def restore(self, snapshot: bytes) -> SingleArrays: ...
    def save(self) -> tuple[bytes, bytes] | None: ...
    def resume(self, snapshot: bytes, earlier_frames: bytes) -> None: ...

class Observer:
    def __init__(self, service: str, group: int | None, timeout: float) -> None: ...
    def specification(self) -> str: ...
    def next(self, timeout: float | None) -> tuple[int, int, int, Arrays]: ...

class Experts:
    def __init__(self, id: str, num_envs: int) -> None: ...
    def act(
        self, features: NDArray[np.float32], vector_observation: NDArray[np.float32] | None, turn: NDArray[np.uint8]
    ) -> NDArray[np.int64]: ...

def frame_shape(frames: str, size: tuple[int, int, int]) -> list[int]: ...
def check_pool_config(config: str) -> None: ...
def cores() -> int: ...
def running_engines() -> list[str]: ...
def segment_prefix() -> str: ...
def note_export(array: NDArray[Any]) -> bool: ...
def writable_view(array: NDArray[Any]) -> NDArray[Any]: ...
def ended_episodes(
    ended: NDArray[np.bool_],
    episode_return: NDArray[np.float64],
    episode_length: NDArray[np.int32],
    info: NDArray[np.float64],
    integers: Sequence[bool],
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.int32], list[NDArray[Any]]] | None: ...
def endless(arguments: Sequence[str], executable: Sequence[str]) -> int: ...
def max_episode_steps(id: str, options: str) -> int: ...
def write_film(path: str | PathLike[str], frames: Iterable[NDArray[np.uint8]], fps: int) -> None: ...
def specs() -> str: ...

# The kernels of `endless-gym-kernels`: contiguous float32 arrays, of which the last ones are overwritten, as that crate says.
Numbers = NDArray[np.float32]

def gru_forward(
    inputs: Numbers,
    weight: Numbers,
    bias: Numbers,
    state: Numbers,
    sizes: Sequence[int],
    resets: Sequence[bool],
    saved: Numbers,
    outputs: Numbers,
) -> None: ...
def gru_backward(
    weight: Numbers,
    saved: Numbers,
    grad_outputs: Numbers,
    sizes: Sequence[int],
    resets: Sequence[bool],
    grad_inputs: Numbers,
    grad_weight: Numbers,
    grad_bias: Numbers,
    grad_state: Numbers,
) -> None: ...
def lstm_forward(
    inputs: Numbers,
    weight: Numbers,
    hidden: Numbers,
    cell: Numbers,
    sizes: Sequence[int],
    resets: Sequence[bool],
    saved: Numbers,
    outputs: Numbers,
    cells: Numbers,
) -> None: ...
def lstm_backward(
    weight: Numbers,
    saved: Numbers,
    grad_outputs: Numbers,
    sizes: Sequence[int],
    resets: Sequence[bool],
    grad_inputs: Numbers,
    grad_weight: Numbers,
    grad_hidden: Numbers,
    grad_cell: Numbers,
) -> None: ...
def mingru_forward(
    inputs: Numbers, state: Numbers, sizes: Sequence[int], resets: Sequence[bool], saved: Numbers, outputs: Numbers
) -> None: ...
def mingru_backward(
    inputs: Numbers,
    saved: Numbers,
    grad_outputs: Numbers,
    sizes: Sequence[int],
    resets: Sequence[bool],
    grad_inputs: Numbers,
    grad_state: Numbers,
) -> None: ...
