"""Episodes have the same seeds in this process, in an engine process, and in Gymnasium's vector environment."""

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from support import WHERE

import endless_gym

ID = "Endless-MortarMayhem-v0"
GROUPS, NUM_ENVS = 2, 2
#: Short episodes.
OPTIONS = {"max_steps": 8}


def episodes(envs: endless_gym.EndlessVectorEnv, group: int = 0, number: int = 3) -> list[list[bytes]]:
    """The first frames of the next episodes of each environment of a group, with same-step auto-reset."""
    firsts: list[list[bytes]] = [[] for _ in range(envs.num_envs)]
    while min(map(len, firsts)) < number:
        envs.send(np.zeros((envs.num_envs, 2), np.int64), group)
        observation, _, terminated, *_ = envs.recv(group)
        for env in np.flatnonzero(terminated):
            # The first frame does not yet show the character of the last episode.
            firsts[env].append(observation[env].tobytes())
    return [each[:number] for each in firsts]


@pytest.mark.parametrize("seeds", [None, range(100_000), range(0, 90_000, 3), [5, 6, 7, 8, 9]])
def test_episodes_depend_only_on_the_seed_of_the_reset(seeds) -> None:
    """In process and served, for every seeding policy, whatever the seed at creation and the episodes played before."""
    played = []
    for where in WHERE:
        for seed in (0, 1):
            with where(
                ID, NUM_ENVS, groups=GROUPS, seed=seed, seeds=seeds, options=OPTIONS, autoreset="same_step"
            ) as envs:
                every = [40 + env for env in range(GROUPS * NUM_ENVS)]
                envs.reset()
                for group in range(GROUPS):
                    episodes(envs, group, 1 + seed)
                shown = []
                # The same seeds, in every form.
                for given in (40, every, np.array(every)):
                    envs.reset(seed=given)
                    shown.append([episodes(envs, group) for group in range(GROUPS)])
                for group in range(GROUPS):
                    own = every[group * NUM_ENVS :][:NUM_ENVS]
                    expected = shown[0][group]
                    for given in (40, own, np.array(own, np.uint32)):
                        envs.reset(seed=given, group=group)
                        assert episodes(envs, group) == expected
                        envs.send_reset(group, seed=given)
                        envs.recv(group)
                        assert episodes(envs, group) == expected
                    for env in range(NUM_ENVS):
                        mask = np.arange(NUM_ENVS) == env
                        envs.reset(seed=own, options={"reset_mask": mask}, group=group)
                    for env in range(NUM_ENVS):
                        mask = np.arange(NUM_ENVS) == env
                        envs.reset(seed=np.array(own), options={"reset_mask": mask}, group=group)
                        assert episodes(envs, group)[env] == expected[env]
                assert shown[0] == shown[1] == shown[2]
                played.append(shown[0])
    assert all(each == played[0] for each in played)


def test_a_reset_uses_the_same_seeds_as_sync_vector_env() -> None:
    sync = SyncVectorEnv([lambda: endless_gym.Env(ID)] * 3, autoreset_mode=AutoresetMode.SAME_STEP)
    with endless_gym.make_vec(ID, 3, seed=0, autoreset="same_step") as envs:
        for seed in (7, [3, 1, 2]):
            np.testing.assert_array_equal(envs.reset(seed=seed)[0], sync.reset(seed=seed)[0])
            for _ in range(150):
                actions = np.zeros((3, 2), np.int64)
                np.testing.assert_array_equal(envs.step(actions)[0], sync.step(actions)[0])


@pytest.mark.parametrize("where", WHERE)
def test_seeds_may_be_an_array(where) -> None:
    with where(ID, 4) as envs:
        expected = envs.reset(seed=0)[0].copy()
        np.testing.assert_array_equal(envs.reset(seed=np.arange(4))[0], expected)
        np.testing.assert_array_equal(envs.reset(seed=np.int64(0))[0], expected)
        with pytest.raises(ValueError, match=r"^seed must have 4 items, one for each environment, got 3$"):
            envs.reset(seed=np.arange(3))
        with pytest.raises(TypeError, match=r"^seed must be an integer, got "):
            envs.reset(seed=np.zeros((4, 1), int))
        with pytest.raises(TypeError, match=r"^seed must be an integer, got "):
            envs.reset(seed=np.zeros(4))
        with pytest.raises(ValueError, match=r"^seed must be 0 to \d+, got -1$"):
            envs.reset(seed=np.array([0, 1, -1, 2]))


@pytest.mark.parametrize("where", WHERE)
def test_ranges_keep_their_step(where) -> None:
    wanted = {endless_gym.Env(ID).reset(seed=seed)[0].tobytes() for seed in (0, 3, 6, 9)}
    for seeds in (range(0, 10, 3), range(9, -1, -3)):
        with where(ID, 64, seeds=seeds, seed=1) as envs:
            assert {frame.tobytes() for frame in envs.reset()[0]} == wanted


@pytest.mark.parametrize("where", WHERE)
def test_lists_longer_than_a_command_line_are_used_in_order(where) -> None:
    """The list is longer than the longest permitted command-line argument."""
    seeds = [(number * 7_919) % 2**64 + 10**15 for number in range(100_000)]
    with where(ID, 3, seeds=seeds) as envs:
        for episode in range(2):
            for env, frame in enumerate(envs.reset()[0]):
                expected, _ = endless_gym.Env(ID).reset(seed=seeds[3 * episode + env])
                np.testing.assert_array_equal(frame, expected)
