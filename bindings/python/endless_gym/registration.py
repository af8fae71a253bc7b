"""Registration of the environment ids with Gymnasium."""

from __future__ import annotations

import gymnasium

from endless_gym.specs import all_specs


def register(namespace: str | None = "EndlessGym") -> None:
    """Register all environments under `namespace`, such as `EndlessGym/MortarMayhem-v0`.

    Importing the package calls this once. With `namespace=None` they are registered under the original ids, for unmodified code.
    """
    for spec in all_specs().values():
        id = spec.id if namespace is None else f"{namespace}/{spec.id}"
        gymnasium.registry.pop(id, None)
        gymnasium.register(
            id,
            entry_point="endless_gym.env:Env",
            vector_entry_point="endless_gym.vector:gymnasium_vec",
            kwargs={"id": spec.id},
            # The environment validates its arguments itself, and these wrappers are slower than a step.
            disable_env_checker=True,
            order_enforce=False,
        )
