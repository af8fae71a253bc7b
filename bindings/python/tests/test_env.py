"""One environment equals the original byte for byte and passes Gymnasium's own checks."""

import copy
import json
import pickle
import subprocess
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from support import MEMORY_GYM, exact

import endless_gym

IDS = MEMORY_GYM
#: Reset parameters with which random actions end several episodes.
OPTIONS = {
    **{id: {"command_count": [2]} for id in IDS if id.startswith("MortarMayhem")},
    **{id: {"max_steps": 40} for id in IDS if "MysteryPath" in id},
    "SearingSpotlights-v0": {"num_coins": [3], "agent_health": 2},
    "Endless-SearingSpotlights-v0": {"max_steps": 40},
}


@pytest.mark.parametrize("id", IDS)
def test_env_equals_the_original_step_by_step(id: str, original_python: str, tmp_path: Path) -> None:
    env = gymnasium.make(f"EndlessGym/{id}", render_mode="debug_rgb_array")
    env.action_space.seed(3)
    actions = np.array([np.atleast_1d(env.action_space.sample()) for _ in range(400)])
    np.save(tmp_path / "actions.npy", actions)
    options = OPTIONS.get(id, {})
    program = Path(__file__).parent / "original.py"
    arguments = [id, tmp_path / "actions.npy", json.dumps(options), tmp_path / "out.pickle"]
    subprocess.run([original_python, program, *arguments], check=True, capture_output=True)
    described, expected = pickle.loads((tmp_path / "out.pickle").read_bytes())

    def check(*entry: object) -> None:
        wanted = expected.pop(0)
        for name, given, original in zip(
            ("observation", "reward", "terminated", "truncated", "info", "render"), entry, wanted, strict=True
        ):
            assert exact(given) == original, f"{name}, {len(expected)} before the end"

    observation, info = env.reset(seed=11, options=options)
    check(observation, None, None, None, info, env.render())
    unwrapped = env.unwrapped
    assert isinstance(unwrapped, endless_gym.Env)
    assert repr(env.observation_space) == described["observation_space"]
    assert repr(env.action_space) == described["action_space"]
    meanings = {"actions", "features", "ground_truth"}
    assert {key: value for key, value in unwrapped.metadata.items() if key not in meanings} == described["metadata"]
    assert unwrapped.has_ground_truth_info == described["has_ground_truth_info"]
    assert repr(getattr(unwrapped, "ground_truth_space", None)) == described["ground_truth_space"]
    assert unwrapped.max_episode_steps == described["max_episode_steps"]
    ends = 0
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(int(action[0]) if len(action) == 1 else action)
        assert 0 <= info.pop("task_progress", 0) <= 1  # the original does not return it
        check(observation, reward, terminated, truncated, info, env.render())
        if terminated:
            observation, info = env.reset(options=options)
            check(observation, None, None, None, info, env.render())
            ends += 1
    assert ends >= 2
    assert not expected


@pytest.mark.parametrize("id", IDS)
@pytest.mark.filterwarnings("error")
def test_gymnasiums_checker_passes(id: str) -> None:
    for mode in (None, "rgb_array", "debug_rgb_array"):
        check_env(gymnasium.make(f"EndlessGym/{id}", render_mode=mode).unwrapped, skip_render_check=True)


def test_observations_do_not_change() -> None:
    env = endless_gym.Env("MortarMayhem-v0")
    first, _ = env.reset(seed=1)
    kept = first.copy()
    for _ in range(5):
        env.step([1, 1])
    np.testing.assert_array_equal(first, kept)
    first[:] = 0


def test_options_last_for_one_episode() -> None:
    env = endless_gym.Env("MortarMayhem-v0")
    assert env.reset(seed=1, options={"arena_size": 2})[0].sum() != env.reset(seed=1)[0].sum()
    fixed = endless_gym.Env("MortarMayhem-v0", options={"arena_size": 2})
    np.testing.assert_array_equal(fixed.reset(seed=1)[0], env.reset(seed=1, options={"arena_size": np.int64(2)})[0])


def test_the_originals_ids_and_classes_make_equal_environments() -> None:
    import endless_gym.memory_gym as memory_gym

    env = gymnasium.make("MortarMayhem-Grid-v0")
    assert isinstance(env.unwrapped, endless_gym.Env)
    other = memory_gym.GridMortarMayhemEnv(render_mode="rgb_array")
    np.testing.assert_array_equal(env.reset(seed=2)[0], other.reset(seed=2)[0])


