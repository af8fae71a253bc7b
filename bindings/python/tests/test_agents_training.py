"""Whole runs: they resume exactly, stop cleanly, and learn; memory matters."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from agents_helpers import settings
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from endless_gym import make_vec, spec
from endless_gym.agents import checkpoint
from endless_gym.agents.agent import make_agent
from endless_gym.agents.clock import Clock
from endless_gym.agents.environments import Environments
from endless_gym.agents.evaluate import evaluate, mean
from endless_gym.agents.rollout import Player
from endless_gym.agents.settings import PRESETS, Settings
from endless_gym.agents.train import go_on_drawing, main, parse, same_network, train

GRID = "MortarMayhem-Grid-v0"


def small(agent: str, run: Path, updates: int = 4, **environment: Any) -> Settings:
    given = settings(agent, env=GRID, run=str(run), checkpoint_interval=2, threads=1)
    return replace(
        given,
        environment=replace(given.environment, num_envs=8, option=("command_count=[1, 2]",), **environment),
        ppo=replace(given.ppo, steps=16, minibatches=2, updates=updates),
    )


def progress(run: Path) -> list[dict[str, Any]]:
    """The measures of all updates, without the times that they took."""
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("seconds/") and k != "steps_per_second"} for row in rows]


def same(one: Any, two: Any) -> bool:
    """Whether two checkpoints' contents are equal, to the last bit."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, two)
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(two) and all(map(same, one, two))
    return bool(one == two)


