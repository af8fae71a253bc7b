"""Memories of the literature: recurrent sequence models, one in each file.

Each file derives a class from `sequence_model.SequenceModel`, as a class of your own may; `--agent NAME` is short for
`--agent module:Class`.
"""

from __future__ import annotations

#: The class of each memory, as `module:Class`, by the name that `--agent` takes.
MEMORIES = {
    "mingru": "endless_gym_agents.memories.mingru:MinGRU",
}
