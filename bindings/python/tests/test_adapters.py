"""The adapters fulfil the contracts of Stable-Baselines3, TorchRL and PufferLib."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest
from support import same

import endless_gym

pytestmark = pytest.mark.libraries

# Random agents fail after some 30 steps.
SHORT = "Endless-MortarMayhem-v0"
IDS = ["MortarMayhem-v0", "MortarMayhem-Grid-v0", "Endless-MysteryPath-v0", "Endless-SearingSpotlights-v0"]
DICT_ID = "MortarMayhemB-Grid-v0"
FRAME = (84, 84, 3)


def random_actions(envs, rng: np.random.Generator, num_envs: int) -> np.ndarray:
    """Actions for `num_envs` environments of `envs`, which has a ``single_action_space`` or an ``action_space``."""
    space = getattr(envs, "single_action_space", None) or envs.action_space
    highest = np.asarray(space.nvec if hasattr(space, "nvec") else space.n)
    return rng.integers(0, highest, size=(num_envs, *space.shape))


def reference(env_id: str, num_envs: int, autoreset: str, seed: int, **kwargs):
    """The package's own vector environment, with which an adapter is compared."""
    envs = endless_gym.make_vec(env_id, num_envs=num_envs, autoreset=autoreset, **kwargs)
    return envs, envs.reset(seed=seed)[0]


@pytest.mark.parametrize(
    ("module", "name", "autoreset", "library"),
    [("sb3", "EndlessVecEnv", "same_step", "Stable-Baselines3"), ("torchrl", "EndlessEnv", "disabled", "TorchRL")],
)
def test_other_reset_modes_and_groups_are_refused(module, name, autoreset, library):
    adapt = getattr(importlib.import_module(f"endless_gym.{module}"), name)
    for kwargs, match in (
        ({}, f'autoreset must be "{autoreset}" for {library}, got "next_step"'),
        ({"groups": 2, "autoreset": autoreset}, f"groups must be 1 for {library}, got 2"),
    ):
        with endless_gym.make_vec(SHORT, 1, **kwargs) as envs, pytest.raises(ValueError, match=match):
            adapt(envs)