@pytest.mark.parametrize("agent", ["none", "position", "stack", "gru", "lstm", "trxl", "gtrxl"])
def test_nothing_has_changed_before_the_first_step_of_learning(agent: str, tmp_path: Path) -> None:
    """What the network says of two played segments is what it said while it played them."""
    given = small(agent, tmp_path)
    with Environments(given) as environments:
        torch.manual_seed(1)
        made = make_agent(given, environments.spec)
        player = Player(made, environments, given.ppo.steps, torch.Generator().manual_seed(1))
        for _ in range(2):
            segment, _ = player.play(Clock())
            flat, states = segment.flat(), [memory.state for memory in player.memories]
            for plan in made.memory.plan(states, segment.first, 2, torch.Generator().manual_seed(1)):
                evaluated = made.evaluate({key: part[plan.steps] for key, part in flat.observation.items()}, plan)
                log_prob = evaluated.log_prob(flat.action[plan.steps])
                torch.testing.assert_close(log_prob, flat.log_prob[plan.steps], rtol=1e-5, atol=1e-5)
                torch.testing.assert_close(evaluated.value, flat.value[plan.steps], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("agent", ["none", "position", "stack", "gru", "lstm", "trxl", "gtrxl"])
def test_a_resumed_run_is_the_run_that_never_stopped(agent: str, tmp_path: Path) -> None:
    through = train(small(agent, tmp_path / "through", 4))
    halved = train(small(agent, tmp_path / "halved", 2))
    train(replace(small(agent, tmp_path, 4), resume=str(halved)))
    assert len(progress(through)) == 4
    assert progress(halved) == progress(through)
    one, two = (checkpoint.load(run).state for run in (through, halved))
    for part in ("update", "model", "optimizer", "generators", "player", "episodes"):
        assert same(one[part], two[part]), part


def test_resumed_from_frames_with_all_heads(tmp_path: Path) -> None:
    def given(run: Path, updates: int) -> Settings:
        made = small("gru", run, updates)
        return replace(
            made,
            env="Endless-MortarMayhem-v0",
            environment=replace(made.environment, option=(), observation="rgb"),
            ppo=replace(made.ppo, reconstruction_coefficient=0.1, ground_truth_coefficient=0.1),
        )

    through = train(given(tmp_path / "through", 2))
    halved = train(given(tmp_path / "halved", 1))
    train(replace(given(tmp_path, 2), resume=str(halved)))
    assert progress(halved) == progress(through)
    assert {"reconstruction_loss", "ground_truth_loss"} <= progress(through)[0].keys()
    assert same(checkpoint.load(through).state["model"], checkpoint.load(halved).state["model"])


@pytest.mark.parametrize(
    "flags",
    [
        "--env MortarMayhemB-Grid-v0 --agent gru --environment.observation rgb",
        "--env MortarMayhemB-v0 --agent stack --environment.observation rgb --model.stack 2",
        "--env MortarMayhemB-v0 --agent trxl",
        "--env MysteryPath-Grid-v0 --agent gtrxl --transformer.gate-bias 2",
        "--env Endless-SearingSpotlights-v0 --agent trxl --ppo.ground-truth-coefficient 0.1",
        "--env Endless-MysteryPath-v0 --agent position",
    ],
)
def test_observations_and_actions_of_all_kinds(flags: str, tmp_path: Path) -> None:
    """Frames, features, vectors beside both; one branch and two; an update changes each head that there is."""
    small_run = "--preset quick --environment.num-envs 4 --ppo.steps 32 --ppo.updates 1 --threads 1"
    given = parse([*flags.split(), *small_run.split(), "--run", str(tmp_path / "run"), "--ppo.learning-rate", "0.01"])
    torch.manual_seed(given.seed)
    before = make_agent(given, spec(given.env)).state_dict()
    after = checkpoint.load(train(given)).agent.state_dict()
    assert before.keys() == after.keys()
    assert all(not torch.equal(before[name], after[name]) for name in before if name.endswith("weight"))


def test_what_is_written_beyond_the_checkpoint_is_written_anew(tmp_path: Path) -> None:
    """A run that was killed between two checkpoints goes on from the last one."""
    run = train(small("gru", tmp_path / "run", 2))
    expected = progress(train(small("gru", tmp_path / "through", 4)))
    with (run / "progress.jsonl").open("a") as file:
        file.write(json.dumps({"update": 3, "loss": 1.0}) + '\n{"update": 4, "lo')
    train(replace(small("gru", tmp_path, 4), resume=str(run)))
    assert progress(run) == expected


def test_groups_and_threads_change_nothing_that_is_random(tmp_path: Path) -> None:
    """The engine's threads do not change a run; its process and this process give the same one."""
    runs = {
        "one": train(small("gru", tmp_path / "one", 3)),
        "threads": train(small("gru", tmp_path / "threads", 3, num_threads=3)),
        "process": train(small("gru", tmp_path / "process", 3, engine="process")),
    }
    assert progress(runs["one"]) == progress(runs["threads"]) == progress(runs["process"])


@pytest.mark.parametrize("engines", [("process", "process"), ("process", "thread"), ("thread", "process")])
def test_a_run_resumes_exactly_wherever_its_environments_are(engines: tuple[str, str], tmp_path: Path) -> None:
    through = train(small("gru", tmp_path / "through", 4))
    run = train(small("gru", tmp_path / "run", 2, engine=engines[0]))
    train(replace(small("gru", tmp_path, 4, engine=engines[1]), resume=str(run)))
    assert progress(run) == progress(through)
    assert same(checkpoint.load(run).state["player"], checkpoint.load(through).state["player"])


@pytest.mark.parametrize("engine", ["thread", "process"])
def test_ctrl_c_writes_a_checkpoint_and_leaves_nothing(
    engine: str, tmp_path: Path, segments: Callable[[], set[str]]
) -> None:
    run = tmp_path / "run"
    before = segments()
    arguments = f"--env {GRID} --agent gru --preset quick --run {run} --threads 1 --environment.engine {engine}"
    process = subprocess.Popen(
        [sys.executable, "-m", "endless_gym.agents.train", *arguments.split()],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    end = time.monotonic() + 120
    while not (run / "progress.jsonl").exists() or not (run / "progress.jsonl").read_text():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert "stopping after this update" in output
    done = checkpoint.load(run).update
    assert 1 <= done < 2000
    assert f"{done} of 2000 updates are done" in output
    assert len(progress(run)) == done
    assert segments() <= before


def test_checkpoints_are_kept_and_act(tmp_path: Path) -> None:
    given = replace(small("trxl", tmp_path / "run", 4), keep_checkpoints=True)
    run = train(given)
    files = checkpoint.files(run)
    assert [file.name for file in files] == ["update-000000.pt", "update-000002.pt", "update-000004.pt"]
    loaded = checkpoint.load(files[1])
    assert (loaded.update, loaded.steps, loaded.settings) == (2, 2 * 8 * 16, given)
    assert same(checkpoint.load(run).agent.state_dict(), checkpoint.load(files[2]).agent.state_dict())
    memory = loaded.agent.initial_memory(3)
    acted = loaded.agent.act(torch.zeros(3, 17).numpy(), memory)
    assert acted.action.shape == (3, 1)


def test_a_run_that_has_not_learned_yet_can_go_on(tmp_path: Path) -> None:
    """As after Ctrl-C in its first update."""
    run = train(replace(small("gru", tmp_path / "run", 2), time_limit=1e-9, keep_checkpoints=True))
    assert len(progress(run)) == 1
    (run / "checkpoints" / "last.pt").unlink()
    os.link(run / "checkpoints" / "update-000000.pt", run / "checkpoints" / "last.pt")
    train(parse(["--resume", str(run)]))
    assert progress(run) == progress(train(small("gru", tmp_path / "through", 2)))
    board = EventAccumulator(str(run))
    board.Reload()
    assert [event.step for event in board.Scalars("steps")] == [1, 2]


def test_a_generator_of_another_kind_of_device_starts_anew() -> None:
    """A state of CUDA's generator has 16 bytes."""
    one, two = torch.Generator(), torch.Generator()
    go_on_drawing(one, torch.zeros(16, dtype=torch.uint8), 5)
    assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=two.manual_seed(5)))
    go_on_drawing(one, two.get_state(), 6)
    assert torch.equal(torch.rand(3, generator=one), torch.rand(3, generator=two))


