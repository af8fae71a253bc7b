"""Loading an agent: `load` and `Checkpoint`."""

from endless_gym_agents.training.checkpoint import Checkpoint, load

__all__ = ["Checkpoint", "load"]
