"""`endless-probe`: what a trained agent's memory contains of the ground truth.

The frozen agent plays episodes of seeds that training never uses. A linear and a small nonlinear probe learn to predict
`info["ground_truth"]` at a step from the memory's output at that step. They are trained on some of the episodes and tested on
the others. The baselines are the mean of the ground truth, and the same probes on the encoded observation, which has no memory.

```console
endless-probe runs/mine
```
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.table import Table
from torch import Tensor, nn

from endless_gym.specs import spec
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import command, tables
from endless_gym_agents.common.ranges import Natural, Positive, Range
from endless_gym_agents.environments import wrappers
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import choose_device


@dataclass(frozen=True)
class ProbeArguments:
    """Arguments of `endless-probe`."""

    checkpoint: tyro.conf.Positional[Path]
    """a checkpoint file, or the folder of a run for its last checkpoint"""
    first_seed: Natural = EVALUATION_SEEDS.start
    """first seed of the episodes; the seeds are consecutive"""
    episodes: Annotated[int, Range(2)] = 100
    """number of episodes; four fifths train the probes, the others test them"""
    max_steps: Positive = 512
    """largest number of recorded steps per episode"""
    action_seed: Natural = 0
    """seed of the action sampling, of the split into training and test episodes, and of the probes"""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available, else the CPU"""
    threads: Natural = 0
    """CPU threads of PyTorch; 0 for PyTorch's default"""
    json: bool = False
    """print JSON instead of a table"""


@dataclass(frozen=True)
class Recording:
    """Steps of episodes of a frozen agent.

    Attributes:
        memory: Output of the agent's memory, float32 (steps, width).
        observation: Encoded observation, float32 (steps, width).
        truth: Ground truth, float32 (steps, columns).
        episode: Number of the episode of each step, int64 (steps,).
    """

    memory: Tensor
    observation: Tensor
    truth: Tensor
    episode: Tensor


@dataclass(frozen=True)
class Score:
    """How well a probe predicts one column of the ground truth in the test episodes.

    Attributes:
        column: Name of the column.
        source: What the probe sees: `memory` or `observation`.
        probe: `linear` or `mlp`.
        error: Mean squared error.
        baseline: Mean squared error of the mean of the training steps.
        explained: 1 minus error divided by baseline: 1 is perfect, 0 is the baseline. 0 if the column does not vary.
        accuracy: Share of the steps at which the closest of the column's values is the true one; None if it has more than 10.
        majority: The same share for always predicting the most frequent value of the training steps; None as for `accuracy`.
    """

    column: str
    source: str
    probe: str
    error: float
    baseline: float
    explained: float
    accuracy: float | None
    majority: float | None


@torch.no_grad()
def record(agent: Agent, seeds: Sequence[int], max_steps: int = 512, action_seed: int = 0) -> Recording:
    """Play one episode of each seed, all in parallel, and record the agent's memory together with the ground truth.

    Args:
        agent: The agent; its settings name the environment. It is not changed.
        seeds: Seeds of the episodes.
        max_steps: Largest number of recorded steps per episode.
        action_seed: Seed of the generator that samples the actions.

    Raises:
        ValueError: The environment has no ground truth.
    """
    settings, env_spec, count = agent.settings, spec(agent.settings.env), len(seeds)
    if not env_spec.ground_truth:
        raise ValueError(
            f"a probe needs a ground truth, and {settings.env} has none; use an agent of an endless environment"
        )
    memory, generator = agent.initial_memory(count), torch.Generator(agent.device).manual_seed(action_seed)
    parts: dict[str, list[Tensor]] = {"memory": [], "observation": [], "truth": [], "episode": []}
    running, numbers = torch.ones(count, dtype=torch.bool), torch.arange(count)
    with wrappers.make(settings, count, seeds=list(seeds)) as envs:
        observation, info = envs.reset()
        for _ in range(max_steps):
            agent.acting_weights()
            with torch.autocast(agent.device.type, torch.bfloat16, enabled=settings.bf16):
                encoded = agent.encoder(agent.observe(agent.to_tensors(observation), memory)[0])
                output, _ = agent.memory.step(agent.memory.embed(encoded), memory.state, memory.reset_mask)
            parts["memory"].append(output[running.to(output.device)].float().cpu())
            parts["observation"].append(encoded[running.to(encoded.device)].float().cpu())
            parts["truth"].append(torch.tensor(info["ground_truth"], dtype=torch.float32)[running])
            parts["episode"].append(numbers[running])
            action = agent.act(observation, memory, generator).action
            observation, _, terminated, truncated, info = envs.step(env_spec.batched_actions(action.cpu().numpy()))
            done = terminated | truncated
            memory.reset(done)
            # Autoreset starts further episodes, which are ignored.
            running &= ~torch.from_numpy(done)
            if not running.any():
                break
    return Recording(**{name: torch.cat(rows) for name, rows in parts.items()})


