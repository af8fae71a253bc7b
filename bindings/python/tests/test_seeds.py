"""Every form in which Python gives seeds reaches the environments, in this process and in an engine process."""

import numpy as np
import pytest
from support import WHERE

import endless_gym

ID = "Endless-MortarMayhem-v0"


@pytest.mark.parametrize("where", WHERE)
def test_seeds_may_be_an_array(where) -> None:
    with where(ID, 4) as envs:
        expected = envs.reset(seed=0)[0].copy()
        np.testing.assert_array_equal(envs.reset(seed=np.arange(4))[0], expected)
        np.testing.assert_array_equal(envs.reset(seed=np.int64(0))[0], expected)
        with pytest.raises(ValueError, match=r"^seed must have 4 items, one for each environment, got 3$"):
            envs.reset(seed=np.arange(3))
        for wrong in (np.zeros((4, 1), int), np.zeros(4), "a"):
            with pytest.raises(TypeError, match=r"^seed must be an integer, got "):
                envs.reset(seed=wrong)
        with pytest.raises(ValueError, match=r"^seed must be 0 to \d+, got -1$"):
            envs.reset(seed=np.array([0, 1, -1, 2]))


@pytest.mark.parametrize("where", WHERE)
def test_ranges_keep_their_step(where) -> None:
    wanted = {endless_gym.Env(ID).reset(seed=seed)[0].tobytes() for seed in (0, 3, 6, 9)}
    for seeds in (range(0, 10, 3), range(9, -1, -3)):
        with where(ID, 64, seeds=seeds, seed=1) as envs:
            assert {frame.tobytes() for frame in envs.reset()[0]} == wanted
