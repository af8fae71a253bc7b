"""The choices of the paper's hyperparameter search, from its table.

A parameter is named as its flag of `endless-train` is, with underscores. Its first choice is the value that the search starts
from; the table's other values follow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from endless_gym.agents.settings import Settings

Choice = str | int | float | bool
Space = dict[str, tuple[Choice, ...]]

_ALL: Space = {
    "ppo.epochs": (3, 2, 4),
    "ppo.minibatches": (8, 4),
    "ppo.advantage_normalisation": ("none", "batch", "minibatch"),
    "ppo.clip_range": (0.1, 0.2, 0.3),
    "ppo.value_coefficient": (0.5, 0.25),
    "ppo.learning_rate": (2.75e-4, 2.0e-4, 3.0e-4, 3.5e-4),
    "ppo.entropy_coefficient": (1.0e-4, 1.0e-3, 1.0e-2),
    "ppo.max_gradient_norm": (0.25, 0.35, 0.5, 1.0),
}
#: Where observations are reconstructed.
_RECONSTRUCTION: Space = {"ppo.reconstruction_coefficient": (0.1, 0.5, 1.0)}
_RECURRENCE: Space = {
    "agent": ("gru", "lstm"),
    "recurrence.layers": (1, 2),
    "recurrence.residual": (False, True),
    "recurrence.hidden_size": (512, 256, 384),
}
_TRANSFORMER: Space = {
    "transformer.layers": (3, 2, 4),
    "transformer.width": (384, 256, 512),
    "transformer.initialisation": ("xavier", "orthogonal", "kaiming", "tfixup"),
    "transformer.positional_encoding": ("absolute", "none", "learned"),
    "transformer.heads": (4, 8),
}


def space(base: Settings, only: Sequence[str] = ()) -> Space:
    """The choices around some settings.

    Args:
        base: Where the search starts; the memory decides which parameters there are.
        only: Names to keep; all of them if there are none.

    Raises:
        ValueError: A name is not among the parameters.
    """
    choices = dict(_ALL)
    if base.ppo.reconstruction_coefficient:
        choices |= _RECONSTRUCTION
    if base.agent in ("gru", "lstm"):
        choices |= _RECURRENCE
    elif base.agent in ("trxl", "gtrxl"):
        choices |= _TRANSFORMER
    names = [name.replace("-", "_") for name in only]
    for name in names:
        if name not in choices:
            raise ValueError(f"`{name}` is not searched for {base.agent}; there are {', '.join(choices)}")
    return {
        name: (value(base, name), *(choice for choice in listed if choice != value(base, name)))
        for name, listed in choices.items()
        if not names or name in names
    }


def value(settings: Settings, name: str) -> Choice:
    """A parameter's value."""
    found: Any = settings
    for part in name.split("."):
        found = getattr(found, part)
    chosen: Choice = found
    return chosen


def with_choices(settings: Settings, choices: Mapping[str, Choice]) -> Settings:
    """The settings with other values of some parameters."""
    for name, choice in choices.items():
        group, _, entry = name.rpartition(".")
        changed: dict[str, Any] = {entry: choice}
        if group:
            changed = {group: dataclasses.replace(getattr(settings, group), **changed)}
        settings = dataclasses.replace(settings, **changed)
    return settings


def single_changes(choices: Space) -> list[dict[str, Choice]]:
    """The base, and then every choice by itself, all else as in the base."""
    base = {name: listed[0] for name, listed in choices.items()}
    changes = [{**base, name: choice} for name, listed in choices.items() for choice in listed[1:]]
    return [base, *changes]
