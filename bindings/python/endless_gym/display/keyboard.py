"""Keys that play the environments, for `gymnasium.utils.play`."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np

from endless_gym.specs import Spec

#: The keys of each direction: a letter, and SDL's code of the arrow key.
_LEFT = frozenset({ord("a"), 1073741904})
_RIGHT = frozenset({ord("d"), 1073741903})
_UP = frozenset({ord("w"), 1073741906})
_DOWN = frozenset({ord("s"), 1073741905})


def keys_to_action(spec: Spec) -> dict[tuple[int, ...] | str, Any]:
    """The action of every combination of the keys W, A, S, D and the arrow keys, by their codes; `""` is no key.

    Opposite keys cancel. On a grid, left and right turn, and up walks ahead.
    """
    keys = sorted(_LEFT | _RIGHT | _UP | (_DOWN if spec.multi_discrete else frozenset()))
    pressed = (set(each) for count in range(len(keys) + 1) for each in combinations(keys, count))
    # Gymnasium accepts an empty string but no empty tuple. Without this entry, it would play action 0 when no key is pressed.
    return {tuple(sorted(each)) or "": _action(spec, each) for each in pressed}


def _action(spec: Spec, pressed: set[int]) -> Any:
    horizontal = _direction(pressed, _LEFT, _RIGHT)
    vertical = _direction(pressed, _UP, _DOWN)
    if spec.multi_discrete:
        return np.array([horizontal, vertical])
    return 3 if vertical == 1 else horizontal


def _direction(pressed: set[int], first: frozenset[int], second: frozenset[int]) -> int:
    """1 or 2 for the first or the second direction; 0 for none, or both."""
    is_first, is_second = bool(pressed & first), bool(pressed & second)
    return 0 if is_first == is_second else 1 if is_first else 2
