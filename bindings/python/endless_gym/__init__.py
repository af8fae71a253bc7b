"""Endless Gym: bit-exact Memory Gym environments, vectorised, in this process or in an engine process over shared memory.

```python
import endless_gym, gymnasium

env = gymnasium.make("EndlessGym/MortarMayhem-v0")                        # one environment, like the original
envs = gymnasium.make_vec("EndlessGym/MortarMayhem-v0", num_envs=1024)    # many, in this process
envs = endless_gym.serve("MortarMayhem-v0", num_envs=1024)                # many, in an engine process
```
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from endless_gym._native import EngineLost, TooManyBatchesHeld, __version__, running_engines
from endless_gym.env import Env
from endless_gym.interop import DLPackView, pin_memory, torch_view
from endless_gym.registration import register
from endless_gym.specs import Frames, all_specs, spec

if TYPE_CHECKING:
    from endless_gym.engine import serve
    from endless_gym.vector import EndlessVectorEnv, connect, make_vec

__all__ = [
    "DLPackView",
    "EndlessVectorEnv",
    "EngineLost",
    "Env",
    "Frames",
    "TooManyBatchesHeld",
    "__version__",
    "all_specs",
    "connect",
    "make_vec",
    "pin_memory",
    "register",
    "running_engines",
    "serve",
    "spec",
    "torch_view",
]

# Imported lazily: they need Gymnasium 1.1, while single environments also run on Gymnasium 0.29.
_LATER = {"serve": "engine", "EndlessVectorEnv": "vector", "connect": "vector", "make_vec": "vector"}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register()
