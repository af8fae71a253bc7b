"""The meanings of actions, ground truth and feature observations, from the engine's table."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, TypeVar

from endless_gym.specs import Spec

Documented = TypeVar("Documented", bound=Callable[..., Any])


def metadata(spec: Spec) -> dict[str, Any]:
    """Entries of an environment's `metadata`.

    Returns:
        `actions`: for each branch of an action, the names of its numbers, from 0 on; `ground_truth` and `features`: the meaning
        of each entry by name, in order. All are strings, lists and dicts.
    """
    return {
        "actions": {branch.name: [choice.name for choice in branch.choices] for branch in spec.actions},
        "ground_truth": dict(spec.ground_truth_columns),
        "features": dict(spec.feature_columns),
    }


def text(specs: Iterable[Spec]) -> str:
    """The meanings of actions and ground truth, for a docstring; ids with the same meanings share an entry."""
    ids: dict[str, list[str]] = {}
    for spec in specs:
        ids.setdefault("\n".join(f"    {line}" for line in _lines(spec)), []).append(spec.id)
    return "\n".join(f"{', '.join(same)}:\n{lines}" for lines, same in ids.items())


def _lines(spec: Spec) -> Iterable[str]:
    """The actions of an environment, and the entries of its ground truth."""
    for number, branch in enumerate(spec.actions):
        name = f"action[{number}], {branch.name}" if spec.multi_discrete else "action"
        yield f"{name}: {', '.join(f'{value} {choice.name}' for value, choice in enumerate(branch.choices))}"
    for place, column in enumerate(spec.ground_truth_columns):
        yield f'info["ground_truth"][{place}], {column.name}: {column.description}'


def documented(specs: Iterable[Spec]) -> Callable[[Documented], Documented]:
    """A decorator that adds the meanings to the docstring of a class, so that `help()` shows them."""

    def decorate(kind: Documented) -> Documented:
        if kind.__doc__:  # not with `python -OO`
            kind.__doc__ = f"{kind.__doc__.rstrip()}\n\nWhat the numbers mean:\n\n{text(specs)}\n"
        return kind

    return decorate
