"""The original environments, and the recording of their episodes. Needs popgym 1.0.7 with its extra navigation."""

import json
import random
import warnings
from collections.abc import Callable
from typing import Any

warnings.filterwarnings("ignore")

import gymnasium  # noqa: E402
import numpy  # noqa: E402
import popgym.envs  # noqa: E402
from popgym.wrappers import Antialias, Flatten, PreviousAction  # noqa: E402

IDS = [registered["id"] for registered in popgym.envs.ALL.values()]

ERROR_RATES = (0.02, 0.1, 0.5, 1.0)


CLASSES = {registered["id"]: kind for kind, registered in popgym.envs.ALL.items()}


def made(env_id: str) -> Any:
    """An environment; with arguments, as in `popgym-RepeatPreviousEasy-v0?k=2`, one of the class without a difficulty."""
    name, _, arguments = env_id.partition("?")
    if not arguments:
        return gymnasium.make(name, disable_env_checker=True).unwrapped
    given = (argument.split("=") for argument in arguments.split("&"))
    return CLASSES[name].__base__(**{name: _value(text) for name, text in given})


def _value(text: str) -> Any:
    try:
        values = json.loads(f"[{text}]")
    except ValueError:
        return text
    return values if len(values) > 1 else values[0]


class Original:
    """One environment object of the original, which can play several episodes in a row."""

    def __init__(self, env_id: str) -> None:
        self.env: Any = made(env_id)
        self.policy = next((policy for name, policy in POLICIES.items() if name in env_id), None)

    def episode(self, seed: int | None, options: dict[str, float], picker: random.Random) -> dict[str, Any]:
        """Play one episode until it ends, and return its record.

        Args:
            seed: Seed of the reset; None continues the object's random generator.
            options: Options of the reset.
            picker: Chooses the actions, together with a policy that sees the state and reaches deep into episodes.
        """
        observation, info = self.env.reset(seed=seed, options=options or None)
        steps: list[list[Any]] = []
        record = {"seed": seed, "observation": _flat(observation), "info": _info(info), "steps": steps}
        error_rate = picker.choice(ERROR_RATES)
        ended = False
        while not ended:
            if self.policy is None or picker.random() < error_rate:
                action = self.random_action(picker)
            else:
                action = self.policy(self.env, picker)
            observation, reward, terminated, truncated, info = self.env.step(action)
            ended = bool(terminated or truncated)
            flags = [int(terminated), int(truncated)]
            steps.append([_flat(action), _flat(observation), float(reward), *flags, _info(info)])
        return record

    def random_action(self, picker: random.Random) -> Any:
        space = self.env.action_space
        if isinstance(space, gymnasium.spaces.Discrete):
            return picker.randrange(int(space.n))
        if isinstance(space, gymnasium.spaces.MultiDiscrete):
            return numpy.array([picker.randrange(int(n)) for n in space.nvec])
        return numpy.array(
            [picker.uniform(1.2 * low, 1.2 * high) for low, high in zip(space.low, space.high, strict=True)],
            numpy.float32,
        )


def trace(env_id: str, seed: int, episodes: int, options: dict[str, float]) -> dict[str, Any]:
    """Episodes of one environment object; the first is seeded, the others at random."""
    original, picker = Original(env_id), random.Random(seed)
    # The original seeds the navigation environments' global generators with 32 bits.
    bits = 32 if "Labyrinth" in env_id else 64
    seeds = [seed % 2**bits] + [picker.choice((None, picker.getrandbits(bits))) for _ in range(episodes - 1)]
    return {
        "env": env_id,
        "options": options,
        "episodes": [original.episode(each, options, picker) for each in seeds],
    }


