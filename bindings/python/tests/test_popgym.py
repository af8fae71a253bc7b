"""Tests of POPGym's ids, against spaces and episodes that were recorded from the original."""

import gzip
import json
import os
import pickle
import random
import re
import subprocess
import sys
import threading
import zlib
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import original_states
import pytest
from gymnasium.error import ResetNeeded
from numpy.typing import NDArray

import endless_gym
from endless_gym.popgym import DiscreteAction, Flatten, Markovian, Observability, PreviousAction
from endless_gym.recording.episodes import Plan, play
from endless_gym.recording.players import ExpertPlayer, Player, RandomPlayer

REFERENCE = Path(__file__).parents[3] / "tests/reference/popgym"
IDS = [id for id in endless_gym.all_specs() if id.startswith("popgym-")]
#: Ids with arguments, several for each argument of each class of the original.
ARGUMENTS = json.loads((REFERENCE / "arguments.json").read_text())
FAMILIES = sorted({id.removeprefix("popgym-").replace("Easy", "").removesuffix("-v0") for id in IDS if "Easy" in id})


def recorded(name: str) -> Any:
    return json.loads(gzip.decompress((REFERENCE / f"{name}.json.gz").read_bytes()))


def flat(value: Any) -> list[float]:
    if isinstance(value, tuple):
        return [number for part in value for number in flat(part)]
    return [number.item() for number in np.ravel(value)]


def test_states_are_the_originals() -> None:
    expected = recorded("states")
    assert set(expected) == {*IDS, *ARGUMENTS}
    for id, described in expected.items():
        assert original_states.states(endless_gym.Env(id), 20261128) == described, id


@pytest.mark.original
def test_states_are_those_of_the_live_original() -> None:
    seed = random.SystemRandom().getrandbits(32)
    command = [os.environ["ENDLESS_POPGYM_PYTHON"], "-W", "ignore", original_states.__file__, str(seed)]
    expected = json.loads(subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=200).stdout)
    for id, described in expected.items():
        assert original_states.states(endless_gym.Env(id), seed) == described, (id, seed)


@pytest.mark.parametrize("make", [endless_gym.make_vec, endless_gym.serve])
@pytest.mark.parametrize("id", [*(id for id in IDS if "Easy" in id), *(id for id in ARGUMENTS if "size" in id)])
def test_batches_have_the_states(id: str, make: Any) -> None:
    single = endless_gym.Env(id)
    single.reset(seed=5)
    with make(id, 2, seed=4, autoreset="same_step", state=True) as envs:
        _, info = envs.reset()
        envs.action_space.seed(1)
        described, ended = endless_gym.spec(id), False
        while not ended:
            state = described.states(info["state"])
            batched = [part[1].tolist() for part in (state if isinstance(state, tuple) else (state,))]
            alone = single.get_state()
            assert batched == [np.asarray(part).tolist() for part in (alone if isinstance(alone, tuple) else (alone,))]
            actions = envs.action_space.sample()
            _, _, terminated, truncated, info = envs.step(actions)
            single.step(actions[1])
            ended = (terminated | truncated)[1]
        assert original_states.checksum(described.single_state(info["final_info"]["state"][1])) == (
            original_states.checksum(single.get_state())
        )


def test_a_state_that_there_is_not_is_refused() -> None:
    with pytest.raises(ResetNeeded, match=r"before .*get_state"):
        endless_gym.Env(IDS[0]).get_state()
    with pytest.raises(NotImplementedError, match="MysteryPath-v0 does not tell its Markov state"):
        endless_gym.Env("MysteryPath-v0").get_state()
    with pytest.raises(ValueError, match="state must be False, since MysteryPath-v0 does not tell"):
        endless_gym.make_vec("MysteryPath-v0", 1, state=True)


POPGYM_INSTALLED = """
import pickle, sys, types
import gymnasium, endless_gym

class POPGymEnv(gymnasium.Env):
    pass

endless_gym.register(namespace=None)
package, core, env = types.ModuleType("popgym"), types.ModuleType("popgym.core"), types.ModuleType("popgym.core.env")
env.POPGymEnv = POPGymEnv
sys.modules.update({"popgym": package, "popgym.core": core, "popgym.core.env": env})
made = endless_gym.Env("popgym-RepeatFirstEasy-v0")
assert isinstance(made, POPGymEnv) and isinstance(gymnasium.make("popgym-RepeatFirstEasy-v0").unwrapped, POPGymEnv)
assert not isinstance(endless_gym.Env(id="MysteryPath-v0"), POPGymEnv)
made.reset(seed=1)
sys.stdout.buffer.write(pickle.dumps(made))
"""


