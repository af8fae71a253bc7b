"""Everything that takes an id plays an environment of the package `t_maze`; `test_own_crate.py` runs this program."""

import pickle
import subprocess
import sys

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO

import endless_gym
from endless_gym.sb3 import EndlessVecEnv
from endless_gym.torchrl import EndlessEnv

ID = "t_maze:TMaze-v0"
CONTINUE = "import pickle, sys; print(pickle.load(sys.stdin.buffer).step(2)[1])"


def refused(call, part):
    try:
        call()
    except ValueError as error:
        assert part in str(error), error
    else:
        raise AssertionError(part)


def main() -> None:
    assert "TMaze-v0" not in endless_gym.all_specs()
    env = endless_gym.Env(ID, options={"length": 2}, observation="features")
    cue = env.reset(seed=0)[0][0]
    # A new process imports the package of a pickled environment.
    continued = subprocess.run(
        [sys.executable, "-c", CONTINUE], input=pickle.dumps(env), capture_output=True, check=True
    )
    assert float(continued.stdout) == env.step(2)[1] == -0.01
    env.step(2)
    _, reward, terminated, _, info = env.step(int(cue > 0))
    assert (reward, terminated, info["success"]) == (1.0, True, 1)
    refused(lambda: env.step(3), "Discrete(3), got [3]")
    refused(lambda: endless_gym.make_vec(ID, options={"length": 81}), "`length` must be an integer, 1 to 80, got 81")

    frames = []
    for make in (endless_gym.make_vec, endless_gym.serve):
        with make(ID, num_envs=4, render_mode="rgb_array") as envs:
            frames.append(envs.reset(seed=0)[0].copy())
            assert [picture.shape for picture in envs.render()] == [(84, 84, 3)] * 4
            frames.append(envs.step(np.full(4, 2))[0].copy())
    assert frames[0].any() and (frames[0] == frames[2]).all() and (frames[1] == frames[3]).all()

    with gymnasium.make_vec(f"{ID[:7]}EndlessGym/TMaze-v0", num_envs=3) as envs:
        observation, _ = envs.reset(seed=0)
        # A writable tensor of a pool's memory: the pool draws the frames in full afterwards.
        torch.from_dlpack(endless_gym.DLPackView(observation)).fill_(77)
        assert (observation == 77).all()
        del observation
        for _ in range(3):
            assert not (envs.step(np.full(3, 2))[0] == 77).any()
    spawned = gymnasium.make_vec(
        f"{ID[:7]}EndlessGym/TMaze-v0", num_envs=2, vectorization_mode="async", vector_kwargs={"context": "spawn"}
    )
    assert spawned.reset(seed=0)[0].shape == (2, 84, 84, 3)
    spawned.close()

    vec_env = EndlessVecEnv(endless_gym.make_vec(ID, num_envs=2, observation="features", autoreset="same_step"))
    PPO("MlpPolicy", vec_env, n_steps=32, batch_size=32, device="cpu").learn(64)
    vec_env.close()
    env = EndlessEnv(endless_gym.make_vec(ID, num_envs=2, observation="features", autoreset="disabled"))
    assert env.rollout(5, break_when_any_done=False)["next", "reward"].shape[:2] == (2, 5)


if __name__ == "__main__":
    main()
