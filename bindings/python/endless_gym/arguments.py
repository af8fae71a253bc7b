"""Checks of arguments, with messages that name the argument, what was given and what is allowed."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

#: Largest unsigned 64-bit integer: the largest seed, and the largest count that the engine can read.
MAX_U64 = 2**64 - 1


def integer(name: str, given: Any, low: int = 0, high: int = MAX_U64) -> int:
    """The argument as an int.

    Raises:
        TypeError: It is not an integer.
        ValueError: It is less than `low` or greater than `high`.
    """
    try:
        number = operator.index(given)
    except TypeError:
        raise TypeError(f"{name} must be an integer, got {given!r}") from None
    if not low <= number <= high:
        raise ValueError(f"{name} must be {low} to {high}, got {number}")
    return number


def timeout(given: float) -> float:
    """A timeout in seconds.

    Raises:
        TypeError: It is not a number.
        ValueError: It is negative, infinite or not a number.
    """
    try:
        seconds = float(given)
    except (TypeError, ValueError):
        raise TypeError(f"timeout must be a number of seconds, got {given!r}") from None
    except OverflowError:
        seconds = math.inf
    if not math.isfinite(seconds) or seconds < 0:
        raise ValueError(f"timeout must be finite and not negative, got {given}")
    return seconds


def seed_source(
    seed: int | None, seeds: range | Sequence[int] | None
) -> tuple[int | None, tuple[int, int] | None, list[int] | None]:
    """The arguments `seed` and `seeds` as a seed, the bounds of a range, and a list; the last two exclude each other.

    Raises:
        TypeError: A seed is not an integer.
        ValueError: A seed is out of range, or the range has a step other than 1.
    """
    seed = None if seed is None else integer("seed", seed)
    if seeds is None:
        return seed, None, None
    if not isinstance(seeds, range):
        return seed, None, [integer("seeds", each) for each in seeds]
    if seeds.step != 1:
        raise ValueError(f"seeds must be a range with step 1, got {seeds}")
    return seed, (integer("start of seeds", seeds.start), integer("stop of seeds", seeds.stop)), None