def test_a_popgym_env_where_popgym_is_installed_and_pickled_for_where_it_is_not() -> None:
    pickled = subprocess.run([sys.executable, "-c", POPGYM_INSTALLED], stdout=subprocess.PIPE, check=True).stdout
    env = pickle.loads(pickled)
    assert isinstance(env, endless_gym.Env) and env.get_state()[1].max() == 1


@pytest.mark.parametrize("flatten", [False, True])
@pytest.mark.parametrize("id", recorded("wrapped"))
def test_previous_actions_and_first_steps_are_observed(id: str, flatten: bool) -> None:
    record = recorded("wrapped")[id]
    envs = PreviousAction(gymnasium.make_vec(f"EndlessGym/{id}", num_envs=1), flatten=flatten)
    assert str(envs.single_observation_space) == record["flattened_space" if flatten else "space"]
    expected = record["flattened" if flatten else "observations"]
    observation, _ = envs.reset(seed=record["seed"])
    assert flat(observation) == expected[0]
    for numbers, row in zip(record["actions"], expected[1:], strict=True):
        given = np.array(numbers, envs.action_space.dtype).reshape(envs.action_space.shape)
        observation, *_ = envs.step(given)
        is_allowed = envs.action_space.contains(given)
        given.fill(0)
        assert envs.observation_space.contains(observation) or not is_allowed
        assert flat(observation) == row
    assert sum(row[-1] == 1 for row in record["observations"]) > 1


@pytest.mark.parametrize("flatten", [False, True])
def test_same_step_autoreset_keeps_the_last_action_in_the_final_observation(flatten: bool) -> None:
    envs = endless_gym.make_vec("popgym-AutoencodeEasy-v0", 3, autoreset="same_step")
    envs = PreviousAction(envs, flatten=flatten)
    envs.reset(seed=4)
    for _ in range(103):
        observation, _, terminated, _, info = envs.step(np.array([3, 1, 2]))
    assert terminated.all()
    first, final = observation, list(info["final_obs"])
    if flatten:
        assert (first[:, 6:] == [1, 0, 0, 0, 0, 1]).all()
        assert [row[6:].tolist() for row in final] == [[0, 0, 0, 1, 1, 0], [0, 1, 0, 0, 1, 0], [0, 0, 1, 0, 1, 0]]
    else:
        assert flat(first[2:]) == [0, 0, 0, 1, 1, 1]
        assert [row[2:] for row in final] == [(3, 0), (1, 0), (2, 0)]
        assert envs.single_observation_space.contains(final[0])


def test_a_reset_of_some_environments_leaves_the_others_their_actions() -> None:
    envs = PreviousAction(gymnasium.make_vec("EndlessGym/popgym-RepeatFirstEasy-v0", num_envs=2))
    envs.reset(seed=1)
    envs.step(np.array([3, 2]))
    observation, _ = envs.reset(options={"reset_mask": np.array([False, True])})
    assert (observation[1].tolist(), observation[2].tolist()) == ([3, 0], [0, 1])


def test_random_actions_replace_those_of_an_expert_in_a_box() -> None:
    described = endless_gym.spec("popgym-PositionOnlyPendulumEasy-v0")

    def actions(player: Player, rate: float) -> NDArray[np.float32]:
        plans, stop = [Plan(7, 1, {}, rate, 300)], threading.Event()
        (episode,) = play(described, player, plans, observation="features", frames=None, action_seed=3, stop=stop)
        stored = episode.arrays["actions"]
        assert stored.shape == (200, 1) and stored.dtype == np.float32
        return np.frombuffer(zlib.decompress(stored.data[0]), np.float32)

    random = actions(RandomPlayer(described), 1.0)
    assert abs(random.mean()) < 0.3 and -2 <= random.min() < -1.8 and 1.8 < random.max() <= 2
    shares = [np.mean(actions(ExpertPlayer(described), rate) == random) for rate in (0.0, 0.5, 1.0)]
    assert shares[0] == 0 and 0.4 < shares[1] < 0.6 and shares[2] == 1


