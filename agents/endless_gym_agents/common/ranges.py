"""Ranges of the numbers that the commands take: declared with the type of an argument, checked in one place."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Range:
    """The finite numbers from `low` to `high`; without `low` itself if `is_open`."""

    low: float = -math.inf
    high: float = math.inf
    is_open: bool = False

    def __contains__(self, number: float) -> bool:
        above = number > self.low if self.is_open else number >= self.low
        return above and number <= self.high and math.isfinite(number)

    def __str__(self) -> str:
        bounds = []
        if self.is_open:
            bounds.append(f"greater than {self.low:g}")
        elif math.isfinite(self.low):
            bounds.append(f"{self.low:g}" if math.isfinite(self.high) else f"{self.low:g} or more")
        if math.isfinite(self.high):
            bounds.append(f"{self.high:g}")
        return (" and at most " if self.is_open else " to ").join(bounds) or "finite"


Finite = Annotated[float, Range()]
FromZero = Annotated[float, Range(0)]
AboveZero = Annotated[float, Range(0, is_open=True)]
Share = Annotated[float, Range(0, 1)]
Natural = Annotated[int, Range(0)]
Positive = Annotated[int, Range(1)]


def check(arguments: Any, prefix: str = "--") -> None:
    """Check all fields with a `Range` of a dataclass and of the dataclasses in it.

    Args:
        arguments: The dataclass; a field is `None`, a number, or a tuple of numbers.
        prefix: What precedes the names of its fields as flags.

    Raises:
        ValueError: A number is out of its range.
    """
    for name, hint in get_type_hints(type(arguments), include_extras=True).items():
        given, flag = getattr(arguments, name), name.replace("_", "-")
        annotations = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
        if dataclasses.is_dataclass(given):
            is_named = all(getattr(each, "name", None) != "" for each in annotations)
            check(given, f"{prefix}{flag}." if is_named else prefix)
        for allowed in (each for each in annotations if isinstance(each, Range)):
            for number in given if isinstance(given, tuple) else (given,):
                if number is not None and number not in allowed:
                    raise ValueError(f"{prefix}{flag} must be {allowed}, got {number}")
