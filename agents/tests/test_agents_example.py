"""The example `ppo_gru.py`: its masks in both auto-reset modes, and its learning curve beside that of `endless-train`."""

import importlib.util
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest
import torch
from agents_helpers import changed

from endless_gym_agents.evaluation.evaluate import evaluate, mean
from endless_gym_agents.settings import PRESETS
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.train import train

FILE = Path(__file__).parents[2] / "bindings" / "python" / "examples" / "ppo_gru.py"
GRID, OPTION = "MortarMayhem-Grid-v0", "command_count=[1]"
#: Largest difference of two trainers' mean returns over a run that counts as the same curve: a tenth of the best return, 0.1.
NOISE = 0.01


@pytest.fixture(scope="module")
def example() -> Any:
    spec = importlib.util.spec_from_file_location("ppo_gru", FILE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["ppo_gru"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_advantages_do_not_depend_on_the_auto_reset_mode(example: Any) -> None:
    """Next-step auto-reset inserts a step after each end, which has no effect on the others."""
    draws, args = torch.Generator().manual_seed(1), example.Args()
    steps, envs = 40, 3
    reward, value = (torch.randn(steps, envs, generator=draws) for _ in range(2))
    done, last = torch.rand(steps, envs, generator=draws) < 0.2, torch.randn(envs, generator=draws)
    same = example.advantages_of(reward, value, done, torch.ones_like(done), last, args)
    for env in range(envs):
        rows = []
        for t in range(steps):
            rows.append((reward[t, env], value[t, env], done[t, env], True))
            if done[t, env]:
                rows.append((0.0, torch.randn((), generator=draws), False, False))
        inserted = [torch.tensor([float(row[i]) for row in rows])[:, None] for i in range(4)]
        given = (*inserted[:2], inserted[2].bool(), inserted[3].bool(), last[env : env + 1])
        advantages = example.advantages_of(*given, args)
        torch.testing.assert_close(advantages[inserted[3].bool()], same[:, env], rtol=1e-5, atol=1e-6)
        assert not advantages[~inserted[3].bool()].any()


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_rollouts_mark_the_steps_that_only_reset(autoreset: str, example: Any, tmp_path: Path) -> None:
    args = example.Args(option=(OPTION,), run=tmp_path, num_envs=8, num_steps=48, autoreset=autoreset, cuda=False)
    trainer = example.Trainer(args)
    for _ in range(2):
        batch = trainer.collect()
        start, valid, done = (batch[name] for name in ("start", "valid", "done"))
        assert done.any()
        if autoreset == "same_step":
            assert valid.all() and torch.equal(start[1:], done[:-1])
        else:
            # A step after an end plays nothing: no reward, no end; the one after it is the first of an episode.
            assert torch.equal(valid[1:], ~done[:-1])
            assert torch.equal(start[2:], ~valid[1:-1])
            assert not batch["reward"][~valid].any() and not done[~valid].any()
        # The recomputed outputs are those of the rollout.
        log_probs, value = trainer.agent.sequences(batch["observation"], start, batch["hidden"])
        torch.testing.assert_close(value, batch["value"].flatten(), rtol=1e-4, atol=1e-5)
        chosen = example.chosen_log_probs(log_probs, batch["actions"].flatten(0, 1))
        torch.testing.assert_close(chosen, batch["log_prob"].flatten(0, 1), rtol=1e-4, atol=1e-5)
        trainer.learn(batch)
    trainer.envs.close()


def test_a_run_resumes_from_its_checkpoint(tmp_path: Path) -> None:
    few = ["--run", str(tmp_path), "--num-envs", "4", "--num-steps", "8", "--num-minibatches", "2", "--option", OPTION]

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, FILE, *few, *more], capture_output=True, text=True, timeout=200)

    assert run("--total-timesteps", "64").returncode == 0
    refused = run("--total-timesteps", "64")
    assert refused.returncode == 1 and "has a run; add --resume" in refused.stderr
    assert run("--resume", "--total-timesteps", "128").returncode == 0
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(row["update"], row["steps"]) for row in rows] == [(1, 32), (2, 64), (3, 96), (4, 128)]


@pytest.mark.timeout(1200)
def test_it_learns_as_fast_as_the_packaged_trainer_in_both_auto_reset_modes(tmp_path: Path) -> None:
    """The mean return over a fixed budget of steps, in which an agent goes from a fifth of the best return to all of it.

    The evaluation shows that the packaged agent has learnt a command that is shown and hidden.
    """
    steps = 300_000
    given = replace(PRESETS["quick"], env=GRID, run=str(tmp_path / "packaged"), threads=1, total_steps=steps)
    run = train(changed(given, environment={"option": (OPTION,)}, stop_when_learnt=False))
    assert mean(evaluate(checkpoint.load(run).agent, num_threads=1)) >= 0.085
    means = {"packaged": fmean(row.get("episode/reward") or 0.0 for row in read_progress(run))}
    for autoreset in ("same_step", "next_step"):
        run = tmp_path / autoreset
        flags = ["--option", OPTION, "--total-timesteps", str(steps), "--run", str(run), "--autoreset", autoreset]
        subprocess.run([sys.executable, FILE, *flags], check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})
        rows = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
        means[autoreset] = fmean(row["mean_return"] or 0.0 for row in rows)
        assert abs(means[autoreset] - means["packaged"]) < NOISE, means
