"""With `independent_episodes`, an episode depends only on its seed and options, in new and in used environments."""

import gymnasium
import numpy as np
import pytest
from support import MEMORY_GYM, WHERE, engine_of_program, exact

import endless_gym

IDS = MEMORY_GYM
#: Options of an episode that affect later episodes.
LEFT = {
    "Endless-MortarMayhem-v0": {"agent_scale": 0.4},
    "SearingSpotlights-v0": {"hide_chessboard": True, "light_dim_off_duration": 0},
    "Endless-SearingSpotlights-v0": {"black_background": True},
}


def played(envs, seed: int, options: dict, steps: int) -> list[object]:
    """Everything that an environment or a vector environment returns for a seed and the same actions, as `exact` values."""
    envs.action_space.seed(seed)
    out = [exact(envs.reset(seed=seed, options=options))]
    for _ in range(steps):
        step = envs.step(envs.action_space.sample())
        out.append(exact(step))
        if isinstance(envs, gymnasium.Env) and step[2]:
            out.append(exact(envs.reset()))
    return out


@pytest.mark.parametrize("id", IDS)
def test_used_environments_play_like_new_ones(id: str) -> None:
    def make(independent: bool) -> gymnasium.Env:
        return gymnasium.make(f"EndlessGym/{id}", independent_episodes=independent)

    for independent in (False, True):
        used = make(independent)
        played(used, 3, LEFT.get(id, {}), 70)
        same = played(used, 11, {}, 150) == played(make(independent), 11, {}, 150)
        assert same or not independent
        if id in LEFT:
            assert same is independent


@pytest.mark.parametrize("autoreset", ["next_step", "same_step"])
@pytest.mark.parametrize(
    ("where", "id"), [*((endless_gym.make_vec, id) for id in IDS), *((endless_gym.serve, id) for id in LEFT)]
)
def test_used_vector_environments_play_like_new_ones(id: str, autoreset: str, where) -> None:
    arguments = {"num_envs": 3, "autoreset": autoreset, "observation": "rgb+features"}
    with where(id, **arguments, independent_episodes=True) as envs:
        played(envs, 3, LEFT.get(id, {}), 70)
        used = played(envs, 11, {}, 100)
    with endless_gym.make_vec(id, **arguments, independent_episodes=True) as envs:
        new = played(envs, 11, {}, 100)
    assert used == new


@pytest.mark.parametrize("where", WHERE)
def test_later_episodes_do_not_depend_on_the_actions(where) -> None:
    """Searing Spotlights draws from the generator during the episode, for each new spotlight."""

    def starts(action: int) -> list[bytes]:
        found = []
        with where("SearingSpotlights-v0", 1, seed=2, independent_episodes=True, options={"agent_health": 3}) as envs:
            observation, _ = envs.reset()
            while len(found) < 3:
                found.append(observation.tobytes())
                done = False
                while not done:
                    observation, _, terminated, _, _ = envs.step(np.full((1, 2), action))
                    done = bool(terminated[0])
                observation = envs.step(np.zeros((1, 2), int))[0]
        return found

    assert starts(0) == starts(1)
    assert len(set(starts(0))) == 3


def test_the_program_serves_independent_episodes() -> None:
    id = "Endless-MortarMayhem-v0"
    with engine_of_program("independent", id, "--num-envs=2", "--independent-episodes"):
        with endless_gym.connect("independent") as envs:
            played(envs, 3, {"agent_scale": 0.4}, 70)
            used = played(envs, 11, {}, 100)
        with endless_gym.make_vec(id, 2, independent_episodes=True) as envs:
            assert used == played(envs, 11, {}, 100)


def test_a_checkpoint_of_dependent_episodes_is_refused(tmp_path) -> None:
    file = tmp_path / "state"
    with endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file) as envs:
        envs.reset()
    with pytest.raises(RuntimeError, match="continued generators"):
        endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file, resume=True, independent_episodes=True)
    with endless_gym.serve("MysteryPath-v0", 2, seed=1, checkpoint=file, resume=True) as envs:
        envs.adopt()


def test_a_resumed_engine_draws_the_same_seeds(tmp_path) -> None:
    file, arguments = tmp_path / "state", {"num_envs": 2, "seed": 1, "independent_episodes": True}
    options = {"options": {"max_steps": 5}}
    with endless_gym.make_vec("MysteryPath-v0", **arguments, **options) as twin:
        twin.reset()
        with endless_gym.serve("MysteryPath-v0", **arguments, **options, checkpoint=file) as envs:
            envs.reset()
        with endless_gym.serve("MysteryPath-v0", **arguments, **options, checkpoint=file, resume=True) as envs:
            envs.adopt()
            for _ in range(30):
                actions = np.zeros((2, 2), int)
                np.testing.assert_array_equal(envs.step(actions)[0], twin.step(actions)[0])
