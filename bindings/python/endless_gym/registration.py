"""Registration of the environment ids with Gymnasium."""

from __future__ import annotations

import gymnasium

from endless_gym.specs import all_specs


def register(namespace: str | None = "EndlessGym") -> None:
    """Register all environments, as `EndlessGym/MortarMayhem-v0` and so on. Importing the package does this.

    Args:
        namespace: Prefix of the ids. `None` registers the original's ids, for code that uses them.
    """
    for spec in all_specs().values():
        id = spec.id if namespace is None else f"{namespace}/{spec.id}"
        gymnasium.registry.pop(id, None)
        gymnasium.register(
            id,
            entry_point="endless_gym.env:Env",
            vector_entry_point="endless_gym.vector:gymnasium_vec",
            kwargs={"id": spec.id},
            # The environment checks its arguments itself, and the wrappers cost more than its steps.
            disable_env_checker=True,
            order_enforce=False,
        )
