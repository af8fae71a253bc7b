"""Pictures of environments: the render modes, and the pictures of a batch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from endless_gym import _native
from endless_gym.specs import Spec, json_text, spec

#: What a picture shows: what the agent sees, uint8 (84, 84, 3), or the original's ground-truth view, uint8 (336, 336, 3), which
#: shows the same in environments without frames; or the text of what the agent sees, in environments without frames.
View = Literal["agent", "ground_truth", "text"]

#: The render modes of a single environment, with the views that each can show; the first is the original's.
SINGLE_MODES: dict[str, tuple[View, ...]] = {
    "human": ("ground_truth", "agent"),
    "rgb_array": ("agent", "ground_truth"),
    "debug_rgb_array": ("ground_truth",),
}

#: The render modes of a vector environment.
VECTOR_MODES = {mode: views for mode, views in SINGLE_MODES.items() if mode != "human"}

#: The further render modes of environments without frames.
TEXT_MODES: dict[str, tuple[View, ...]] = {"ansi": ("text",)}


def modes_of(described: Spec, modes: dict[str, tuple[View, ...]]) -> dict[str, tuple[View, ...]]:
    """Those of the modes that an environment has, and the text modes if it has no frames."""
    drawn = modes if described.shown else {}
    return drawn if described.frame else drawn | TEXT_MODES


def checked_view(render_mode: Any, view: Any, modes: dict[str, tuple[View, ...]]) -> View | None:
    """What the render mode shows; `None` without a render mode.

    Raises:
        ValueError: The mode is unknown, or cannot show that view.
    """
    if render_mode is None:
        if view is not None:
            raise ValueError(f"view must be None without a render_mode, got {view!r}")
        return None
    if not isinstance(render_mode, str) or render_mode not in modes:
        where = " in environments without pictures" if modes == TEXT_MODES else ""
        raise ValueError(f"render_mode must be None or one of {', '.join(modes)}{where}, got {render_mode!r}")
    views = modes[render_mode]
    if view is None:
        return views[0]
    if not isinstance(view, str) or view not in views:
        raise ValueError(f"view must be None or one of {', '.join(views)} for {render_mode!r}, got {view!r}")
    return views[views.index(view)]


class SnapshotRenderer:
    """Draws environments from their snapshots, in this process, without changing the environments."""

    def __init__(self, id: str, view: View) -> None:
        self._native: _native.Single = spec(id).native.Single(json_text({"id": id, "num_envs": 1}))
        # An environment must be reset before it can be restored.
        self._native.reset(0, "{}")
        self._view = view

    def render(self, snapshots: Iterable[bytes]) -> tuple[Any, ...]:
        """One picture for each snapshot, indexed `[row][column][channel]`, or one text."""
        return tuple(self._picture(snapshot) for snapshot in snapshots)

    def _picture(self, snapshot: bytes) -> NDArray[np.uint8] | str:
        self._native.restore(snapshot)
        if self._view == "text":
            return self._native.text()
        return self._native.rgb_array() if self._view == "agent" else self._native.ground_truth_view(True)
