"""Policies that choose the recorded actions.

A policy maps an environment of the original and a generator to an action. The generator is Python's, so that
choosing actions draws nothing from the environment's.
"""

from collections.abc import Callable
from random import Random
from typing import Any

Action = int | list[int]
Policy = Callable[[Any, Random], Action]


def uniform(env: Any, rng: Random) -> Action:
    """Any action with equal probability."""
    if _is_discrete(env):
        return rng.randrange(int(env.action_space.n))
    return [rng.randrange(3), rng.randrange(3)]


def constant(env: Any, rng: Random) -> Action:
    """The same action at every step."""
    return 1 if _is_discrete(env) else [1, 0]


def oracle(env: Any, rng: Random) -> Action:
    """Solve the task by reading the environment's hidden state."""
    name = type(env).__name__
    if "MortarMayhem" in name:
        return _mortar_mayhem(env, rng)
    if name == "EndlessMysteryPathEnv":
        return _endless_mystery_path(env)
    if "MysteryPath" in name:
        return _mystery_path(env)
    return _searing_spotlights(env, rng)


def mixed(error_rate: float) -> Policy:
    """The oracle, with random actions in between."""
    return lambda env, rng: uniform(env, rng) if rng.random() < error_rate else oracle(env, rng)


#: Policies by their name in a trace.
POLICIES: dict[str, Policy] = {
    "random": uniform,
    "constant": constant,
    "oracle": oracle,
    "mixed02": mixed(0.02),
    "mixed20": mixed(0.20),
}


def _is_discrete(env: Any) -> bool:
    return hasattr(env.action_space, "n")


def _mortar_mayhem(env: Any, rng: Random) -> Action:
    column, row = env._target_pos
    if _is_discrete(env):
        return _turn_or_walk(env, column, row)
    if env._command_visualization:  # The agent cannot move yet.
        return uniform(env, rng)
    tile = env.arena.tile_dim
    dx = env.arena.rect[0] + column * tile + tile // 2 - env.agent.rect.center[0]
    dy = env.arena.rect[1] + row * tile + tile // 2 - env.agent.rect.center[1]
    if type(env).__name__ == "EndlessMortarMayhemEnv":  # The way across the border may be shorter.
        dx, dy = ((distance + 42) % 84 - 42 for distance in (dx, dy))
    return _walk(dx, dy, tolerance=2)


def _endless_mystery_path(env: Any) -> Action:
    here, following = env.current_node, env.current_node.next_node
    if env.is_off_path:
        return 0
    if following.x > here.x or following.y == here.y:
        return 1
    return 3 if following.y > here.y else 2


def _mystery_path(env: Any) -> Action:
    path = [(node.x, node.y) for node in reversed(env.mystery_path.path)]
    here = tuple(env.normalized_agent_position)
    column, row = path[min(path.index(here) + 1, len(path) - 1)] if here in path else path[0]
    if _is_discrete(env):
        return _turn_or_walk(env, column, row)
    tile, (x, y) = env.tile_dim, env.agent.rect.center
    return _walk(column * tile + tile // 2 - x, row * tile + tile // 2 - y, tolerance=2)


def _searing_spotlights(env: Any, rng: Random) -> Action:
    if type(env).__name__ == "EndlessSearingSpotlightsEnv":
        target = env.coin
    else:
        target = env.coins[0] if env.coins else getattr(env, "exit", None)
    if target is None:
        return uniform(env, rng)
    (x, y), (target_x, target_y) = env.agent.rect.center, target.location
    return _walk(target_x - x, target_y - y, tolerance=1)


def _walk(dx: float, dy: float, tolerance: int) -> Action:
    return [0 if abs(distance) <= tolerance else 1 if distance < 0 else 2 for distance in (dx, dy)]


def _turn_or_walk(env: Any, column: int, row: int) -> Action:
    """0: nothing, 1: turn left, 2: turn right, 3: forward. Directions: 0 north, 1 west, 2 south, 3 east."""
    x, y = env.agent.grid_position
    if (x, y) == (column, row):
        return 0
    wanted = 3 if column > x else 1 if column < x else 0 if row < y else 2
    quarter_turns = (wanted - env.agent.face_direction.value) % 4
    return 3 if quarter_turns == 0 else 1 if quarter_turns == 1 else 2
