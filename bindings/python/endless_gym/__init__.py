"""Endless Gym: the environments of Memory Gym and POPGym, bit-exact to the originals, in lockstep and in shared memory.

>>> import endless_gym, gymnasium
>>> gymnasium.make("EndlessGym/MortarMayhem-v0").observation_space  # one environment
Box(0, 255, (84, 84, 3), uint8)
>>> envs = endless_gym.make_vec("MortarMayhem-v0", num_envs=64)  # a vector environment in this process
>>> envs.observation_space.shape
(64, 84, 84, 3)
>>> with endless_gym.serve("MortarMayhem-v0", num_envs=64) as envs:  # a vector environment in an engine process
...     observation, info = envs.reset(seed=0)
>>> observation.flags.writeable  # a view of shared memory
False
"""

import sys
from importlib import import_module
from typing import TYPE_CHECKING, Any

if "free-threading" in sys.version:
    raise ImportError(
        "endless_gym does not support free-threaded builds of CPython; use one with the GIL, such as python3.14"
    )

from endless_gym._native import __version__, running_engines
from endless_gym.display.window import WindowClosed
from endless_gym.env import Env
from endless_gym.experts import Experts
from endless_gym.interop import DLPackView, torch_view
from endless_gym.registration import register, register_envs
from endless_gym.replay import ReplayStep, replay
from endless_gym.requests.exceptions import EngineLost, TooManyBatchesHeld
from endless_gym.specs import Frames, all_specs, spec

if TYPE_CHECKING:
    from endless_gym.create import connect, make_vec
    from endless_gym.engine import serve
    from endless_gym.recording import record
    from endless_gym.statistics import RecordEpisodeStatistics
    from endless_gym.vector import EndlessVectorEnv
    from endless_gym.watching import watch

__all__ = [
    "DLPackView",
    "EndlessVectorEnv",
    "EngineLost",
    "Env",
    "Experts",
    "Frames",
    "RecordEpisodeStatistics",
    "ReplayStep",
    "TooManyBatchesHeld",
    "WindowClosed",
    "__version__",
    "all_specs",
    "connect",
    "make_vec",
    "record",
    "register",
    "register_envs",
    "replay",
    "running_engines",
    "serve",
    "spec",
    "torch_view",
    "watch",
]

# Loaded on first use, since they need Gymnasium 1.1; the rest of the package works with 0.29.
_LATER = {
    "serve": "engine",
    "EndlessVectorEnv": "vector",
    "connect": "create",
    "make_vec": "create",
    "record": "recording",
    "watch": "watching",
    "RecordEpisodeStatistics": "statistics",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register()
