"""A client can use an environment that its own build does not have."""

import numpy as np
import pytest
from support import engine_of_program

import endless_gym

ID = "Endless-MysteryPath-v0"


def test_client_without_the_id_uses_the_published_specification(monkeypatch):
    with engine_of_program("foreign", ID, "--num-envs=2", "--seed=1"):
        monkeypatch.delitem(endless_gym.all_specs(), ID)
        with pytest.raises(ValueError, match="id must be one of"):
            endless_gym.make_vec(ID, 2)
        with endless_gym.connect("foreign", timeout=10) as envs:
            assert envs.single_action_space.n == 4
            observation, _ = envs.reset()
            assert observation in envs.observation_space
            info = envs.step(np.ones(2, np.int32))[4]
            assert info["ground_truth"].shape == (2, 3)
