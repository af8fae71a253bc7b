"""The search space of the paper's hyperparameter search, from its table.

A parameter has the name of its flag of `endless-train`, with underscores. Its first choice is the value from which the search
starts; the table's other values follow.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.settings import Settings, value

#: The Optuna study in the folder of a search, a journal.
STUDY = "study.journal"
#: A value of a parameter.
Choice = str | int | float | bool
#: Choices by parameter.
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
#: Only with observation reconstruction.
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
    """The search space for given settings.

    Args:
        base: Initial settings of the search; the agent determines which parameters exist.
        only: Names of the parameters to include; empty for all.

    Raises:
        ValueError: An unknown parameter name.
    """
    choices = dict(_ALL)
    if base.ppo.reconstruction_coefficient:
        choices |= _RECONSTRUCTION
    if base.agent in ("gru", "lstm"):
        choices |= _RECURRENCE
    elif base.agent in MEMORIES:
        choices |= {name: _RECURRENCE[name] for name in ("recurrence.layers", "recurrence.hidden_size")}
    elif base.agent in ("trxl", "gtrxl"):
        choices |= _TRANSFORMER
    names = [name.replace("-", "_") for name in only]
    for name in names:
        if name not in choices:
            raise ValueError(f"--parameters for {base.agent} must be among {', '.join(choices)}; got `{name}`")
    return {
        name: (value(base, name), *(choice for choice in listed if choice != value(base, name)))
        for name, listed in choices.items()
        if not names or name in names
    }


def with_choices(settings: Settings, choices: Mapping[str, Choice]) -> Settings:
    """The settings with parameters set to the given values."""
    for name, choice in choices.items():
        group, _, entry = name.rpartition(".")
        changed: dict[str, Any] = {entry: choice}
        if group:
            changed = {group: dataclasses.replace(getattr(settings, group), **changed)}
        settings = dataclasses.replace(settings, **changed)
    return settings


def single_changes(choices: Space) -> list[dict[str, Choice]]:
    """The base values, followed by every change of a single parameter from the base values."""
    base = {name: listed[0] for name, listed in choices.items()}
    changes = [{**base, name: choice} for name, listed in choices.items() for choice in listed[1:]]
    return [base, *changes]
