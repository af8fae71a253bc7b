"""Checks of arguments, with messages that name the argument, what was given and what is allowed."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
from numpy.typing import NDArray

P = ParamSpec("P")
T = TypeVar("T")

#: Largest unsigned 64-bit integer: the largest seed, and the largest count that the engine can read.
MAX_U64 = 2**64 - 1
#: Largest end of a range of seeds.
MAX_I64 = 2**63 - 1


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


def mapping(name: str, given: Any) -> dict[str, Any]:
    """The argument as a dict; empty for `None`.

    Raises:
        TypeError: It is not a mapping.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        raise TypeError(f"{name} must be a mapping, got {given!r}")
    return dict(given)


def mappings(name: str, given: Any, count: int) -> list[dict[str, Any] | None]:
    """The argument as `count` dicts, from one mapping for all or a sequence with one, or `None`, for each.

    Raises:
        TypeError: It is neither.
        ValueError: The sequence has another length.
    """
    if isinstance(given, Mapping):
        return [dict(given)] * count
    if not isinstance(given, Sequence) or isinstance(given, (str, bytes)):
        raise TypeError(f"{name} must be a mapping, or a sequence of mappings, got {given!r}")
    if len(given) != count:
        raise ValueError(f"{name} must have one mapping for each of {count} environments, got {len(given)}")
    return [None if each is None else mapping(name, each) for each in given]


def flags(name: str, given: Any, count: int) -> NDArray[np.bool_]:
    """The argument as an array bool (count,).

    Raises:
        ValueError: It is not such an array.
    """
    array = np.asarray(given)
    if array.dtype != np.bool_ or array.shape != (count,):
        raise ValueError(f"{name} must be a bool array of shape ({count},), got {array.dtype} {array.shape}")
    return array


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


def named(*, instead: Mapping[str, str]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """A decorator that makes a function refuse unknown keyword arguments with the name of the one that is meant.

    Args:
        instead: What to use instead of arguments that other libraries have; for others, the nearest name is proposed.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        known = inspect.signature(function).parameters

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> T:
            for name in kwargs.keys() - known.keys():
                near = difflib.get_close_matches(name, known, 1)
                hint = instead.get(name) or (f"did you mean `{near[0]}`?" if near else f"it has {', '.join(known)}")
                raise TypeError(f"{function.__name__}() has no argument `{name}`; {hint}")
            return function(*args, **kwargs)

        return call

    return decorate


def first_seed(seed: Any, total_envs: int) -> int:
    """The seed of the first of some environments, which are seeded with consecutive numbers.

    Raises:
        TypeError: It is not an integer.
        ValueError: It is negative, or the last seed would not fit into 64 bits.
    """
    return integer("seed", seed, 0, MAX_U64 - (total_envs - 1))


def seeding(seed: int | None, seeds: range | Sequence[int] | None, total_envs: int) -> dict[str, Any]:
    """The arguments `seed` and `seeds` for `total_envs` environments as the JSON object of the engine's `Seeding`.

    Raises:
        TypeError: A seed is not an integer.
        ValueError: A seed is out of range, or `seeds` is empty.
    """
    seed = None if seed is None else first_seed(seed, total_envs)
    if seeds is None:
        return {"continue": {"seed": seed}}
    if not isinstance(seeds, range):
        if not isinstance(seeds, Iterable) or isinstance(seeds, (str, bytes)):
            raise TypeError(f"seeds must be a range or a list of integers, one for each episode, got {seeds!r}")
        seeds = [integer("seeds", each) for each in seeds]
    if not seeds:
        raise ValueError(f"seeds must have at least one seed, got {seeds}")
    if isinstance(seeds, list):
        return {"list": seeds}
    # The order does not matter, since seeds are drawn from the range.
    first, last = sorted((seeds[0], seeds[-1]))
    start, end = integer("seeds", first), integer("seeds", last, 0, MAX_I64 - 1) + 1
    return {"range": {"start": start, "end": end, "step": abs(seeds.step), "seed": seed}}