def test_a_target_is_of_a_hundred_episodes(tmp_path: Path) -> None:
    run = train(replace(small("none", tmp_path / "run", 40), target_reward=-1.0))
    ended = len(checkpoint.load(run).state["episodes"])
    assert ended == 100 and 1 < len(progress(run)) < 40


@pytest.mark.parametrize("engine", ["thread", "process"])
def test_a_segment_is_what_the_environments_did(engine: str, tmp_path: Path) -> None:
    """What four segments hold of the environments, against others that are stepped one group at a time in a plain loop."""
    given = small("none", tmp_path, engine=engine)
    ppo = replace(given.ppo, ground_truth_coefficient=0.1)
    given = replace(given, env="Endless-MortarMayhem-v0", ppo=ppo, environment=replace(given.environment, option=()))
    plain = make_vec(
        given.env, 4, 1, seed=1, seeds=range(100_000), groups=2, autoreset="same_step", observation="features"
    )
    now = [plain.reset(group=group) for group in range(2)]
    first = [np.ones(4, np.bool_) for _ in range(2)]
    with Environments(given) as environments:
        player = Player(make_agent(given, environments.spec), environments, 16, torch.Generator().manual_seed(1))
        for _ in range(4):
            segment, episodes = player.play(Clock())
            ended = []
            for step in range(16):
                for group, columns in enumerate((slice(0, 4), slice(4, 8))):
                    observation, info = now[group]
                    np.testing.assert_array_equal(segment.observation["features"][step, columns], observation)
                    truth = torch.tensor(info["ground_truth"]).float()
                    assert torch.equal(segment.ground_truth[step, columns], truth)
                    np.testing.assert_array_equal(segment.first[step, columns], first[group])
                    plain.send(segment.action[step, columns].numpy(), group)
                    observation, reward, terminated, truncated, info = plain.recv(group)
                    now[group], first[group] = (observation, info), terminated | truncated
                    np.testing.assert_array_equal(segment.reward[step, columns], reward.astype(np.float32))
                    np.testing.assert_array_equal(segment.done[step, columns], first[group])
                    ended += [float(info["final_info"]["reward"][env]) for env in np.flatnonzero(first[group])]
            assert sorted(episode["reward"] for episode in episodes) == sorted(ended)
        assert segment.done.any()


def test_evaluation_plays_each_seed_as_often(tmp_path: Path) -> None:
    agent = checkpoint.load(train(small("gru", tmp_path / "run", 1))).agent
    results = evaluate(agent, range(200_000, 200_007), 3, num_threads=1)
    assert [result["seed"] for result in results] == list(range(200_000, 200_007)) * 3
    assert all(result["length"] > 0 for result in results)
    assert mean(results) == pytest.approx(sum(result["reward"] for result in results) / 21)
    # Draws differ between the repetitions of a seed; the seed of the draws makes them the same again.
    assert results == evaluate(agent, range(200_000, 200_007), 3, num_threads=1)
    assert results != evaluate(agent, range(200_000, 200_007), 3, num_threads=1, draws=1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env NoSuch-v0", "no environment `NoSuch-v0`; there are "),
        (f"--env {GRID} --device nonsense", "no device `nonsense`; give auto, cpu, cuda or cuda:NUMBER"),
        (f"--env {GRID} --ppo.epochs 0", "--ppo.epochs is 0; give 1 or more"),
        ("--resume nowhere", "no run in nowhere; give a folder with settings.json"),
        (f"--env {GRID} --environment.option command_count=[1] colour=1", "colour"),
        (f"--env {GRID} --environment.option colour=1 --environment.engine process", "colour"),
    ],
)
def test_errors_are_one_line(
    arguments: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["endless-train", *arguments.split()])
    assert main() == 1
    error = capsys.readouterr().err
    assert error.startswith("endless-train: ")
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.rglob("settings.json")), "the same folder can be given again"