@pytest.mark.original
def test_wrappers_are_those_of_popgym(tmp_path: Path) -> None:
    (tmp_path / "endless_gym").symlink_to(Path(endless_gym.__file__).parent)
    program = Path(__file__).parent / "popgym_wrappers.py"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{program.parent}"}
    command = [os.environ["ENDLESS_POPGYM_PYTHON"], "-W", "ignore", program]
    subprocess.run(command, env=environment, check=True, timeout=200)


@pytest.mark.parametrize("level", list(Observability))
@pytest.mark.parametrize("id", [id for id in IDS if "Easy" in id])
def test_wrapped_batches_are_wrapped_environments(id: str, level: Observability) -> None:
    def wrapped(env: Any) -> Any:
        env = Flatten(PreviousAction(env)) if level is Observability.PARTIAL else Markovian(env, level)
        return env if "Pendulum" in id else DiscreteAction(env)

    envs, env = wrapped(endless_gym.make_vec(id, 1, autoreset="same_step", state=True)), wrapped(endless_gym.Env(id))
    assert (envs.single_observation_space, envs.single_action_space) == (env.observation_space, env.action_space)

    def numbers(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: numbers(part) for key, part in value.items()}
        return (
            [number for part in value for number in numbers(part)]
            if isinstance(value, tuple)
            else np.ravel(value).tolist()
        )

    (batch, _), (observation, _) = envs.reset(seed=3), env.reset(seed=3)
    env.action_space.seed(1)
    ended = False
    while not ended:
        assert numbers(batch) == numbers(observation) and envs.observation_space.contains(batch)
        action = env.action_space.sample()
        batch, *_, info = envs.step(np.asarray(action)[None])
        observation, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
    assert numbers(info["final_obs"][0]) == numbers(observation)


def test_wrappers_say_what_they_need() -> None:
    with pytest.raises(ValueError, match="does not tell its Markov state; make it with state=True"):
        Markovian(endless_gym.make_vec("popgym-RepeatFirstEasy-v0", 1), Observability.FULL)
    with pytest.raises(ValueError, match="action space must be Discrete or MultiDiscrete, got Box"):
        DiscreteAction(endless_gym.Env("popgym-PositionOnlyPendulumEasy-v0"))


@pytest.mark.parametrize("family", FAMILIES)
def test_the_classes_of_the_original_are_its_ids(family: str) -> None:
    name = family.replace("Cartpole", "CartPole")
    base = getattr(endless_gym.popgym, name)
    for level in ("Easy", "Medium", "Hard"):
        env = getattr(endless_gym.popgym, name + level)()
        assert isinstance(env, base) and isinstance(env, endless_gym.Env)
        assert env.unwrapped._spec.id == f"popgym-{family}{level}-v0"
        env.reset(seed=1)
        again = pickle.loads(pickle.dumps(env))
        assert type(again) is type(env)
        assert original_states.checksum(again.get_state()) == original_states.checksum(env.get_state())


