"""Data sets of demonstrations, read by Minari."""

import json
import os
import pty
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import MEMORY_GYM, rest_of_terminal

import endless_gym
from endless_gym.cli import main as program_main
from endless_gym.recording.command import _parser

pytestmark = [pytest.mark.libraries, pytest.mark.skipif(sys.version_info < (3, 11), reason="Minari needs Python 3.11")]

IDS = MEMORY_GYM


def short(id: str) -> dict[str, Any]:
    """Reset parameters for short episodes."""
    if id.startswith("MortarMayhem"):
        return {"command_count": [2]}
    return {"max_steps": 60} if id.startswith("SearingSpotlights") else {}


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the data sets."""
    folder = tmp_path / "datasets"
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    return folder


def load(dataset: str) -> Any:
    import minari

    return minari.load_dataset(dataset)


def parts(observation: Any) -> dict[str, np.ndarray]:
    return observation if isinstance(observation, dict) else {"": observation}


@pytest.mark.parametrize("id", IDS)
def test_seed_and_actions_reproduce_recorded_episodes(id: str) -> None:
    recorded = endless_gym.record(id, 3, error_rates=[0.0, 0.2], seed=40, options=short(id), max_steps=40)
    dataset = load(recorded.dataset)
    assert (dataset.total_episodes, dataset.total_steps) == (3, recorded.steps)
    metadata = list(dataset.storage.get_episode_metadata(range(3)))
    env = dataset.recover_environment()
    assert env.observation_space == dataset.observation_space
    assert env.action_space == dataset.action_space
    returns = []
    for number, episode in enumerate(dataset):
        assert metadata[number]["seed"] == 40 + number
        assert metadata[number]["error_rate"] == [0.0, 0.2][number % 2]
        assert metadata[number]["total_steps"] == len(episode) <= 40
        options = metadata[number].get("options", {})
        assert {name: np.asarray(value).tolist() for name, value in options.items()} == short(id)
        # One environment replays all episodes: it shows no traces of the previous one, unlike some of the original's.
        observation, info = env.reset(seed=metadata[number]["seed"], options=options)
        for step in range(len(episode) + 1):
            for key, expected in parts(observation).items():
                np.testing.assert_array_equal(parts(episode.observations)[key][step], expected)
            if "ground_truth" in info:
                np.testing.assert_array_equal(episode.infos["ground_truth"][step], info["ground_truth"])
            if step == len(episode):
                break
            observation, reward, terminated, _, info = env.step(episode.actions[step])
            assert (episode.rewards[step], episode.terminations[step]) == (reward, terminated)
            assert episode.truncations[step] == (step == 39 and not terminated)
        assert episode.terminations[-1] or episode.truncations[-1]
        assert not (episode.terminations[:-1] | episode.truncations[:-1]).any()
        returns.append(metadata[number]["return"])
        if terminated:
            final = {name: value for name, value in info.items() if name not in ("reward", "length", "ground_truth")}
            assert metadata[number]["final_info"] == final
            assert returns[-1] == info["reward"]
        else:
            assert "final_info" not in metadata[number]
    assert recorded.mean_return == pytest.approx(np.mean(returns), rel=1e-15)


@pytest.mark.parametrize("id", ["MortarMayhem-Grid-v0", "MortarMayhemB-v0"])
@pytest.mark.parametrize("observation", ["features", "rgb+features"])
def test_recorded_observations_equal_a_vector_environments(id: str, observation: str) -> None:
    frames = endless_gym.Frames(grayscale=True, row_major=True) if "rgb" in observation else None
    options = {"command_count": [2]}
    recorded = endless_gym.record(id, 2, observation=observation, frames=frames, options=options, seed=7)
    dataset = load(recorded.dataset)
    with endless_gym.make_vec(
        id, 2, observation=observation, frames=frames, options=options, autoreset="disabled"
    ) as envs:
        assert dataset.observation_space == envs.single_observation_space
        if frames is None:
            assert dataset.recover_environment().observation_space == dataset.observation_space
        observation, _ = envs.reset(seed=7)
        longest = max(len(episode) for episode in dataset)
        for step in range(longest + 1):
            for env, episode in enumerate(dataset):
                if step > len(episode):
                    continue
                for key, expected in parts(observation).items():
                    np.testing.assert_array_equal(parts(episode.observations)[key][step], expected[env])
                    assert parts(episode.observations)[key].dtype == expected.dtype
            if step < longest:
                actions = [episode.actions[min(step, len(episode) - 1)] for episode in dataset]
                observation, *_ = envs.step(np.stack(actions))


def test_experts_solve_the_task_and_random_play_does_not() -> None:
    options = {"command_count": [3]}
    expert, random = (
        endless_gym.record("MortarMayhem-Grid-v0", 40, policy=policy, observation="features", options=options)
        for policy in ("expert", "random")
    )
    assert expert.dataset.endswith("/expert-v0")
    assert random.dataset.endswith("/random-v0")
    assert expert.mean_return == pytest.approx(0.3)
    assert random.mean_return < 0.1
    finals = [each["final_info"] for each in load(expert.dataset).storage.get_episode_metadata(range(40))]
    assert all(final["success"] == 1 for final in finals)


def test_errors_have_their_rate_and_differ_between_episodes() -> None:
    arguments = {"observation": "features", "max_steps": 300, "options": {"max_steps": 300}}
    ids = [
        endless_gym.record(
            "MysteryPath-v0", 8, policy="random", dataset=f"r-v{seed}", action_seed=seed, **arguments
        ).dataset
        for seed in (0, 1)
    ]
    actions = [np.concatenate([episode.actions for episode in load(dataset)]) for dataset in ids]
    assert not np.array_equal(actions[0][:300], actions[1][:300])
    assert not np.array_equal(actions[0][:300], actions[0][300:600])
    for branch in range(2):
        shares = np.bincount(actions[0][:, branch], minlength=3) / len(actions[0])
        np.testing.assert_allclose(shares, 1 / 3, atol=0.05)


def test_a_recording_does_not_depend_on_threads_or_on_episodes_played_at_the_same_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from endless_gym.recording import recorder

    def contents(dataset: str, threads: int) -> list[Any]:
        recorded = endless_gym.record(
            *("Endless-MortarMayhem-v0", 9),
            error_rates=0.8,
            dataset=dataset,
            num_threads=threads,
            # Even episodes have the first options, odd ones the second.
            options=[{}, {"initial_command_count": 2}],
            max_steps=70,
        )
        return list(load(recorded.dataset))

    at_once = contents("at-once-v0", 1)
    monkeypatch.setattr(recorder, "EPISODES_AT_A_TIME", 2)
    in_pairs = contents("in-pairs-v0", 3)
    assert len({len(episode) for episode in at_once}) > 1
    for one, other in zip(at_once, in_pairs, strict=True):
        np.testing.assert_array_equal(one.observations, other.observations)
        np.testing.assert_array_equal(one.actions, other.actions)


def test_long_episodes_have_many_chunks() -> None:
    recorded = endless_gym.record("Endless-MortarMayhem-v0", 2, max_steps=150)
    import h5py

    with h5py.File(recorded.path / "data" / "main_data.hdf5") as file:
        frames = file["episode_0/observations"]
        assert frames.shape == (151, 84, 84, 3)
        assert frames.chunks[0] < 75
        assert frames.id.get_storage_size() < frames.nbytes / 10


def test_minari_adds_to_a_data_set_and_splits_and_filters_it() -> None:
    import minari
    from minari.data_collector import EpisodeBuffer

    recorded = endless_gym.record("MysteryPath-Grid-v0", 4, author="A. Nonymous")
    dataset = load(recorded.dataset)
    metadata = dataset.storage.metadata
    assert metadata["algorithm_name"] == "scripted expert"
    assert metadata["author"] == {"A. Nonymous"}
    assert metadata["endless_gym_version"] == endless_gym.__version__
    assert recorded.dataset in minari.list_local_datasets()
    assert len(dataset.filter_episodes(lambda episode: episode.rewards.sum() > 0)) == 4
    assert [len(part) for part in minari.split_dataset(dataset, [1, 3])] == [1, 3]
    first = dataset[0]
    lists = {
        name: getattr(first, name) for name in ("observations", "actions", "rewards", "terminations", "truncations")
    }
    dataset.update_dataset_from_buffer([EpisodeBuffer(seed=99, infos={}, **lists)])
    assert len(load(recorded.dataset)) == 5
    np.testing.assert_array_equal(load(recorded.dataset)[4].observations, first.observations)


def test_an_existing_data_set_is_kept_or_replaced(root: Path) -> None:
    arguments = {"observation": "features", "dataset": "mine/path-v3", "options": {"max_steps": 9}}
    endless_gym.record("MysteryPath-Grid-v0", 2, **arguments)
    with pytest.raises(FileExistsError, match="mine/path-v3 exists"):
        endless_gym.record("MysteryPath-Grid-v0", 3, **arguments)
    assert len(load("mine/path-v3")) == 2
    endless_gym.record("MysteryPath-Grid-v0", 3, overwrite=True, **arguments)
    assert len(load("mine/path-v3")) == 3
    # A folder that is not a data set is never replaced.
    with pytest.raises(FileExistsError, match="not a data set"):
        (root / "mine-v0").mkdir()
        endless_gym.record("MysteryPath-Grid-v0", 3, overwrite=True, **{**arguments, "dataset": "mine-v0"})
    assert [path for path in os.listdir(root) if path.startswith(".")] == []


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"id": "MortarMayhem"}, ValueError, "id must be one of"),
        ({"episodes": 0}, ValueError, "episodes must be 1 to"),
        ({"policy": "best"}, ValueError, "policy must be expert, random"),
        ({"error_rates": [0.1, 1.5]}, ValueError, "error_rates must be numbers from 0 to 1"),
        ({"error_rates": []}, ValueError, "error_rates"),
        ({"options": {"arena_size": 77}}, ValueError, "arena_size"),
        ({"options": []}, ValueError, "at least one"),
        ({"observation": "pixels"}, ValueError, "observation must be one of"),
        ({"max_steps": 0}, ValueError, "max_steps must be 1"),
        ({"dataset": "no-version"}, ValueError, "got 'no-version': its version is missing: no-version-v0$"),
        ({"dataset": "../above-v0"}, ValueError, "letters, digits, `-`, `_` and `/`, not '.'"),
        ({"dataset": "my data-v0"}, ValueError, "not ' '$"),
        ({"dataset": "mine//a-v0"}, ValueError, "between its `/` must be names"),
        ({"dataset": "m/a-v0"}, ValueError, "nor its namespace shorter than 2 characters"),
        ({"dataset": "-v0"}, ValueError, "its name must not be empty"),
        ({"num_threads": -1}, ValueError, "num_threads"),
    ],
)
def test_wrong_arguments_write_nothing(
    root: Path, arguments: dict[str, Any], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        endless_gym.record(**{"id": "MortarMayhem-Grid-v0", "episodes": 1, **arguments})
    assert not root.exists() or os.listdir(root) == []


def test_an_error_while_playing_leaves_nothing(root: Path) -> None:
    class Broken:
        name, observation = "broken", None

        def actor(self, num_envs: int, first_episode: int) -> Any:
            raise OverflowError("broken")

    threads = threading.active_count()
    with pytest.raises(OverflowError, match="broken"):
        endless_gym.record("MortarMayhem-Grid-v0", 500, policy=Broken())
    assert os.listdir(root) == []
    assert threading.active_count() == threads


def record(*arguments: str, **given: Any) -> subprocess.Popen:
    command = [Path(sys.executable).parent / "endless", "record", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **given)


def test_the_program_records(root: Path) -> None:
    arguments = "MortarMayhem-Grid-v0 --episodes 5 --error-rate 0 0.5 --option command_count=[2] --observation features"
    process = record(*arguments.split(), "--name", "my/path-v1", "--json")
    output, errors = process.communicate(timeout=120)
    assert (process.returncode, errors) == (0, "")
    result = json.loads(output)
    assert (result["dataset"], result["episodes"]) == ("my/path-v1", 5)
    assert result["path"] == str(root / "my/path-v1")
    dataset = load("my/path-v1")
    assert dataset.total_steps == result["steps"]
    assert dataset.recover_environment().reset(seed=0)[0].shape == dataset[0].observations[0].shape
    process = record(*arguments.split(), "--name", "my/path-v1")
    output, errors = process.communicate(timeout=120)
    assert (process.returncode, output) == (1, "")
    assert errors.startswith("endless record: the data set my/path-v1 exists")
    assert errors.count("\n") == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_leaves_no_data_set(root: Path, number: signal.Signals) -> None:
    leader, follower = pty.openpty()
    command = [Path(sys.executable).parent / "endless", "record", "Endless-MortarMayhem-v0", "--episodes", "100000"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=follower, text=True)
    os.close(follower)
    shown = b""
    # The progress bar appears before the first episode is written.
    while b"/100000" not in shown or not any(root.glob(".recording-*")):
        shown += os.read(leader, 4096)
    process.send_signal(number)
    shown += rest_of_terminal(leader)
    assert process.communicate(timeout=60)[0] == ""
    assert process.returncode == 130
    assert shown.endswith(b"endless record: stopped, and wrote nothing\r\n")
    assert os.listdir(root) == []


def test_other_commands_run_in_the_native_program(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["endless", "--log", "off", "record", "MysteryPath-v0"])
    assert program_main() == 1
    assert "first argument" in capfd.readouterr().err
    monkeypatch.setattr(sys, "argv", ["endless", "list"])
    assert program_main() == 0
    assert "MysteryPath-v0" in capfd.readouterr().out


def test_experts_check_their_arguments() -> None:
    experts = endless_gym.Experts("MortarMayhemB-Grid-v0", 2)
    features, vectors = np.zeros((2, 17), dtype=np.float32), np.zeros((2, 180), dtype=np.float32)
    flags = np.ones(2, dtype=bool)
    with pytest.raises(ValueError, match="must have features and vector_observation, got features"):
        experts.act(features, flags)
    with pytest.raises(ValueError, match=r"features must have the shape \(2, 17\), got \(2, 3\)"):
        experts.act({"features": features[:, :3], "vector_observation": vectors}, flags)
    good = {"features": features, "vector_observation": vectors}
    with pytest.raises(ValueError, match=r"episode_start must be a bool array of shape \(2,\), got float64"):
        experts.act(good, np.ones(2))
    with pytest.raises(ValueError, match="active must be a bool array"):
        experts.act(good, flags, flags[:1])
    with pytest.raises(ValueError, match="num_envs must be 1 to"):
        endless_gym.Experts("MortarMayhem-v0", 0)


def test_the_values_of_a_repeated_flag_accumulate() -> None:
    repeated = "MortarMayhem-v0 --error-rate 0 0.1 --error-rate 0.2 --option a=1 --option b=2"
    given = _parser().parse_args(repeated.split())
    assert (given.error_rates, given.option) == ([0.0, 0.1, 0.2], ["a=1", "b=2"])
