"""Registration of the environment ids with Gymnasium."""

from __future__ import annotations

from collections.abc import Iterable
from types import ModuleType
from typing import TYPE_CHECKING, Any

import gymnasium

from endless_gym.env import Env
from endless_gym.specs import Spec, add_specs, all_specs, with_arguments

if TYPE_CHECKING:
    from endless_gym.vector import EndlessVectorEnv


def register(namespace: str | None = "EndlessGym") -> None:
    """Register all environments, as `EndlessGym/MortarMayhem-v0` and so on. Importing the package does this.

    Args:
        namespace: Prefix of the ids. `None` registers the original's ids, for code that uses them.
    """
    _register(all_specs().values(), namespace)


def register_envs(module: ModuleType) -> None:
    """Add the environments of a native module of your own, and register them as `EndlessGym/ID`.

    Afterwards all of `endless_gym` plays them in this process. Call it in the package that contains the module, so that
    `package:ID` finds them in any process. Registering a module again has no effect.

    Args:
        module: The module that `endless_gym_python::module!` defines in Rust. `endless new` writes a package with one.

    Raises:
        TypeError: It is not such a module.
        ValueError: Another module has one of its ids, or it was built for another version of `endless_gym`.
    """
    _register(add_specs(module), "EndlessGym")


def _register(specs: Iterable[Spec], namespace: str | None) -> None:
    for spec in specs:
        id = spec.id if namespace is None else f"{namespace}/{spec.id}"
        gymnasium.registry.pop(id, None)
        gymnasium.register(
            id,
            entry_point="endless_gym.registration:single",
            vector_entry_point="endless_gym.registration:vector",
            # Not `id`: `gymnasium.make_vec` and RLlib pass these on to `gymnasium.make`, which has a parameter of that name.
            kwargs={"env_id": spec.full_id},
            # The environment checks its arguments itself, and the wrappers cost more than its steps.
            disable_env_checker=True,
            order_enforce=False,
        )


def single(env_id: str, **kwargs: Any) -> Env:
    """The entry point of `gymnasium.make`; keyword arguments are those of `Env` and of the id."""
    return Env(with_arguments(env_id, kwargs), **kwargs)


# Gymnasium reads the render modes of an entry point.
single.metadata = Env.metadata  # type: ignore[attr-defined]


def vector(env_id: str, num_envs: int = 1, **kwargs: Any) -> EndlessVectorEnv:
    """The entry point of `gymnasium.make_vec`; keyword arguments are those of `make_vec` and of the id."""
    # Only vector environments need Gymnasium 1.1.
    from endless_gym.create import make_vec

    return make_vec(with_arguments(env_id, kwargs), num_envs, **kwargs)
