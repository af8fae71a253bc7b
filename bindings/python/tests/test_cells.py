"""What the package offers, for every kind of environment: features down, environments across.

A feature that an environment cannot have says why in one line when it is requested.
"""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from original_types import types
from support import same

import endless_gym
from endless_gym.popgym import PreviousAction

#: An environment of each suite and of each kind of observation and action space.
IDS = [
    "MortarMayhem-Grid-v0",
    "MortarMayhemB-v0",
    "popgym-RepeatPreviousEasy-v0",
    "popgym-AutoencodeEasy-v0",
    "popgym-CountRecallEasy-v0",
    "popgym-PositionOnlyPendulumEasy-v0",
    "popgym-BattleshipEasy-v0",
    "popgym-RepeatPreviousEasy-v0?k=2",
]

TYPES = json.loads(Path(__file__).with_name("original_types.json").read_text())


def row(batch: Any, number: int) -> Any:
    """One of the observations of a batch or an episode."""
    if isinstance(batch, dict):
        return {key: row(part, number) for key, part in batch.items()}
    return tuple(row(part, number) for part in batch) if isinstance(batch, tuple) else batch[number]


@pytest.mark.libraries
@pytest.mark.parametrize("id", IDS)
def test_data_sets_are_what_a_new_environment_plays(id: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minari = pytest.importorskip("minari")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", "data")
    for policy, root in (("expert", "data"), ("random", None)):
        recorded = endless_gym.record(id, 2, policy=policy, seed=3, root=root, max_steps=30)
        dataset = minari.load_dataset(recorded.dataset)
        env = dataset.recover_environment()
        assert (dataset.observation_space, dataset.action_space) == (env.observation_space, env.action_space)
        for number, episode in enumerate(dataset):
            observation, _ = env.reset(seed=3 + number)
            same(row(episode.observations, 0), observation)
            for step, action in enumerate(episode.actions):
                observation, reward, *_ = env.step(action)
                same([row(episode.observations, step + 1), episode.rewards[step]], [observation, reward])


@pytest.mark.parametrize("id", TYPES)
def test_a_single_environment_returns_the_types_of_the_original(id: str) -> None:
    given, wanted = types(endless_gym.Env(id)), TYPES[id]
    assert (given["observation"], given["reward"]) == (wanted["observation"], wanted["reward"])
    # The original's infos of POPGym are numbers of the ground truth.
    if not id.startswith("popgym"):
        assert {info for info in given["info"] if "task_progress" not in info} == set(wanted["info"])


def test_discrete_observations_are_keys_and_json() -> None:
    for id in ("popgym-RepeatFirstEasy-v0", "popgym-AutoencodeEasy-v0"):
        observation, _ = endless_gym.Env(id).reset(seed=1)
        assert json.dumps(observation) and {observation: 1}
    envs = endless_gym.make_vec("popgym-RepeatFirstEasy-v0", 1, autoreset="same_step", seed=1)
    envs.reset()
    steps = (envs.step([0])[4] for _ in range(60))
    assert {type(info["final_obs"][0]) for info in steps if "final_obs" in info} == {int}


def test_arrays_are_options() -> None:
    options = {"command_show_duration": np.array([9])}
    assert endless_gym.spec("MortarMayhem-v0").max_episode_steps(options) == 335
    env = endless_gym.Env("MortarMayhem-v0")
    env.reset(options=options)
    assert env.max_episode_steps == 335
    assert endless_gym.make_vec("MortarMayhem-v0", 1, options=options).max_episode_steps == [335]


def test_a_step_of_concentration_after_its_end_is_not_another_end() -> None:
    env, experts = endless_gym.Env("popgym-ConcentrationEasy-v0"), endless_gym.Experts("popgym-ConcentrationEasy-v0")
    observation, _ = env.reset(seed=1)
    is_first, terminated, truncated = np.array([True]), False, False
    while not (terminated or truncated):
        action = int(experts.act(observation[None], is_first)[0])
        observation, _, terminated, truncated, _ = env.step(action)
        is_first = np.array([False])
    assert terminated
    # As in the original, whose two cards stay face up.
    assert env.step(0)[1:4] == (pytest.approx(-1 / 104), False, False)


POPGYM = [id for id, spec in endless_gym.all_specs().items() if spec.markov_state]


@pytest.mark.libraries
def test_recurrent_ppo_of_stable_baselines_plays_all_of_popgym() -> None:
    pytest.importorskip("sb3_contrib")
    from sb3_contrib import RecurrentPPO
    from stable_baselines3.common.monitor import Monitor

    from endless_gym.sb3 import EndlessVecEnv

    for id in POPGYM:
        envs = endless_gym.make_vec(id, 2, autoreset="same_step", seed=1)
        venv = EndlessVecEnv(PreviousAction(envs, flatten=True))
        assert venv.get_attr("max_episode_steps") and venv.env_is_wrapped(Monitor) == [True, True]
        small = {"lstm_hidden_size": 4, "net_arch": [4]}
        RecurrentPPO("MlpLstmPolicy", venv, n_steps=4, batch_size=8, n_epochs=1, policy_kwargs=small).learn(8)
    with pytest.raises(ValueError, match=r"must not be tuples .*PreviousAction\(envs, flatten=True\)"):
        EndlessVecEnv(endless_gym.make_vec("popgym-AutoencodeEasy-v0", 1, autoreset="same_step"))


@pytest.mark.libraries
def test_torchrl_plays_all_of_popgym() -> None:
    pytest.importorskip("torchrl")
    from endless_gym.torchrl import EndlessEnv

    for id in POPGYM:
        with endless_gym.make_vec(id, 2, autoreset="disabled", seed=1) as envs:
            data = EndlessEnv(PreviousAction(envs, flatten=True)).rollout(3)
            assert data["observation"].shape[0] == 2
        if "Tuple" not in str(envs.single_observation_space):
            assert EndlessEnv.make(id, 2).rollout(3)["observation"].shape[0] == 2


@pytest.mark.parametrize(
    ("id", "where"),
    [*((id, where) for id in IDS for where in ("single", "make_vec")), (IDS[0], "serve"), (IDS[2], "serve")],
)
def test_environments_have_pictures_or_text(id: str, where: str) -> None:
    def made(**arguments: Any) -> Any:
        if where == "single":
            return endless_gym.Env(id, **arguments)
        return getattr(endless_gym, where)(id, 1, **arguments)

    has_frames = endless_gym.spec(id).frame is not None
    if has_frames:
        with pytest.raises(ValueError, match=r"^render_mode must be None or one of .*rgb_array.*, got 'ansi'$"):
            made(render_mode="ansi")
    else:
        for observation in ("rgb", "rgb+features"):
            with pytest.raises(ValueError, match=rf'{re.escape(id)} has no frames; use observation="features"'):
                made(observation=observation)
    for mode in ["rgb_array", "debug_rgb_array"] if has_frames else ["rgb_array", "debug_rgb_array", "ansi"]:
        with contextlib.closing(made(render_mode=mode)) as env:
            assert mode in env.metadata["render_modes"] and ("ansi" in env.metadata["render_modes"]) != has_frames
            env.reset(seed=1)
            shown = env.render() if where == "single" else env.render()[0]
        if mode != "ansi":
            assert shown.shape == ((84, 84, 3) if mode == "rgb_array" else (336, 336, 3))
            assert len(np.unique(shown.reshape(-1, 3), axis=0)) > 1
        else:
            assert re.fullmatch(r"\S+ \S+(  \S+ \S+)*", shown)
            assert ("spades" in shown or "hearts" in shown) or "Repeat" not in id
