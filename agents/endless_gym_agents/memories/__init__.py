"""Memories of the literature: recurrent sequence models, one in each file.

Each file derives a class from `sequence_model.SequenceModel`, as a class of your own may; `--agent NAME` is short for
`--agent module:Class`.
"""

from endless_gym_agents.common.own import MEMORIES

__all__ = ["MEMORIES"]