def test_a_run_goes_on_with_its_own_settings(tmp_path: Path) -> None:
    run = train(small("gru", tmp_path / "run", 2))
    resumed = parse(["--resume", str(run), "--ppo.updates", "3"])
    assert resumed.ppo == replace(small("gru", run, 2).ppo, updates=3)
    train(resumed)
    assert len(progress(run)) == 3
    # What was changed holds from then on; steps that were played stay played.
    again = parse(["--resume", str(run)])
    assert again.ppo == resumed.ppo
    train(replace(again, ppo=replace(again.ppo, updates=4, steps=32)))
    assert [row["steps"] for row in progress(run)] == [128, 256, 384, 384 + 256]
    with pytest.raises(ValueError, match=r"reconstruction-coefficient 0 adds or takes away a head.* began with 0\.1"):
        same_network(again, replace(again, ppo=replace(again.ppo, reconstruction_coefficient=0.1)))
    with pytest.raises(ValueError, match="began with agent gru, not lstm"):
        train(parse(["--resume", str(run), "--agent", "lstm"]))
    with pytest.raises(ValueError, match="began with seed 1, not 2"):
        train(parse(["--resume", str(run), "--seed", "2"]))
    assert parse(["--resume", str(run)]).ppo.steps == 32
    with pytest.raises(FileExistsError, match="has a run already"):
        train(small("gru", run, 2))


def test_tensorboard_s_files_have_the_measures(tmp_path: Path) -> None:
    run = train(small("gru", tmp_path / "run", 2))
    board = EventAccumulator(str(run))
    board.Reload()
    losses = [event.value for event in board.Scalars("learning/policy_loss")]
    assert losses == pytest.approx([row["policy_loss"] for row in progress(run)], rel=1e-5)
    assert {"episode/reward", "seconds/stepping", "seconds/inference", "seconds/learning"} <= set(
        board.Tags()["scalars"]
    )


def test_weights_and_biases_has_them_too_under_one_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Written by the real library, without its server; a run that resumes is the same one there."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    run = train(replace(small("gru", tmp_path / "run", 1), wandb=True))
    train(replace(small("gru", tmp_path, 2), wandb=True, resume=str(run)))
    (id,) = {file.stem.removeprefix("run-") for file in run.glob("wandb/offline-run-*/run-*.wandb")}
    assert id == (run / "wandb-id.txt").read_text()
    written = b"".join(file.read_bytes() for file in run.glob("wandb/offline-run-*/run-*.wandb"))
    for row in progress(run):
        assert json.dumps(row["policy_loss"]).encode() in written
    assert b"episode/reward" in written and b"decay_updates" in written


@pytest.mark.parametrize("agent", ["gru", "lstm", "trxl"])
def test_bf16_runs(agent: str, tmp_path: Path) -> None:
    """bfloat16 changes the numbers a little, and what is stored stays float32."""
    plain, coarse = (train(replace(small(agent, tmp_path / str(bf16), 1), bf16=bf16)) for bf16 in (False, True))
    one, two = progress(plain)[0]["value_loss"], progress(coarse)[0]["value_loss"]
    assert one != two
    assert one == pytest.approx(two, rel=0.2)
    assert all(tensor.dtype == torch.float32 for tensor in checkpoint.load(coarse).agent.state_dict().values())


def one_command(agent: str, run: Path, **changes: Any) -> Settings:
    quick = PRESETS["quick"]
    return replace(
        quick,
        env=GRID,
        agent=agent,
        run=str(run),
        threads=1,
        target_reward=0.097,
        environment=replace(quick.environment, option=("command_count=[1]",)),
        ppo=replace(quick.ppo, updates=200),
        **changes,
    )


@pytest.mark.timeout(600)
def test_memory_matters(tmp_path: Path) -> None:
    """One command that is shown and then gone: the GRU learns to follow it; without memory nothing can."""
    gru = checkpoint.load(train(one_command("gru", tmp_path / "gru")))
    assert mean(evaluate(gru.agent, num_threads=1)) >= 0.085
    updates = gru.update
    given = one_command("none", tmp_path / "none")
    none = checkpoint.load(train(replace(given, ppo=replace(given.ppo, updates=updates))))
    assert mean(evaluate(none.agent, num_threads=1)) < 0.04
