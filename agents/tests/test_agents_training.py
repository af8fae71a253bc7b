"""Complete training runs: exact resumption, interruption, logs, and learning with and without memory."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import wandb
from agents_helpers import ALL_HEADS, GRID, assert_equal_runs, changed, collecting, progress, same, settings, small
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from endless_gym import make_vec
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.environments.groups import Environments
from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.settings import PRESETS, VECTORS, Settings
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.ppo import learn, make_optimizer
from endless_gym_agents.training.train import check_resumable, choose_device, parse, restore_generator, train


@pytest.mark.parametrize("agent", ["none", "position", "stack", "gru", "lstm", "trxl", "gtrxl"])
def test_forward_equals_the_rollout_with_the_same_weights(agent: str, tmp_path: Path) -> None:
    """Log-probabilities and values of two segments equal those of the rollout; the agent learns in between."""
    given = small(agent, tmp_path)
    with collecting(given) as collector:
        made = collector.agent
        optimizer, shuffle = make_optimizer(made, 0.01), torch.Generator().manual_seed(1)
        for _ in range(2):
            segment, _ = collector.collect(Clock())
            flat, states = segment.flat(), [memory.state for memory in collector.memories]
            for minibatch in made.memory.minibatches(states, segment.reset_mask, 2, torch.Generator().manual_seed(1)):
                output = made({key: part[minibatch.indices] for key, part in flat.observation.items()}, minibatch)
                log_prob = output.log_prob(flat.action[minibatch.indices])
                torch.testing.assert_close(log_prob, flat.log_prob[minibatch.indices], rtol=1e-5, atol=1e-5)
                torch.testing.assert_close(output.value, flat.value[minibatch.indices], rtol=1e-5, atol=1e-5)
            learn(made, optimizer, segment, states, 0, replace(given.ppo, learning_rate=0.01), shuffle)


@pytest.mark.parametrize(
    ("agent", "first", "second", "changes"),
    [
        *((agent, "thread", "thread", {}) for agent in ("position", "stack", "gru", "lstm", "trxl")),
        *(("gru", "process", engine, {}) for engine in ("process", "thread")),
        ("gru", "thread", "process", {}),
        ("gru", "thread", "thread", ALL_HEADS),
        ("gru", "thread", "thread", {"environment": {"num_threads": 3}}),
    ],
)
def test_resumed_run_equals_an_uninterrupted_run(
    agent: str, first: str, second: str, changes: dict[str, Any], tmp_path: Path, undisturbed: Path
) -> None:
    """Also with other engines and numbers of threads."""

    def given(run: Path, updates: int, engine: str) -> Settings:
        return changed(small(agent, run, updates, engine=engine), **changes)

    is_other = changes == ALL_HEADS or agent != "gru"
    through = train(given(tmp_path / "through", 4, "thread")) if is_other else undisturbed
    halved = train(given(tmp_path / "halved", 2, first))
    train(replace(given(tmp_path, 4, second), resume=str(halved)))
    assert len(progress(through)) == 4
    assert_equal_runs(halved, through)


def test_a_function_chooses_the_options_of_training_episodes(tmp_path: Path) -> None:
    calls: list[tuple[int, int, dict[str, Any] | None]] = []

    def choose(env: int, episode: int, final: dict[str, Any] | None) -> dict[str, Any]:
        calls.append((env, episode, final))
        return {"command_count": [1 + episode % 2]}

    given = small("none", tmp_path / "run")
    train(given, episode_options=choose)
    assert {env for env, _, _ in calls} == set(range(given.environment.num_envs))
    chosen = [(episode, final["options"]) for _, episode, final in calls if final is not None]
    assert chosen
    assert all(options == {"command_count": [1 + episode % 2]} for episode, options in chosen)
    with pytest.raises(ValueError, match=r"--environment\.engine must be thread, got process"):
        Environments(small("none", tmp_path / "other", engine="process"), choose)


def test_kept_checkpoints_can_be_loaded(tmp_path: Path) -> None:
    given = replace(small("trxl", tmp_path / "run", 4), keep_checkpoints=True)
    run = train(given)
    files = checkpoint.files(run)
    assert [file.name for file in files] == ["update-000000.pt", "update-000002.pt", "update-000004.pt"]
    loaded = checkpoint.load(files[1])
    assert (loaded.update, loaded.steps, loaded.settings) == (2, 2 * 8 * 16, given)
    assert same(checkpoint.load(run).agent.state_dict(), checkpoint.load(files[2]).agent.state_dict())
    memory = loaded.agent.initial_memory(3)
    output = loaded.agent.act(torch.zeros(3, 17).numpy(), memory)
    assert output.action.shape == (3, 1)


def test_run_can_be_resumed_from_update_0(tmp_path: Path) -> None:
    """Update 0 is the last checkpoint if the first update was interrupted."""
    run = train(replace(small("gru", tmp_path / "run", 2), time_limit=1e-9, keep_checkpoints=True))
    assert len(progress(run)) == 1
    (run / "checkpoints" / "last.pt").unlink()
    os.link(run / "checkpoints" / "update-000000.pt", run / "checkpoints" / "last.pt")
    # TensorBoard orders its files by their names, which contain the second and a number.
    time.sleep(1 - time.time() % 1)
    train(parse(["--resume", str(run)]))
    assert progress(run) == progress(train(small("gru", tmp_path / "through", 2)))
    board = EventAccumulator(str(run)).Reload()
    assert [event.step for event in board.Scalars("update")] == [128, 256]


def test_a_gpu_has_an_index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """`torch.cuda.set_device`, which training calls, refuses a device without one."""

    def set_device(device: torch.device) -> None:
        assert device.index == 0
        raise KeyboardInterrupt

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", set_device)
    for name in ("auto", "cuda", "cuda:0"):
        assert choose_device(name) == torch.device("cuda", 0)
        with pytest.raises(KeyboardInterrupt):
            train(replace(small("gru", tmp_path / "run"), device=name))
    assert choose_device("cuda:1") == torch.device("cuda", 1)
    with pytest.raises(ValueError, match="the index must be 0 to 1"):
        choose_device("cuda:2")


def test_generator_state_of_another_device_is_replaced_by_a_seed() -> None:
    """The state of a CUDA generator has 16 bytes."""
    one, two = torch.Generator(), torch.Generator()
    restore_generator(one, torch.zeros(16, dtype=torch.uint8), 5)
    assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=two.manual_seed(5)))
    restore_generator(one, two.get_state(), 6)
    assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=two))


def test_target_reward_needs_a_hundred_episodes(tmp_path: Path) -> None:
    run = train(replace(small("none", tmp_path / "run", 40), target_reward=-1.0))
    ended = len(checkpoint.load(run).state["episodes"])
    assert ended == 100 and 1 < len(progress(run)) < 40


@pytest.mark.parametrize("engine", ["thread", "process"])
def test_segment_contains_the_steps_of_the_environments(engine: str, tmp_path: Path) -> None:
    """Eight segments, against environments with the same seeds that are stepped in a plain loop."""
    given = small("none", tmp_path, engine=engine, option=())
    given = changed(given, env="Endless-MortarMayhem-v0", ppo={"ground_truth_coefficient": 0.1})
    plain = make_vec(
        given.env, 4, 1, seed=1, seeds=range(100_000), groups=2, autoreset="same_step", observation="features"
    )
    now = [plain.reset(group=group) for group in range(2)]
    reset_mask = [np.ones(4, np.bool_) for _ in range(2)]
    with collecting(given) as collector:
        for _ in range(8):
            segment, episodes = collector.collect(Clock())
            ended = []
            for step in range(16):
                for group, columns in enumerate((slice(0, 4), slice(4, 8))):
                    observation, info = now[group]
                    np.testing.assert_array_equal(segment.observation["features"][step, columns], observation)
                    truth = torch.tensor(info["ground_truth"]).float()
                    assert torch.equal(segment.ground_truth[step, columns], truth)
                    np.testing.assert_array_equal(segment.reset_mask[step, columns], reset_mask[group])
                    plain.send(segment.action[step, columns].numpy(), group)
                    observation, reward, terminated, truncated, info = plain.recv(group)
                    now[group], reset_mask[group] = (observation, info), terminated | truncated
                    np.testing.assert_array_equal(segment.reward[step, columns], reward.astype(np.float32))
                    np.testing.assert_array_equal(segment.done[step, columns], reset_mask[group])
                    ended += [float(info["final_info"]["reward"][env]) for env in np.flatnonzero(reset_mask[group])]
            assert sorted(episode["reward"] for episode in episodes) == sorted(ended)
        assert segment.done.any()


def test_resumed_run_keeps_its_settings(tmp_path: Path) -> None:
    run = train(small("gru", tmp_path / "run", 2))
    resumed = parse(["--resume", str(run), "--ppo.updates", "3"])
    assert resumed.ppo == replace(small("gru", run, 2).ppo, updates=3)
    train(resumed)
    assert len(progress(run)) == 3
    # Changed settings persist; the step count continues.
    again = parse(["--resume", str(run)])
    assert again.ppo == resumed.ppo
    train(changed(again, ppo={"updates": 4, "steps": 32}))
    assert [row["steps"] for row in progress(run)] == [128, 256, 384, 384 + 256]
    with pytest.raises(ValueError, match=r"reconstruction-coefficient must stay positive \(it was 0\.1\), got 0;"):
        check_resumable(again, changed(again, ppo={"reconstruction_coefficient": 0.1}))
    with pytest.raises(ValueError, match="must keep its agent: expected gru, got lstm"):
        train(parse(["--resume", str(run), "--agent", "lstm"]))
    with pytest.raises(ValueError, match="must keep its seed: expected 1, got 2"):
        train(parse(["--resume", str(run), "--seed", "2"]))
    assert parse(["--resume", str(run)]).ppo.steps == 32
    with pytest.raises(FileExistsError, match="already contains a run"):
        train(small("gru", run, 2))


def test_tensorboard_files_contain_the_metrics(undisturbed: Path) -> None:
    run, board = undisturbed, EventAccumulator(str(undisturbed)).Reload()
    losses = [event.value for event in board.Scalars("learning/policy_loss")]
    assert losses == pytest.approx([row["policy_loss"] for row in progress(run)], rel=1e-5)
    assert [event.step for event in board.Scalars("learning/policy_loss")] == [row["steps"] for row in progress(run)]
    names = {"episode/reward", "episode/task_progress", "seconds/stepping", "seconds/inference", "seconds/learning"}
    assert names <= set(board.Tags()["scalars"])


def test_total_steps_set_the_length_and_each_line_has_the_time_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(replace(small("none", tmp_path / "run", 99), total_steps=300))
    assert [row["steps"] for row in progress(run)] == [128, 256, 384]
    train(parse(["--resume", str(run), "--total-steps", "500"]))
    assert [row["steps"] for row in progress(run)] == [128, 256, 384, 512]
    lines = [line for line in capsys.readouterr().out.splitlines() if "steps" in line and "/s" in line]
    assert len(lines) == 4 and all("seconds left" in line for line in lines)


def test_a_long_run_says_so_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = replace(small("none", tmp_path / "run"), total_steps=10**12, time_limit=1e-4)
    train(given)
    assert capsys.readouterr().out.count("at this speed the run takes ") == 1


def test_a_run_starts_from_the_weights_of_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = train(small("gru", tmp_path / "first", 2))
    given = replace(small("gru", tmp_path / "second", 1, option=("command_count=[3]",)), init_from=str(first))
    given = replace(given, keep_checkpoints=True)
    second = train(given)
    start = checkpoint.load(checkpoint.files(second)[0])
    assert start.update == 0 and checkpoint.read_settings(second).init_from == str(first)
    assert same(start.agent.state_dict(), checkpoint.load(first).agent.state_dict())
    # Other actions: the policy's output layer is new.
    other = changed(
        replace(given, env="Endless-MortarMayhem-v0", run=str(tmp_path / "third")), environment={"option": ()}
    )
    third = train(other)
    assert "newly initialised: policy" in capsys.readouterr().out
    one, two = (checkpoint.load(checkpoint.files(run)[0]).agent for run in (second, third))
    assert torch.equal(one.memory.recurrent.weight_hh_l0, two.memory.recurrent.weight_hh_l0)
    other = replace(given, agent="none", run=str(tmp_path / "fourth"))
    with pytest.raises(ValueError, match=r"its body\.0\.bias, body\.0\.weight do not fit"):
        train(changed(other, recurrence={"hidden_size": 5}, model={"vector_width": 3, "head_width": 3}))


def test_weights_and_biases_logs_contain_the_metrics_under_one_id(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written by the real library in offline mode; a resumed run keeps its id."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    run = train(replace(small("gru", tmp_path / "run", 1), wandb=True))
    train(replace(small("gru", tmp_path, 2), wandb=True, resume=str(run)))
    # `finish` can return before the file is written; the end of the library's process flushes it.
    wandb.teardown()
    (id,) = {file.stem.removeprefix("run-") for file in run.glob("wandb/offline-run-*/run-*.wandb")}
    assert id == (run / "wandb-id.txt").read_text()
    written = b"".join(file.read_bytes() for file in run.glob("wandb/offline-run-*/run-*.wandb"))
    for row in progress(run):
        assert json.dumps(row["policy_loss"]).encode() in written
    assert b"episode/reward" in written and b"decay_updates" in written


@pytest.mark.timeout(600)
def test_a_transformer_learns_a_command_that_is_shown_and_hidden(tmp_path: Path) -> None:
    """As a GRU does in `test_agents_example.py`."""
    given = replace(PRESETS["quick"], env=GRID, agent="trxl", run=str(tmp_path / "run"), threads=1, target_reward=0.097)
    given = changed(given, environment={"option": ("command_count=[1]",)}, ppo={"updates": 200})
    trained = checkpoint.load(train(given))
    assert mean(evaluate(trained.agent, num_threads=1)) >= 0.085


@pytest.mark.parametrize(
    ("agent", "env"),
    [
        ("gru", "popgym-MultiarmedBanditEasy-v0"),
        ("trxl", "popgym-MultiarmedBanditEasy-v0"),
        ("gru", "popgym-BattleshipEasy-v0"),
    ],
)
def test_bootstrapping_adds_the_value_of_the_last_observation_at_time_limits(agent: str, env: str) -> None:
    """Against episodes played one after another, with the values of their last observations."""
    given = changed(settings(agent, env=env), environment={"num_envs": 3, "wrapper": (VECTORS,)}, ppo={"steps": 256})
    plain, bootstrapped = (changed(given, ppo={"bootstrap_truncated": is_on}) for is_on in (False, True))
    with collecting(plain) as collector:
        expected = collector.collect(Clock())[0]
        rewards = expected.reward.clone()
    with collecting(bootstrapped) as collector, Environments(given) as environments:
        segment, made = collector.collect(Clock())[0], collector.agent
        for name in ("value", "action", "done", "log_prob", "last_value"):
            assert torch.equal(getattr(segment, name), getattr(expected, name)), name
        memories = [made.initial_memory(1) for _ in range(3)]
        environments.reset(0)
        ends = 0
        for step in range(256):
            for number, memory in enumerate(memories):
                made.act({key: part[step, number : number + 1] for key, part in segment.observation.items()}, memory)
            environments.send(segment.action[step].numpy(), 0)
            result = environments.receive(0)
            for number in np.flatnonzero(result.truncated):
                assert result.final is not None
                value = made.act({"features": result.final[number][None]}, memories[number]).value
                rewards[step, number] += given.ppo.gamma * float(value)
                ends += 1
            for number in np.flatnonzero(result.done):
                memories[number] = made.initial_memory(1)
        assert ends >= 3
    torch.testing.assert_close(segment.reward, rewards, rtol=1e-5, atol=1e-5)
    assert not torch.equal(segment.reward, expected.reward)