def test_the_original_s_arguments_are_those_of_an_id() -> None:
    popgym = endless_gym.popgym
    for env, id in [
        (popgym.RepeatPrevious(k=32, num_decks=2), "RepeatPreviousMedium"),
        (popgym.RepeatPrevious(), "RepeatPreviousEasy"),
        (popgym.Battleship(), "BattleshipMedium"),
        (popgym.Concentration(deck_type="colors"), "ConcentrationEasy"),
        (popgym.Concentration(), "ConcentrationHard"),
        (popgym.LabyrinthEscape((14, 14)), "LabyrinthEscapeMedium"),
        (popgym.MineSweeper("medium"), "MineSweeperMedium"),
    ]:
        assert env._spec.id == f"popgym-{id}-v0"
    for env, id in [
        (popgym.RepeatPrevious(k=2), "RepeatPreviousEasy-v0?k=2"),
        (popgym.RepeatPrevious(2, k=np.int64(2)), "RepeatPreviousEasy-v0?num_decks=2&k=2"),
        (popgym.RepeatPreviousMedium(k=2), "RepeatPreviousMedium-v0?k=2"),
        (popgym.Battleship(ship_sizes=np.array([4, 2])), "BattleshipMedium-v0?ship_sizes=4,2"),
        (popgym.Battleship(board_size=5), "BattleshipMedium-v0?board_size=5"),
        (popgym.Concentration(3), "ConcentrationHard-v0?num_decks=3"),
        (popgym.CountRecall(error_clamp=2), "CountRecallEasy-v0?error_clamp=2.0"),
        (popgym.LabyrinthExplore((8, 20), 99), "LabyrinthExploreEasy-v0?maze_dims=8,20&episode_length=99"),
        (
            popgym.NoisyPositionOnlyPendulum(noise_sigma=0.25, g=9),
            "NoisyPositionOnlyPendulumEasy-v0?g=9.0&noise_sigma=0.25",
        ),
        (popgym.VelocityOnlyCartPole(sutton_barto_reward=True), "VelocityOnlyCartpoleEasy-v0?sutton_barto_reward=true"),
        (gymnasium.make("EndlessGym/popgym-RepeatPreviousEasy-v0", k=3, num_decks=1), "RepeatPreviousEasy-v0?k=3"),
        (gymnasium.make_vec("EndlessGym/popgym-RepeatPreviousEasy-v0", 2, k=3), "RepeatPreviousEasy-v0?k=3"),
        (endless_gym.Env("EndlessGym/popgym-RepeatPreviousEasy-v0?k=4"), "RepeatPreviousEasy-v0"),
    ]:
        own: Any = env.unwrapped
        described = own._described if isinstance(env, gymnasium.vector.VectorEnv) else own._spec
        assert described.id == f"popgym-{id}" and endless_gym.spec(described.id) == described
        env.reset(seed=1)
    remade: Any = gymnasium.make(endless_gym.make_vec("popgym-RepeatPreviousEasy-v0?k=3").spec).unwrapped
    assert remade._spec.id == "popgym-RepeatPreviousEasy-v0?k=3" and len(endless_gym.all_specs()) == 58
    for wrong, message in [
        (lambda: popgym.RepeatPrevious(k=0), "argument `k` must be an integer, 1 to 3275, got 0"),
        (
            lambda: endless_gym.Env("EndlessGym/popgym-RepeatPreviousEasy-v0?k=3&k=4"),
            "argument `k` must be given once, got 4",
        ),
        (lambda: popgym.RepeatPrevious(k=52), "argument `k` must be less than the number of cards, 52, got 52"),
        (lambda: popgym.RepeatPrevious(num_decks=64), "argument `num_decks` must be an integer, 1 to 63, got 64"),
        (lambda: popgym.RepeatPrevious(k="a&b"), "argument `k` must be an integer, 1 to 3275, got a"),
        (lambda: popgym.Concentration(deck_type="suits"), "argument `deck_type` must be colors or ranks, got suits"),
        (lambda: popgym.MineSweeper("easier"), "argument `difficulty` must be easy or medium or hard, got easier"),
        (lambda: popgym.LabyrinthEscape((7, 8)), "argument `maze_dims` must be two even numbers, 6 to 62, got [7, 8]"),
        (lambda: popgym.LabyrinthEscape([8]), "argument `maze_dims` must be two even numbers, 6 to 62, got [8]"),
        (lambda: popgym.Battleship(4), "argument `ship_sizes` must be at most 8 ships that always fit on a board of 4"),
        (
            lambda: popgym.Battleship(2, [2, 2]),
            "argument `ship_sizes` must be at most 8 ships that always fit on a board",
        ),
        (
            lambda: popgym.Battleship(20, [1] * 9),
            "argument `ship_sizes` must be at most 8 ships that always fit on a board",
        ),
        (lambda: popgym.MultiarmedBandit(episode_length=0), "argument `episode_length` must be an integer, 1 to "),
        (
            lambda: popgym.NoisyPositionOnlyCartPole(noise_sigma=-1),
            "argument `noise_sigma` must be a number, 0 to 1000000, got",
        ),
        (lambda: popgym.PositionOnlyCartPole(1), "argument `sutton_barto_reward` must be true or false, got 1"),
        (lambda: endless_gym.Env(f"{IDS[0]}?k"), f"{IDS[0]} has no argument `k`; it has num_decks"),
        (lambda: endless_gym.make_vec("MysteryPath-v0?k=2"), "MysteryPath-v0 has no argument `k`; it has none"),
    ]:
        with pytest.raises(ValueError, match=f"^no environment `.*`; {re.escape(message)}"):
            wrong()
    with pytest.raises(TypeError, match="unexpected keyword argument 'decks'"):
        popgym.RepeatPrevious(decks=2)
    assert "RepeatPreviousEasy" in dir(popgym)
    with pytest.raises(AttributeError, match="has no attribute 'RepeatNext'"):
        popgym.RepeatNext  # noqa: B018
