"""Memories of the literature: recurrent sequence models, one in each file.

Each file derives a class from `sequence_model.SequenceModel`, as a class of your own may; `--agent NAME` is short for
`--agent module:Class`.
"""

from __future__ import annotations

#: The class of each memory, as `module:Class`, by the name that `--agent` takes.
MEMORIES = {
    "mingru": "endless_gym_agents.memories.mingru:MinGRU",
    "lru": "endless_gym_agents.memories.lru:LRU",
    "mamba2": "endless_gym_agents.memories.mamba2:Mamba2",
    "gated-deltanet": "endless_gym_agents.memories.gated_deltanet:GatedDeltaNet",
    "retnet": "endless_gym_agents.memories.retnet:RetNet",
    "mlstm": "endless_gym_agents.memories.mlstm:MLSTM",
    "ffm": "endless_gym_agents.memories.ffm:FFM",
    "shm": "endless_gym_agents.memories.shm:SHM",
}