class TestStableBaselines3:
    @pytest.fixture(autouse=True)
    def adapter(self):
        from endless_gym.sb3 import EndlessVecEnv

        self.make = EndlessVecEnv.make
        self.adapt = EndlessVecEnv

    def test_infos_of_ended_episodes_match_those_of_monitor(self):
        num_envs, rng = 8, np.random.default_rng(1)
        envs, obs = reference(SHORT, num_envs, "disabled", seed=11)
        venv = self.make(SHORT, num_envs=num_envs)
        venv.seed(11)
        np.testing.assert_array_equal(venv.reset(), obs)
        total, length, ended = np.zeros(num_envs), np.zeros(num_envs, int), 0
        previous_infos, previous_done = None, None
        for _ in range(200):
            actions = random_actions(venv, rng, num_envs)
            last, expected, terminated, truncated, _ = envs.step(actions)
            total += expected
            length += 1
            done = terminated | truncated
            following = last
            if done.any():
                following, _ = envs.reset(options={"reset_mask": done})
            obs, rewards, dones, infos = venv.step(actions)
            np.testing.assert_array_equal(dones, done)
            np.testing.assert_array_equal(rewards, expected.astype(np.float32))
            np.testing.assert_array_equal(obs[~done], last[~done])
            assert following.shape == obs.shape
            for index in range(num_envs):
                if not done[index]:
                    assert infos[index] == {"TimeLimit.truncated": False}
                    continue
                ended += 1
                np.testing.assert_array_equal(infos[index]["terminal_observation"], last[index])
                assert infos[index]["TimeLimit.truncated"] == bool(truncated[index] and not terminated[index])
                assert infos[index]["episode"]["r"] == pytest.approx(total[index])
                assert infos[index]["episode"]["l"] == length[index]
                assert 0 <= infos[index]["episode"]["t"] < 600
                assert infos[index]["reward"] == pytest.approx(total[index])
                assert infos[index]["length"] == length[index]
            if previous_infos is not None:
                for index in np.flatnonzero(~done & ~previous_done):
                    assert infos[index] is previous_infos[index], "the dict of a running episode is made once"
            previous_infos, previous_done = infos, done
            if done.any():
                # The next episodes continue the environments' own generators, so both play the same.
                np.testing.assert_array_equal(obs, following)
            total[done], length[done] = 0, 0
        assert ended >= num_envs
        assert (obs.dtype, rewards.dtype, dones.dtype) == (np.uint8, np.float32, np.bool_)
        assert venv.observation_space.contains(obs[0]) and len(venv.reset_infos) == num_envs
        rewards += 1  # on-policy algorithms add to the rewards of episodes that were cut off
        venv.close()
        envs.close()

    def test_final_ground_truth_is_that_of_the_ended_episode(self):
        venv = self.make("Endless-SearingSpotlights-v0", num_envs=2)
        venv.seed(0)
        venv.reset()
        assert "ground_truth" in venv.reset_infos[0]
        for _ in range(1000):
            _, _, dones, infos = venv.step(np.zeros((2, 2), np.int64))
            for index in np.flatnonzero(dones):
                final, following = venv.info["final_info"]["ground_truth"][index], venv.info["ground_truth"][index]
                assert not np.array_equal(final, following)
                np.testing.assert_array_equal(infos[index]["ground_truth"], final)
                assert "coins_collected" in infos[index]
                return
        pytest.fail("no episode ended")

    def test_attributes_and_options_are_those_of_dummy_vec_env(self):
        from stable_baselines3.common.vec_env import DummyVecEnv

        id, each = "Endless-MysteryPath-v0", [{"max_steps": 20}, {}, {"max_steps": 30}]
        dummy = DummyVecEnv([lambda: endless_gym.Env(id)] * 3)
        venv = self.make(id, num_envs=3)

        def compare() -> None:
            for name in ("action_space", "observation_space", "max_episode_steps", "reset_params", "render_mode"):
                assert venv.get_attr(name) == dummy.get_attr(name), name
                assert venv.get_attr(name, [2]) == dummy.get_attr(name, [2]), name
            assert [spec.id for spec in venv.get_attr("spec")] == [f"EndlessGym/{id}"] * 3

        compare()
        for options in (each, {"max_steps": 25}, None, each):
            for envs in (venv, dummy):
                envs.seed(5)
                if options is not None:
                    envs.set_options(options)
            np.testing.assert_array_equal(venv.reset(), dummy.reset())
            compare()
        for envs in (venv, dummy):
            envs.set_options([{}, {"colour": 1}, {}])
            with pytest.raises(ValueError, match="colour"):
                envs.reset()
        venv.reset()
        venv.close()

    def test_dict_observations_stay_dicts(self):
        venv = self.make(DICT_ID, num_envs=3)
        obs = venv.reset()
        assert obs["visual_observation"].shape == (3, *FRAME)
        assert obs["vector_observation"].shape == (3, 180)
        assert obs["vector_observation"].dtype == np.float32
        rng = np.random.default_rng(0)
        for _ in range(400):
            _, _, dones, infos = venv.step(random_actions(venv, rng, 3))
            for index in np.flatnonzero(dones):
                assert venv.observation_space.contains(infos[index]["terminal_observation"])
                return
        pytest.fail("no episode ended")

    def test_wrappers_and_ppo_accept_the_adapter(self):
        from stable_baselines3 import PPO
        from stable_baselines3.common.evaluation import evaluate_policy
        from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            venv = VecNormalize(VecFrameStack(self.make(SHORT, num_envs=4), 2), norm_obs=False)
            model = PPO("CnnPolicy", venv, n_steps=32, batch_size=64, n_epochs=1, device="cpu").learn(128)
            assert model.num_timesteps == 128
            assert model.logger.get_dir() == os.environ["SB3_LOGDIR"], "nothing is left in /tmp"
            returns, lengths = evaluate_policy(
                model, VecFrameStack(self.make(SHORT, num_envs=2), 2), n_eval_episodes=2, return_episode_rewards=True
            )
            assert len(returns) == len(lengths) == 2
        assert venv.get_attr("render_mode") == [None] * 4
        assert venv.env_is_wrapped(object, [0, 2]) == [False, False]
        venv.close()

    def test_torch_warning_is_suppressed_only_for_stable_baselines3(self):
        # In a separate process, since PyTorch warns only once.
        program = f"""
import numpy as np, torch, warnings
from endless_gym.sb3 import EndlessVecEnv
from stable_baselines3.common.utils import obs_as_tensor
venv = EndlessVecEnv.make({SHORT!r}, num_envs=2)
observation = venv.reset()
torch.set_warn_always(True)
for read in (lambda: obs_as_tensor(observation, "cpu"), lambda: torch.as_tensor(observation)):
    warnings.simplefilter("always", append=True)
    with warnings.catch_warnings(record=True) as caught:
        read()
    print(len(caught))
"""
        printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
        assert printed.split() == ["0", "1"]

    def test_a_step_runs_the_same_number_of_python_lines_for_any_number_of_environments(self):
        def lines_of_a_step(num_envs: int) -> int:
            venv = self.make(SHORT, num_envs=num_envs)
            venv.reset()
            actions = np.zeros((num_envs, 2), np.int64)
            venv.step(actions)  # imports and caches
            lines = 0

            def trace(frame, event, argument):
                nonlocal lines
                lines += event == "line"
                return trace

            before = sys.gettrace()
            sys.settrace(trace)
            try:
                _, _, dones, _ = venv.step(actions)
            finally:
                sys.settrace(before)
            assert not dones.any()
            venv.close()
            return lines

        assert lines_of_a_step(512) == lines_of_a_step(2) > 5

    def test_adapter_works_over_a_served_engine(self):
        with endless_gym.serve(SHORT, num_envs=4, autoreset="same_step") as envs:
            venv = self.adapt(envs)
            venv.seed(2)
            kept = [venv.reset()]
            rng, ended = np.random.default_rng(0), 0
            terminal = []
            for _ in range(100):
                obs, _, dones, infos = venv.step(random_actions(venv, rng, 4))
                kept = [kept[-1], obs]  # as an algorithm does
                terminal += [infos[index]["terminal_observation"] for index in np.flatnonzero(dones)]
                ended += dones.sum()
            assert ended >= 4
            assert len(terminal) == ended, "terminal observations may be kept: they hold no shared memory"


