"""The paper's baselines: PPO agents with memory, trained from shared memory.

`endless-train` trains one; `pip install endless-gym[agents]` brings what it needs. From top to bottom: `train` is the loop,
`settings` what it can be told, `rollout` plays, `ppo` learns with `losses`; `agent` puts `encoders`, a memory (`recurrent`,
`transformer`, `naive`) and `heads` together; `checkpoint` loads what was trained.

What comes after training: `protocol` is `endless-eval`, over `evaluate`, `metrics`, `statistics` and `results`; `plot` with
`curves` is `endless-plot`; `enjoy` with `film` is `endless-enjoy`; `search` with `search_space` is `endless-search`.
"""

try:
    import rich
    import torch
    import tyro
except ImportError as error:
    raise ImportError(f"{error.name} is not installed; the agents need: pip install 'endless-gym[agents]'") from error

from endless_gym.agents.agent import Acted, Agent, AgentMemory, make_agent
from endless_gym.agents.checkpoint import Checkpoint, load
from endless_gym.agents.settings import PRESETS, Settings

__all__ = ["PRESETS", "Acted", "Agent", "AgentMemory", "Checkpoint", "Settings", "load", "make_agent"]

del rich, torch, tyro
