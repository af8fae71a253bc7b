"""PPO agents with memory in PyTorch: the baselines of the Memory Gym paper.

Training, from top to bottom: `train` is the training loop and `settings` its configuration; `rollout` collects segments from
`environments`; `ppo` optimises the agent with `losses`; `agent` combines an observation transform (`transforms`),
`encoders`, a memory (`memory`, `recurrent`, `transformer`) and `heads`; `checkpoint` saves and loads.

Evaluation: `protocol` is `endless-eval`, with `evaluate`, `metrics`, `statistics` and `results`; `plot` with `curves` is
`endless-plot`; `enjoy` with `video` is `endless-enjoy`; `search` with `search_space` and `search_study` is `endless-search`;
`reproduce` with `experiments` is `endless-reproduce`; `jobs`, with `jobs_ray`, runs their processes; `probe` is `endless-probe`.
"""

from endless_gym_agents.agent import ActOutput, Agent, AgentMemory, AgentOutput, make_agent
from endless_gym_agents.checkpoint import Checkpoint, load
from endless_gym_agents.settings import PRESETS, Settings

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
