"""The colour of each agent in plots, the same in all of them."""

from __future__ import annotations

#: Colours by agent, on a light and on a dark page. `_rec` marks the paper's agents that also reconstruct observations.
AGENTS = {
    "none": ("#b3263a", "#f0707e"),
    "gru": ("#2d5ea8", "#6ea4f2"),
    "gru_rec": ("#7d9fd1", "#a9c8f5"),
    "trxl": ("#308d46", "#5cc27a"),
    "trxl_rec": ("#83bd92", "#a3dcb3"),
    "lstm": ("#8a5a00", "#e0ad4f"),
    "mingru": ("#7b3fa0", "#c592e8"),
}