class TestTorchRL:
    @pytest.fixture(autouse=True)
    def adapter(self):
        from endless_gym.torchrl import EndlessEnv

        self.make = EndlessEnv.make
        self.adapt = EndlessEnv

    @pytest.mark.parametrize("env_id", [*IDS, SHORT, DICT_ID])
    def test_torchrls_spec_checker_passes(self, env_id):
        from torchrl.envs import check_env_specs

        env = self.make(env_id, num_envs=3)
        check_env_specs(env, seed=0, break_when_any_done="both")
        env.close()

    @pytest.mark.parametrize("env_id", [SHORT, "MysteryPath-Grid-v0", "Endless-SearingSpotlights-v0"])
    def test_rollout_equals_what_the_environments_return(self, env_id):
        import torch

        num_envs, steps, rng = 4, 120, np.random.default_rng(5)
        options = {"max_steps": 30}
        envs, obs = reference(env_id, num_envs, "disabled", seed=3, options=options)
        env = self.make(env_id, num_envs=num_envs, options=options)
        env.set_seed(3)
        actions = torch.from_numpy(np.stack([random_actions(envs, rng, num_envs) for _ in range(steps)]))
        numbers = iter(actions)
        data = env.rollout(steps, lambda td: td.set("action", next(numbers)), break_when_any_done=False)
        assert data.batch_size == (num_envs, steps)
        described, ended = endless_gym.spec(env_id), 0
        names = ["reward", "length", *(name for name, _ in described.info)]
        assert sorted(data["next", "final_info"].keys()) == sorted(names)
        for t in range(steps):
            now = data[:, t]
            np.testing.assert_array_equal(now["observation"], obs)
            obs, reward, terminated, truncated, info = envs.step(actions[t].numpy())
            done = terminated | truncated
            wanted = {
                "reward": reward.astype(np.float32),
                "terminated": terminated,
                "truncated": truncated,
                "done": done,
            }
            same({name: now["next", name][:, 0] for name in wanted}, wanted)
            np.testing.assert_array_equal(now["next", "observation"], obs)
            for name in names:
                expected = np.where(terminated, info.get(name, np.zeros(num_envs)), 0)
                np.testing.assert_array_equal(now["next", "final_info", name][:, 0], expected)
            if described.ground_truth:
                np.testing.assert_array_equal(now["next", "ground_truth"], info["ground_truth"])
            ended += done.sum()
            if done.any():
                obs, _ = envs.reset(options={"reset_mask": done})
        assert ended >= num_envs
        assert {name: data["next", "final_info", name].is_floating_point() for name, _ in described.info} == {
            name: not is_integer for name, is_integer in described.info
        }
        env.close()
        envs.close()

    def test_observations_may_be_written_to(self):
        env = self.make(SHORT, num_envs=2)
        first = env.reset()
        kept = first["observation"].clone()
        second = env.step(env.rand_action(first.clone()))["next"]
        second["observation"].zero_()
        np.testing.assert_array_equal(first["observation"], kept)
        env.close()

    def test_adapter_works_over_a_served_engine(self):
        with endless_gym.serve(SHORT, num_envs=4, autoreset="disabled") as envs:
            data = self.adapt(envs).rollout(100, break_when_any_done=False)
            assert data.batch_size == (4, 100), "a rollout keeps more observations than an engine lends"
            assert data["next", "done"].sum() >= 4


