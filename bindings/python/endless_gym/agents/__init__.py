"""PPO agents with memory in PyTorch: the baselines of the Memory Gym paper.

The extra `agents` installs the dependencies: `pip install './bindings/python[agents]'`, or the wheel file with `[agents]`
appended. `endless-train` trains an agent.

Training, from top to bottom: `train` is the training loop and `settings` its configuration; `rollout` collects segments from
`environments`; `ppo` optimises the agent with `losses`; `agent` combines an observation transform (`naive`), `encoders`, a memory
(`memory`, `recurrent`, `transformer`) and `heads`; `checkpoint` saves and loads.

Evaluation: `protocol` is `endless-eval`, with `evaluate`, `metrics`, `statistics` and `results`; `plot` with `curves` is
`endless-plot`; `enjoy` with `video` is `endless-enjoy`; `search` with `search_space` is `endless-search`;
`reproduce` with `experiments` is `endless-reproduce`; `probe` is `endless-probe`.
"""

try:
    import rich
    import torch
    import tyro
except ImportError as error:
    raise ImportError(
        f"endless_gym.agents needs {error.name}, which is not installed: pip install './bindings/python[agents]', or the wheel "
        "file with `[agents]` appended"
    ) from error

from endless_gym.agents.agent import ActOutput, Agent, AgentMemory, AgentOutput, make_agent
from endless_gym.agents.checkpoint import Checkpoint, load
from endless_gym.agents.settings import PRESETS, Settings

__all__ = [
    "PRESETS",
    "ActOutput",
    "Agent",
    "AgentMemory",
    "AgentOutput",
    "Checkpoint",
    "Settings",
    "load",
    "make_agent",
]

del rich, torch, tyro
