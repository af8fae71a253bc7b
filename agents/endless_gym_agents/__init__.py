"""PPO agents with memory in PyTorch: the baselines of the Memory Gym paper.

`settings` is the configuration of a run. Of the folders, each uses only those before it: `common`; `environments`, which agents
play; `memories`; `agent`, which combines transforms of observations, encoders, a memory and heads; `training`, with the loop in
`train`; `evaluation`, with `protocol` as `endless-eval`, plots, films and exports; `paper`, with the experiments and the search.
"""

from endless_gym_agents.agent.agent import ActOutput, Agent, AgentMemory, AgentOutput, make_agent
from endless_gym_agents.settings import PRESETS, Settings
from endless_gym_agents.training.checkpoint import Checkpoint, load

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
