"""Options of next episodes, seeds and options of running ones, and replays."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support import MEMORY_GYM, WHERE, exact

import endless_gym

#: The episode of an agent that does nothing ends within a few dozen steps.
ID = "MortarMayhem-Grid-v0"
MODES = ["next_step", "same_step", "disabled"]
ONE, TWO, THREE = ({"command_count": [count]} for count in (1, 2, 3))
Envs = endless_gym.EndlessVectorEnv


def played(envs: Envs, group: int = 0) -> list[dict[str, Any]]:
    return [episode.options for episode in envs.running_episodes(group)]


def stay(envs: Envs, group: int = 0) -> tuple[Any, ...]:
    """One step in which no agent moves."""
    envs.send(np.zeros(envs.action_space.shape, np.int64), group)
    return envs.recv(group)


def until_all_began(envs: Envs, group: int = 0) -> None:
    """Plays until every environment has started another episode."""
    left = set(range(envs.num_envs))
    before: set[int] = set()
    for _ in range(300):
        ended = set(np.flatnonzero(stay(envs, group)[2]).tolist())
        if envs.metadata["autoreset_mode"].name == "NEXT_STEP":
            ended, before = before, ended
        left -= ended
        if not left:
            return
    raise AssertionError("no end")


@pytest.mark.parametrize("where", WHERE)
def test_options_of_a_reset_apply_only_to_its_group_and_environments(where: Callable[..., Envs]) -> None:
    with where(ID, 3, groups=2, seed=0, options={"arena_size": 4}) as envs:
        four = {"arena_size": 4}
        envs.reset(options=TWO, group=0)
        envs.reset(group=1)
        assert (played(envs, 0), played(envs, 1)) == ([four | TWO] * 3, [four] * 3)
        # The reset of the other group does not affect what is known about the options of the first.
        envs.reset(group=0)
        assert played(envs, 0) == [four] * 3
        envs.reset(options=TWO)
        mask = np.array([False, True, False])
        envs.reset(options={"reset_mask": mask}, group=1)
        assert played(envs, 1) == [four | TWO, four, four | TWO]
        envs.reset(options={"reset_mask": ~mask} | THREE, group=1)
        assert played(envs, 1) == [four | THREE, four, four | THREE]
        until_all_began(envs, 1)
        assert played(envs, 1) == [four | THREE, four, four | THREE], "they survive auto-reset"
        assert played(envs, 0) == [four | TWO] * 3
        envs.send_reset(1)
        envs.recv(1)
        envs.reset(group=0)
        assert played(envs, 0) == played(envs, 1) == [four] * 3


@pytest.mark.parametrize("where", WHERE)
def test_reset_options_override_options_of_each_environment(where: Callable[..., Envs]) -> None:
    each = [{"arena_size": 4}, {"arena_size": 6}, {}, {"arena_size": 3}]
    with where(ID, 2, groups=2, seed=0, options=each) as envs:
        envs.reset(options=ONE)
        assert played(envs, 0) + played(envs, 1) == [own | ONE for own in each]
        envs.reset(options={"arena_size": 5})
        assert played(envs, 0) + played(envs, 1) == [{"arena_size": 5}] * 4
        envs.reset()
        assert played(envs, 0) + played(envs, 1) == each


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("mode", MODES)
def test_set_options_apply_to_the_next_episodes(where: Callable[..., Envs], mode: str) -> None:
    with where(ID, 3, seed=0, autoreset=mode) as envs:
        envs.set_options(TWO, mask=np.array([True, False, False]))
        envs.reset()
        assert played(envs) == [TWO, {}, {}]
        envs.set_options([None, ONE, {}])
        envs.set_options(THREE, mask=np.array([True, False, False]))
        assert played(envs) == [TWO, {}, {}], "the running episodes do not change"
        if mode == "disabled":
            envs.reset()
        else:
            until_all_began(envs)
        expected = [THREE, ONE, {}]
        assert played(envs) == expected
        # The options of a reset override them until the next reset.
        envs.reset(options={"arena_size": 4})
        assert played(envs) == [own | {"arena_size": 4} for own in expected]
        envs.reset()
        assert played(envs) == expected
        envs.set_options({})
        envs.reset()
        assert played(envs) == [{}] * 3


@pytest.mark.parametrize("where", WHERE)
def test_wrong_options_change_nothing(where: Callable[..., Envs]) -> None:
    with where(ID, 2, groups=2, seed=0) as envs:
        envs.reset()
        with pytest.raises(ValueError, match="command_count"):
            envs.set_options([ONE, {"command_count": "many"}], group=1)
        with pytest.raises(ValueError, match=r"^options must have one mapping for each of 4 environments, got 3$"):
            envs.set_options([ONE] * 3)
        with pytest.raises(ValueError, match=r"^options must have one mapping for each of 2 environments, got 4$"):
            envs.set_options([ONE] * 4, group=1)
        with pytest.raises(TypeError, match=r"^options must be a mapping, or a sequence of mappings, got 3$"):
            envs.set_options(3)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match=r"^options must be a mapping, got 3$"):
            envs.set_options([ONE, 3], group=0)  # type: ignore[list-item]
        with pytest.raises(ValueError, match=r"^mask must be a bool array of shape \(2,\), got bool \(3,\)$"):
            envs.set_options(ONE, mask=np.ones(3, np.bool_))
        with pytest.raises(ValueError, match=r"^reset_mask must be a bool array of shape \(2,\), got int64 \(2,\)$"):
            envs.reset(options={"reset_mask": [1, 0]})
        with pytest.raises(ValueError, match=r"^group must be 0 to 1, got 2$"):
            envs.set_options(ONE, group=2)
        envs.reset()
        assert played(envs, 0) == played(envs, 1) == [{}] * 2
        # One item for each environment of a group, or of all groups.
        envs.set_options([ONE, None])
        envs.reset()
        assert played(envs, 0) == played(envs, 1) == [ONE, {}]
        envs.set_options([{}, TWO, None, THREE])
        envs.reset()
        assert played(envs, 0) + played(envs, 1) == [{}, TWO, ONE, THREE]
        envs.send(np.zeros(2, np.int64))
        with pytest.raises(RuntimeError, match="pending answer"):
            envs.set_options(ONE)
        envs.recv(0)


class Choices:
    """Chooses one, two, three or the default number of commands in turn, and records its calls."""

    def __init__(self) -> None:
        self.calls: list[tuple[int, int, dict[str, Any] | None]] = []

    def __call__(self, env: int, episode: int, final: dict[str, Any] | None) -> dict[str, Any] | None:
        self.calls.append((env, episode, final))
        return self.options(env, episode)

    @staticmethod
    def options(env: int, episode: int) -> dict[str, Any]:
        return (ONE, TWO, THREE, {})[(env + episode) % 4]


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("mode", MODES)
def test_a_function_chooses_the_options_of_each_episode(where: Callable[..., Envs], mode: str) -> None:
    choices, num_envs, groups = Choices(), 3, 2
    with where(ID, num_envs, groups=groups, seed=0, autoreset=mode, episode_options=choices, episode_info=True) as envs:
        envs.reset()
        number = np.zeros((groups, num_envs), int)
        returns: dict[tuple[int, int], float] = {}
        ended = np.zeros((groups, num_envs), bool)
        for step in range(250):
            group = step % groups
            if mode == "disabled" and ended[group].any():
                started = ended[group].copy()
                info = envs.reset(options={"reset_mask": started}, group=group)[1]
                ended[group] = False
            else:
                _, _, terminated, _, info = stay(envs, group)
                final = info.get("final_info", info)
                for env in np.flatnonzero(terminated):
                    returns[group * num_envs + env, number[group, env]] = final["reward"][env]
                    if mode == "same_step":
                        assert final["options"][env] == choices.options(group * num_envs + env, number[group, env])
                started = {"next_step": ended[group].copy(), "same_step": terminated}.get(
                    mode, np.zeros(num_envs, bool)
                )
                ended[group] = terminated
            number[group] += started
            for env in range(num_envs):
                assert info["options"][env] == choices.options(group * num_envs + env, number[group, env])
        assert number.min() >= 2
        # The function is called once for each episode, in order, with the infos of the last episode that had ended by then.
        ahead = 2 if mode == "same_step" else 1
        for env in range(groups * num_envs):
            own = [(episode, final) for number, episode, final in choices.calls if number == env]
            assert [episode for episode, _ in own] == list(range(len(own)))
            for episode, final in own:
                if episode < ahead:
                    assert final is None
                else:
                    assert final is not None
                    assert final["reward"] == returns[env, episode - ahead]
                    assert final["options"] == choices.options(env, episode - ahead)
                    assert type(final["length"]) is int
                    assert json.dumps(final)


@pytest.mark.parametrize("where", WHERE)
def test_reset_asks_the_function_for_options(where: Callable[..., Envs]) -> None:
    choices = Choices()
    with where(ID, 2, seed=0, episode_options=choices, options={"arena_size": 4}) as envs:
        envs.reset(options={"arena_size": 6})
        assert played(envs) == [{"arena_size": 6} | ONE, {"arena_size": 6} | TWO]
        stay(envs)
        envs.reset(options={"reset_mask": np.array([False, True])})
        assert played(envs) == [{"arena_size": 6} | ONE, {"arena_size": 4} | THREE]
        assert choices.calls[-1] == (1, 1, None), "the episode before was cut short"
        with pytest.raises(ValueError, match="episode_options"):
            envs.set_options(ONE)
        # A restored environment keeps the snapshot's options for the episode, and the function chooses the next.
        snapshot = envs.snapshot(0)
        envs.restore({1: snapshot})
        until_all_began(envs)
        assert played(envs) == [{"arena_size": 4} | TWO, {"arena_size": 4}]
        envs.send_reset()
        envs.recv()
        assert played(envs) == [{"arena_size": 4} | THREE, {"arena_size": 4} | ONE]


@pytest.mark.parametrize("where", WHERE)
def test_an_exception_in_the_function_loses_no_step(where: Callable[..., Envs]) -> None:
    is_wrong = False

    def choose(env: int, episode: int, final: dict[str, Any] | None) -> dict[str, Any]:
        if is_wrong:
            raise KeyError("not ready")
        return {"command_count": [episode + 1]}

    with where(ID, 2, seed=0, episode_options=choose) as envs, endless_gym.make_vec(ID, 2, seed=0, options=ONE) as same:
        first, expected = envs.reset()[0], same.reset()[0]
        np.testing.assert_array_equal(first, expected)
        for _ in range(300):
            is_wrong = True
            try:
                result = stay(envs)
            except KeyError:
                break
            np.testing.assert_array_equal(result[0], stay(same)[0])
        else:
            raise AssertionError("no episode ended")
        is_wrong = False
        stay(envs)
        assert TWO in played(envs)
    with pytest.raises(
        TypeError, match=r"^episode_options must be a function of environment, episode and final infos, or"
    ):
        where(ID, episode_options=ONE)
    with (
        where(ID, episode_options=lambda *_: 3) as envs,
        pytest.raises(TypeError, match="episode_options must be a mapping"),
    ):
        envs.reset()


@pytest.mark.parametrize("where", WHERE)
def test_info_has_seeds_and_options_of_running_episodes(where: Callable[..., Envs]) -> None:
    with where(ID, 2, groups=2, seeds=[1, 2**64 - 1, 3, 4, 5], episode_info=True) as envs:
        # Episode e of environment i of all n has item e n + i.
        for group, expected in ((0, [1, 2**64 - 1]), (1, [3, 4])):
            info = envs.reset(group=group)[1]
            assert info["seed"].tolist() == expected
            assert info["seed"].dtype == np.uint64
            assert info["_seed"].tolist() == [True, True]
            assert info["options"].tolist() == [{}, {}]
        kept = info["seed"]
        assert not any(info[name].flags.writeable for name in ("seed", "_seed", "options", "_options"))
        info = envs.reset(group=1, options=ONE, seed=[None, 9])[1]
        assert info["seed"].tolist() == [2**64 - 1, 9]
        assert info["options"].tolist() == [ONE, ONE]
        assert kept.tolist() == [3, 4], "the arrays of earlier steps do not change"
        snapshot = envs.snapshot(1, group=1)
        info = envs.restore({0: snapshot}, group=0)[1]
        assert info["seed"].tolist() == [9, 2**64 - 1]
        assert info["options"].tolist() == [ONE, {}]
        info = envs.adopt(group=0)[1]
        assert info["seed"].tolist() == [9, 2**64 - 1]
        envs.send_reset(0, seed=70)
        info = envs.recv(0)[4]
        assert info["seed"].tolist() == [70, 71]
        assert info["options"].tolist() == [{}, {}]
        info = envs.reset(group=0, seed=[8, 9], options={"reset_mask": np.array([False, True])})[1]
        assert info["seed"].tolist() == [70, 9]
    with where(ID, 2, seed=8, episode_info=True, autoreset="same_step") as envs:
        info = envs.reset()[1]
        assert (info["seed"].tolist(), info["_seed"].tolist()) == ([8, 9], [True, True])
        while "final_info" not in info:
            info = stay(envs)[4]
        ended = info["_final_info"]
        assert info["_seed"].tolist() == (~ended).tolist(), "a continued generator has no seed"
        assert info["final_info"]["seed"].tolist() == [8, 9]
    with where(ID, 2, episode_info=True, copy=True) as envs:
        info = envs.reset(seed=3)[1]
        info["seed"][:], info["_options"][:] = 0, False
        info = stay(envs)[4]
        assert (info["seed"].tolist(), info["_options"].tolist()) == ([3, 4], [True, True])
    with where(ID, 2) as envs:
        assert not {"seed", "options"} & set(envs.reset()[1])


#: Their first frames show the character of the previous episode, as in the original.
SHOWS_THE_LAST = ("Endless-MortarMayhem-v0",)


@pytest.mark.parametrize("where", WHERE)
@pytest.mark.parametrize("id", MEMORY_GYM)
def test_replay_repeats_episodes(id: str, where: Callable[..., Envs]) -> None:
    short = {} if "Mortar" in id else {"max_steps": 25}
    short |= {"command_count": [2]} if id.startswith("Mortar") else {}
    num_envs, steps = 2, 150
    random = np.random.default_rng(4)
    with where(
        id, num_envs, seeds=range(10**6), seed=1, options=short, episode_info=True, autoreset="same_step"
    ) as envs:
        space = envs.single_action_space
        shape = envs.action_space.shape
        observation, info = envs.reset()
        shown: list[Any] = [[row(observation, env)] for env in range(num_envs)]
        rewards: list[list[float]] = [[] for _ in range(num_envs)]
        actions: list[list[Any]] = [[] for _ in range(num_envs)]
        start = [envs.snapshot(env) for env in range(num_envs)]
        again, by_snapshot = 0, 0
        for _ in range(steps):
            choice = random.integers(0, space.nvec if shape[1:] else space.n, shape)
            observation, reward, terminated, _, info = envs.step(choice)
            for env in range(num_envs):
                actions[env].append(choice[env])
                rewards[env].append(reward[env])
                if not terminated[env]:
                    shown[env].append(row(observation, env))
                    continue
                final = info["final_info"]
                shown[env].append(exact(info["final_obs"][env]))
                seed, options = int(final["seed"][env]), final["options"][env]
                assert final["_seed"][env]
                assert options == short
                same = compare(shown[env], rewards[env], endless_gym.replay(id, seed, options, actions[env]))
                assert same or (id in SHOWS_THE_LAST and again >= num_envs)
                if by_snapshot < 3:
                    assert compare(shown[env], rewards[env], endless_gym.replay(id, start[env], None, actions[env]))
                    by_snapshot += 1
                again += 1
                shown[env], rewards[env], actions[env] = [row(observation, env)], [], []
                start[env] = envs.snapshot(env)
        assert again >= 3


def row(observation: Any, env: int) -> Any:
    return exact(
        {key: part[env] for key, part in observation.items()} if isinstance(observation, dict) else observation[env]
    )


def compare(shown: list[Any], rewards: list[float], steps: Any) -> bool:
    """Whether the observations are equal. Asserts that the rewards and the end of the episode are."""
    steps = list(steps)
    assert [step.reward for step in steps[1:]] == rewards
    assert [step.terminated for step in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[-1].info["length"] == len(rewards)
    return shown == [exact(step.observation) for step in steps]


def test_wrong_replays_raise_typed_errors() -> None:
    steps = endless_gym.replay(ID, 3, ONE, [0] * 200, render_mode="rgb_array")
    with pytest.raises(
        ValueError, match=r"^actions must not go beyond the end of the episode, which ended after \d+ actions$"
    ):
        for step in steps:
            assert step.frame is not None
            assert step.frame.shape == (84, 84, 3)
    env = endless_gym.Env(ID)
    env.reset(seed=3)
    with pytest.raises(ValueError, match=r"^options must be None with a snapshot, which contains its own, got "):
        endless_gym.replay(ID, env.snapshot(), ONE, [])
    with pytest.raises(ValueError, match="not a snapshot"):
        endless_gym.replay(ID, b"", None, [])
    with pytest.raises(TypeError, match="seed must be an integer"):
        endless_gym.replay(ID, "3", None, [])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="agent_size"):
        endless_gym.replay(ID, 3, {"agent_size": 1}, [])