class TestPufferLib:
    @pytest.fixture(autouse=True)
    def adapter(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)  # importing PufferLib puts a link into the working directory
        from endless_gym.pufferlib import EndlessPufferEnv

        self.env = EndlessPufferEnv

    @pytest.mark.parametrize("buffers", [False, True])
    def test_steps_equal_those_of_the_vector_environment(self, buffers):
        num_envs, rng = 6, np.random.default_rng(4)
        envs, obs = reference(SHORT, num_envs, "same_step", seed=3 * num_envs)
        buf = None
        if buffers:
            buf = {
                "observations": np.zeros((num_envs, *FRAME), np.uint8),
                "rewards": np.zeros(num_envs, np.float32),
                "terminals": np.zeros(num_envs, bool),
                "truncations": np.zeros(num_envs, bool),
                "masks": np.ones(num_envs, bool),
                "actions": np.zeros((num_envs, 2), np.int32),
            }
        env = self.env(SHORT, num_envs=num_envs, buf=buf)
        assert (env.num_agents, env.emulated, env.done, env.driver_env) == (num_envs, False, False, env)
        given, infos = env.reset(seed=3)
        np.testing.assert_array_equal(given, obs)
        assert given.shape == env.observation_space.shape and infos == []
        ended = 0
        for _ in range(150):
            actions = random_actions(env, rng, num_envs)
            obs, reward, terminated, truncated, info = envs.step(actions)
            env.send(actions.astype(np.int32))
            got, rewards, terminals, truncations, infos, agents, masks = env.recv()
            np.testing.assert_array_equal(got, obs)
            np.testing.assert_array_equal(rewards, reward.astype(np.float32))
            np.testing.assert_array_equal(terminals, terminated)
            np.testing.assert_array_equal(truncations, truncated)
            np.testing.assert_array_equal(agents, np.arange(num_envs))
            assert masks.all()
            if buffers:
                assert got is buf["observations"]
                assert rewards is buf["rewards"]
                assert terminals is buf["terminals"]
            done = terminated | truncated
            ended += done.sum()
            if done.any():
                (statistics,) = infos
                assert statistics["episode_return"] == info["final_info"]["reward"][done].tolist()
                assert statistics["episode_length"] == info["final_info"]["length"][done].tolist()
                assert all(isinstance(values, list) and len(values) == done.sum() for values in statistics.values())
            else:
                assert infos == []
        assert ended >= num_envs
        assert (got.dtype, rewards.dtype) == (np.uint8, np.float32)
        assert terminals.dtype == truncations.dtype == np.bool_
        env.close()
        envs.close()

    def test_a_serial_batch_plays_different_episodes(self):
        import pufferlib.vector

        vecenv = pufferlib.vector.make(
            self.env, env_kwargs={"env_id": "MysteryPath-Grid-v0", "num_envs": 4}, num_envs=3, backend="Serial"
        )
        assert vecenv.num_agents == 12
        obs, _ = vecenv.reset(seed=0)
        with endless_gym.make_vec("MysteryPath-Grid-v0", num_envs=12) as envs:
            np.testing.assert_array_equal(obs, envs.reset(seed=0)[0])
        obs, rewards, *_ = vecenv.step(np.zeros(12, np.int32))
        assert obs.shape == (12, *FRAME)
        assert rewards.shape == (12,)
        vecenv.close()

    def test_refuses_dict_observations(self):
        with pytest.raises(ValueError, match=DICT_ID):
            self.env(DICT_ID, num_envs=2)
