"""Drop-in replacement for `import memory_gym`: registers the original's ids and defines its classes.

```python
import endless_gym.memory_gym as memory_gym
```
"""

from __future__ import annotations

from typing import Any

from endless_gym.env import Env
from endless_gym.registration import register

register(namespace=None)


def _environment(name: str, id: str) -> type[Env]:
    def __init__(self: Env, render_mode: str | None = None, **kwargs: Any) -> None:  # noqa: N807
        Env.__init__(self, id, render_mode, **kwargs)

    return type(name, (Env,), {"__init__": __init__, "__doc__": f"`{id}`, by the name of the original's class."})


MortarMayhemEnv = _environment("MortarMayhemEnv", "MortarMayhem-v0")
GridMortarMayhemEnv = _environment("GridMortarMayhemEnv", "MortarMayhem-Grid-v0")
MortarMayhemTaskBEnv = _environment("MortarMayhemTaskBEnv", "MortarMayhemB-v0")
GridMortarMayhemTaskBEnv = _environment("GridMortarMayhemTaskBEnv", "MortarMayhemB-Grid-v0")
EndlessMortarMayhemEnv = _environment("EndlessMortarMayhemEnv", "Endless-MortarMayhem-v0")
MysteryPathEnv = _environment("MysteryPathEnv", "MysteryPath-v0")
GridMysteryPathEnv = _environment("GridMysteryPathEnv", "MysteryPath-Grid-v0")
EndlessMysteryPathEnv = _environment("EndlessMysteryPathEnv", "Endless-MysteryPath-v0")
SearingSpotlightsEnv = _environment("SearingSpotlightsEnv", "SearingSpotlights-v0")
EndlessSearingSpotlightsEnv = _environment("EndlessSearingSpotlightsEnv", "Endless-SearingSpotlights-v0")