def linear_probe(x: Tensor, y: Tensor) -> nn.Module:
    """The ridge regression of y (steps, columns) on standardised x (steps, width), with a penalty of 1e-3 per step."""
    x64, y64 = x.double(), y.double()
    gram = x64.T @ x64 / len(x) + 1e-3 * torch.eye(x.shape[1], dtype=torch.float64)
    layer = nn.Linear(x.shape[1], y.shape[1])
    layer.weight.data = torch.linalg.solve(gram, x64.T @ (y64 - y64.mean(0)) / len(x)).T.float()
    layer.bias.data = y.mean(0)
    return layer


def mlp_probe(x: Tensor, y: Tensor, seed: int = 0, steps: int = 1000) -> nn.Module:
    """A network with one hidden layer of 64 units, trained with AdamW and weight decay on batches of 256 steps."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        hidden, output = nn.Linear(x.shape[1], 64), nn.Linear(64, y.shape[1])
    network = nn.Sequential(hidden, nn.ReLU(), output)
    output.weight.data.zero_()
    output.bias.data = y.mean(0)
    optimizer = torch.optim.AdamW(network.parameters(), 1e-3, weight_decay=0.1)
    for _ in range(steps):
        chosen = torch.randint(len(x), (256,), generator=generator)
        loss = (network(x[chosen]) - y[chosen]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network


def probe(recording: Recording, columns: Sequence[str], seed: int = 0) -> list[Score]:
    """Train and test the probes.

    Args:
        recording: Steps of at least two episodes.
        columns: Names of the columns of the ground truth.
        seed: Seed of the split into training and test episodes, and of the probes.

    Raises:
        ValueError: There are fewer than two episodes.
    """
    episodes = recording.episode.unique()
    if len(episodes) < 2:
        raise ValueError(f"a probe needs 2 or more episodes, to train and to test, got {len(episodes)}")
    order = episodes[torch.randperm(len(episodes), generator=torch.Generator().manual_seed(seed))]
    # Split by whole episodes, since the steps of one episode are similar.
    test = torch.isin(recording.episode, order[: max(1, len(order) // 5)])
    truth, expected = recording.truth[~test], recording.truth[test]
    baseline = (expected - truth.mean(0)).square().mean(0)
    values = [column.unique() for column in truth.T]
    found = []
    for source, x in (("memory", recording.memory), ("observation", recording.observation)):
        mean, std = x[~test].mean(0), x[~test].std(0).clamp(min=1e-6)
        x = (x - mean) / std
        for name, made in (("linear", linear_probe(x[~test], truth)), ("mlp", mlp_probe(x[~test], truth, seed))):
            with torch.no_grad():
                predicted = made(x[test])
            error = (predicted - expected).square().mean(0)
            for place, column in enumerate(columns):
                base, wrong, accuracy, majority = float(baseline[place]), float(error[place]), None, None
                if len(values[place]) <= 10:
                    closest = (predicted[:, place, None] - values[place]).abs().argmin(-1)
                    accuracy = float((values[place][closest] == expected[:, place]).float().mean())
                    majority = float((truth[:, place].mode().values == expected[:, place]).float().mean())
                explained = 1 - wrong / base if base > 1e-12 else 0.0
                found.append(Score(column, source, name, wrong, base, explained, accuracy, majority))
    return found


def table(title: str, scores: Sequence[Score]) -> Table:
    """A table with one row for each score."""
    texts, figures = ("ground truth", "from", "probe"), ("error", "baseline", "explained", "accuracy", "majority")
    made = tables.table(title, dict.fromkeys(texts, False) | dict.fromkeys(figures, True))
    for score in scores:
        shares = ["" if share is None else f"{share:.3f}" for share in (score.accuracy, score.majority)]
        numbers = [f"{score.error:.4f}", f"{score.baseline:.4f}", f"{score.explained:.3f}", *shares]
        made.add_row(score.column, score.source, score.probe, *numbers)
    return made


def execute(arguments: ProbeArguments) -> None:
    """Record, probe, and print the scores."""
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    agent = checkpoint.load(arguments.checkpoint, choose_device(arguments.device)).agent
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.episodes)
    recording = record(agent, seeds, arguments.max_steps, arguments.action_seed)
    env_spec = spec(agent.settings.env)
    scores = probe(recording, [column.name for column in env_spec.ground_truth_columns], arguments.action_seed)
    if arguments.json:
        values = {"env": env_spec.id, "steps": len(recording.truth), "scores": [asdict(score) for score in scores]}
        print(json.dumps(values, indent=1))
        return
    tables.show(table(f"{env_spec.id}, {len(recording.truth):,} steps", scores), command.Terminal())


def main() -> int:
    """Entry point of the command `endless-probe`; returns the exit status."""
    return command.main("endless-probe", ProbeArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