#: Ways to copy an environment.
COPIES = {"deepcopy": copy.deepcopy, "copy": copy.copy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


@pytest.mark.parametrize("how", COPIES.values(), ids=COPIES)
@pytest.mark.parametrize("id", IDS)
def test_copies_continue_identically_and_independently(how: Any, id: str) -> None:
    env = endless_gym.Env(
        id, "debug_rgb_array", {"agent_scale": 0.3}, frames=endless_gym.Frames(grayscale=True, stack=3)
    )
    env.action_space.seed(1)
    env.reset(seed=1, options={"agent_scale": 0.2})
    for _ in range(10):
        env.step(env.action_space.sample())
        env.render()
    other = how(env)
    assert type(other) is type(env)
    assert other.reset_params == env.reset_params
    assert other.observation_space == env.observation_space
    actions = [env.action_space.sample() for _ in range(150)]
    played = [list(play(each, actions)) for each in (env, other)]
    assert exact(played[0]) == exact(played[1])


def play(env: endless_gym.Env, actions: list[Any]) -> Any:
    """Plays, and resets at the ends of episodes."""
    for action in actions:
        *step, info = env.step(action)
        yield (*step, info, env.render())
        if step[2]:
            yield env.reset()


def test_a_copy_of_an_environment_with_independent_episodes_draws_the_same_seeds() -> None:
    env = endless_gym.Env("Endless-MortarMayhem-v0", "rgb_array", {"max_steps": 20}, independent_episodes=True)
    env.reset(seed=1)
    other = copy.deepcopy(env)
    actions = [env.action_space.sample() for _ in range(90)]
    assert exact(list(play(env, actions))) == exact(list(play(other, actions)))


@pytest.mark.parametrize("how", COPIES.values(), ids=COPIES)
def test_an_environment_without_an_episode_is_copied(how: Any) -> None:
    env = endless_gym.Env("MortarMayhemB-Grid-v0", options={"arena_size": 3}, observation="features")
    other = how(env)
    for each in (env, other):
        with pytest.raises(ResetNeeded):
            each.step(0)
    np.testing.assert_array_equal(other.reset(seed=1)[0]["features"], env.reset(seed=1)[0]["features"])


def test_made_environments_and_the_originals_classes_are_pickled() -> None:
    import endless_gym.memory_gym as memory_gym

    for env in (gymnasium.make("EndlessGym/MysteryPath-v0"), memory_gym.MysteryPathEnv()):
        env.reset(seed=1)
        other = pickle.loads(pickle.dumps(env))
        assert type(other.unwrapped) is type(env.unwrapped)
        np.testing.assert_array_equal(env.step([1, 0])[0], other.step([1, 0])[0])


@pytest.mark.parametrize("where", ["EndlessGym/", ""])
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_async_vector_env_plays_as_sync_vector_env(where: str, context: str) -> None:
    import endless_gym.memory_gym

    id = f"{where}Endless-MysteryPath-v0"
    kwargs: dict[str, Any] = {"options": {"max_steps": 5}, "frames": endless_gym.Frames(grayscale=True)}
    sync = gymnasium.make_vec(id, 2, vectorization_mode="sync", **kwargs)
    asynchronous = gymnasium.make_vec(id, 2, vectorization_mode="async", vector_kwargs={"context": context}, **kwargs)
    try:
        assert exact(sync.reset(seed=1)) == exact(asynchronous.reset(seed=1))
        sync.action_space.seed(1)
        for _ in range(12):
            actions = sync.action_space.sample()
            assert exact(sync.step(actions)) == exact(asynchronous.step(actions))
    finally:
        asynchronous.close()


def test_gymnasium_make_accepts_list_render_modes() -> None:
    env = gymnasium.make("EndlessGym/MysteryPath-v0", render_mode="rgb_array_list")
    env.reset(seed=1)
    env.step([1, 0])
    assert [picture.shape for picture in env.render()] == [(84, 84, 3)] * 2
    assert gymnasium.spec("EndlessGym/MysteryPath-v0").to_json()


@pytest.mark.parametrize("id", ["MortarMayhemB-v0", "Endless-SearingSpotlights-v0"])
@pytest.mark.parametrize(
    "kwargs",
    [
        {"observation": "features"},
        {"observation": "rgb+features"},
        {"frames": endless_gym.Frames(channels_first=True, row_major=True, stack=4)},
        {"observation": "rgb+features", "frames": endless_gym.Frames(grayscale=True)},
    ],
    ids=str,
)
def test_observations_equal_a_vector_environments(id: str, kwargs: dict[str, Any]) -> None:
    env = gymnasium.make(f"EndlessGym/{id}", **kwargs)
    with endless_gym.make_vec(id, 1, autoreset="disabled", **kwargs) as envs:
        assert env.observation_space == envs.single_observation_space
        envs.action_space.seed(1)
        given, wanted = env.reset(seed=1)[0], envs.reset(seed=1)[0]
        for _ in range(30):
            assert given in env.observation_space
            assert exact(given) == exact(
                {key: value[0] for key, value in wanted.items()} if isinstance(wanted, dict) else wanted[0]
            )
            actions = envs.action_space.sample()
            given, wanted = env.step(actions[0])[0], envs.step(actions)[0]


def test_progress_counts_tiles_and_falls() -> None:
    env = endless_gym.Env("MysteryPath-Grid-v0")
    with pytest.raises(RuntimeError):
        env.progress()
    env.reset(seed=200_000)
    assert env.progress() == {"tiles": (0.0, 8.0), "falls": (0.0, None)}