def wrapped(env_id: str, seed: int) -> dict[str, Any]:
    """Random steps with POPGym's wrappers. A step after the end of an episode starts the next, as in a vector environment."""
    original, picker = Original(env_id), random.Random(seed)
    env: Any = Antialias(PreviousAction(original.env))
    flat: Any = Flatten(env)
    observations = [env.reset(seed=seed)[0]]
    actions: list[Any] = []
    ended = False
    for _ in range(250):
        actions.append(original.random_action(picker))
        observation, _, terminated, truncated, _ = (env.reset()[0], 0, 0, 0, {}) if ended else env.step(actions[-1])
        ended = bool(terminated or truncated)
        observations.append(observation)
    flattened = [gymnasium.spaces.flatten(env.observation_space, each) for each in observations]
    return {
        "seed": seed,
        "actions": [_flat(action) for action in actions],
        "space": str(env.observation_space),
        "observations": [_flat(observation) for observation in observations],
        "flattened_space": str(flat.observation_space),
        "flattened": [_flat(observation) for observation in flattened],
    }


def _two_cards(env: Any, picker: random.Random) -> int:
    """The card that makes a pair with the one in play, or one that has not been found."""
    faces = env.deck_idx_type[env.deck.idx]
    free = [card for card in range(len(faces)) if card not in env.deck["face_up_idx"]]
    in_play = env.deck["in_play_idx"]
    fitting = [card for card in free if in_play and card != in_play[0] and faces[card] == faces[in_play[0]]]
    return picker.choice(fitting or free)


def _previous(env: Any, picker: random.Random) -> int:
    hand = env.deck["player"]
    return int(env.deck.suits_idx[hand[-env.k]]) if len(hand) >= env.k else picker.randrange(4)


def _square(wanted: Any, picker: random.Random) -> Any:
    squares = numpy.argwhere(wanted)
    return squares[picker.randrange(len(squares))] if len(squares) else numpy.zeros(2, int)


def _balance(env: Any, picker: random.Random) -> int:
    x, velocity, angle, angular_velocity = env.state
    return int(angle + 0.3 * angular_velocity + 0.02 * x + 0.05 * velocity > 0)


def _torque(env: Any, picker: random.Random) -> Any:
    angle, velocity = env.state
    energy = 0.5 * velocity**2 + 15 * numpy.cos(angle)
    upright = numpy.cos(angle) > 0.9
    return numpy.array([-10 * numpy.sin(angle) - 3 * velocity if upright else (15 - energy) * velocity], numpy.float32)


def _way(env: Any, picker: random.Random) -> int:
    """The first step on a shortest way to a square that has not been explored."""
    moves = [(0, -1), (0, 1), (-1, 0), (1, 0)]
    start = tuple(int(each) for each in env.position)
    ways: dict[tuple[int, int], int | None] = {start: None}
    queue = [start]
    for place in queue:
        if env.explored[place] == 0:
            return ways[place] or 0
        for action, (down, right) in enumerate(moves):
            next_place = (place[0] + down, place[1] + right)
            inside = all(0 <= each < size for each, size in zip(next_place, env.maze.grid.shape, strict=True))
            if inside and env.maze.grid[next_place] != 1 and next_place not in ways:
                first = ways[place]
                ways[next_place] = action if first is None else first
                queue.append(next_place)
    return picker.randrange(4)


POLICIES: dict[str, Callable[[Any, random.Random], Any]] = {
    "Autoencode": lambda env, picker: int(env.deck.suits_idx[env.deck["system"][-1]]),
    "Battleship": lambda env, picker: _square((env.board == 1) & (env.guesses == 0), picker),
    "CartPole": _balance,
    "Cartpole": _balance,
    "Concentration": _two_cards,
    "CountRecall": lambda env, picker: int(env.counts[env.query]),
    "Labyrinth": _way,
    "MineSweeper": lambda env, picker: _square(env.hidden_grid == 0, picker),
    "Pendulum": _torque,
    "RepeatFirst": lambda env, picker: int(env.card),
    "RepeatPrevious": _previous,
}


def _flat(value: Any) -> list[float]:
    """The numbers of an observation or action in a row; float32 exactly."""
    if isinstance(value, tuple):
        return [number for part in value for number in _flat(part)]
    return [number.item() for number in numpy.atleast_1d(value)]


def _info(info: dict[str, Any]) -> dict[str, Any]:
    """The info at the time of the step. The original changes the counts of earlier infos later."""
    return {key: value.tolist() if isinstance(value, numpy.ndarray) else value for key, value in info.items()}
