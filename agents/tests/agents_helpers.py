"""Small agents and their rollouts, for the tests of the agents."""

import ast
import inspect
import itertools
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from endless_gym.specs import spec
from endless_gym_agents import settings as all_settings
from endless_gym_agents.agent.agent import Agent, AgentMemory, make_agent
from endless_gym_agents.environments.groups import Environments
from endless_gym_agents.memories.memory import MemoryState
from endless_gym_agents.settings import PPO, PRESETS, Model, Recurrence, Settings, Transformer, to_dict
from endless_gym_agents.training import checkpoint, losses
from endless_gym_agents.training.ppo import minibatch_loss
from endless_gym_agents.training.rollout import RolloutCollector, Segment

#: An experiment of `endless-reproduce`: one run of six updates, with checkpoints every second.
EXPERIMENT: dict[str, Any] = {"title": "Mine", "section": "-", "about": "A test.", "kind": "curves", "seeds": 1}
EXPERIMENT["evaluation"] = {"interval": 2, "seeds": 2, "repetitions": 1}
_FLAGS = {"preset": "quick", "agent": "gru", "environment.option": ["command_count=[1, 2]"], "environment.num-envs": 8}
_FLAGS |= {"ppo.updates": 6, "ppo.steps": 256, "recurrence.hidden-size": 16}
EXPERIMENT["runs"] = [{"name": "gru", "env": "MortarMayhem-Grid-v0", "flags": _FLAGS}]

GRID = "MortarMayhem-Grid-v0"

#: Frames, and the heads that need them and a ground truth.
ALL_HEADS = {
    "env": "Endless-MortarMayhem-v0",
    "environment": {"option": (), "observation": "rgb"},
    "ppo": {"reconstruction_coefficient": 0.1, "ground_truth_coefficient": 0.1},
}

FEATURES = {"features": (6,)}
BRANCHES = (3, 2)


def changed(given: Settings, **changes: Any) -> Settings:
    """The settings with other values; a dict replaces fields of a group, such as `ppo={"steps": 8}`."""
    groups = {name: replace(getattr(given, name), **new) for name, new in changes.items() if isinstance(new, dict)}
    return replace(given, **(changes | groups))


def settings(agent: str, **changes: Any) -> Settings:
    """Settings of a small network, changed as by `changed`."""
    small = {
        "recurrence": Recurrence(hidden_size=16, sequence_length=8),
        "transformer": Transformer(layers=2, width=16, heads=2, window=6, sequence_length=8, positions=64),
        "model": Model(vector_width=12, head_width=10),
    }
    return changed(replace(PRESETS["quick"], agent=agent, **small), **changes)


def small(agent: str, run: Path, updates: int = 3, **environment: Any) -> Settings:
    given = settings(agent, env=GRID, run=str(run), checkpoint_interval=2, threads=1)
    changes = {"num_envs": 8, "groups": 2, "option": ("command_count=[1, 2]",), **environment}
    return changed(given, environment=changes, ppo={"steps": 16, "minibatches": 2, "updates": updates})


def progress(run: Path) -> list[dict[str, Any]]:
    """The metrics of all updates without timings."""
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("seconds/") and k != "steps_per_second"} for row in rows]


def same(one: Any, two: Any) -> bool:
    """Whether the contents of two checkpoints are bitwise equal."""
    if isinstance(one, torch.Tensor):
        return torch.equal(one, two)
    if isinstance(one, dict):
        return one.keys() == two.keys() and all(same(one[key], two[key]) for key in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(two) and all(map(same, one, two))
    return bool(one == two)


def assert_equal_runs(one: Path, two: Path, message: str = "") -> None:
    """The metrics of two runs, and the states from which they resume, are bitwise equal."""
    assert progress(one) == progress(two), message
    states = [checkpoint.load(run).state for run in (one, two)]
    for part in ("update", "steps", "model", "optimizer", "generators", "player", "episodes"):
        assert same(*(state[part] for state in states)), f"{part} {message}"


def transformer(**changes: Any) -> dict[str, Any]:
    return {"transformer": changes}


def saved(run: Path, given: Settings, **state: Any) -> Agent:
    """A new agent in evaluation mode, with a checkpoint of a run, as endless-train saves it."""
    torch.manual_seed(0)
    agent = make_agent(given, spec(given.env))
    checkpoint.save(
        run, {"settings": to_dict(given), "update": 1, "steps": 64, "model": agent.state_dict()} | state, False
    )
    return agent.eval()


def make(agent: str, shapes: dict[str, tuple[int, ...]] = FEATURES, **changes: Any) -> Agent:
    torch.manual_seed(3)
    made = Agent(settings(agent, **changes), shapes, BRANCHES)
    # As after some training, the biases and the output layer of the policy are not near zero.
    for parameter in made.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return made


def observations(steps: int, envs: int) -> torch.Tensor:
    return torch.randn(steps, envs, 6, generator=torch.Generator().manual_seed(5))


def ends(steps: int, envs: int) -> torch.Tensor:
    """Ends of episodes, bool (steps, envs): none in environment 0, different ones in the others."""
    done = torch.rand(steps, envs, generator=torch.Generator().manual_seed(6)) < 0.15
    done[:, 0] = False
    return done


def play(
    agent: Agent, memory: AgentMemory, observed: torch.Tensor | dict[str, torch.Tensor], done: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Act on given observations, by key or features (T, N, 6), as one segment.

    Returns:
        Reset mask (T, N), actions (T, N, 2), log-probabilities (T, N, 2), and values (T, N).
    """
    parts = observed if isinstance(observed, dict) else {"features": observed}
    agent.memory.begin_segment(memory.state, len(done))
    rows = []
    generator = torch.Generator().manual_seed(7)
    for step, end in enumerate(done):
        reset_mask = memory.reset_mask
        output = agent.act({key: part[step] for key, part in parts.items()}, memory, generator)
        rows.append((reset_mask, output.action, output.log_prob, output.value))
        memory.reset(end)
    # A rollout ends with a bootstrap value, which must not change the memory.
    agent.bootstrap_value({key: part[-1] for key, part in parts.items()}, memory)
    reset_mask, action, log_prob, value = (torch.stack(column) for column in zip(*rows, strict=True))
    return reset_mask, action, log_prob, value


def segment_of(agent: Agent, memory: AgentMemory, observed: dict[str, torch.Tensor], steps: int, envs: int) -> Segment:
    """A segment that the agent collects, with random rewards and ground truths.

    Log-probabilities and values are perturbed, as in a later epoch.
    """
    reset_mask, action, log_prob, value = play(agent, memory, observed, ends(steps, envs))
    draws = torch.Generator().manual_seed(2)
    return Segment(
        observation=observed,
        reset_mask=reset_mask,
        action=action,
        log_prob=log_prob + 0.2 * torch.randn(log_prob.shape, generator=draws),
        value=value + 0.2 * torch.randn(value.shape, generator=draws),
        reward=torch.randn(steps, envs, generator=draws),
        done=ends(steps, envs),
        ground_truth=torch.randn(steps, envs, 2, generator=draws) if agent.ground_truth else None,
        last_value=torch.randn(envs, generator=draws),
    )


@contextmanager
def collecting(given: Settings, device: str = "cpu") -> Iterator[RolloutCollector]:
    """A collector of segments with a new agent."""
    with Environments(given, pin_memory=torch.device(device).type != "cpu") as environments:
        torch.manual_seed(1)
        agent = make_agent(given, environments.spec, device)
        yield RolloutCollector(agent, environments, given.ppo.steps, torch.Generator(device).manual_seed(1))


def loss_of(agent: Agent, segment: Segment, state: MemoryState, ppo: PPO, entropy_coefficient: float) -> torch.Tensor:
    """The total loss of a segment as one minibatch."""
    advantages = losses.generalised_advantages(
        segment.reward, segment.value, segment.done, segment.last_value, ppo.gamma, ppo.gae_lambda
    )
    (minibatch,) = agent.memory.minibatches([state], segment.reset_mask, 1, torch.Generator().manual_seed(0))
    returns = (advantages + segment.value).flatten()
    flat = segment.flat()
    return minibatch_loss(agent, flat, minibatch, advantages.flatten(), returns, ppo, entropy_coefficient)[0]


def documented_settings() -> dict[str, str]:
    """The docstring below each setting by the setting's name, such as `ppo.steps`; empty if there is none."""
    classes = {
        one.name: one for one in ast.parse(inspect.getsource(all_settings)).body if isinstance(one, ast.ClassDef)
    }

    def texts(owner: str, prefix: str) -> Iterator[tuple[str, str]]:
        body = classes[owner].body
        for field, after in itertools.zip_longest(body, body[1:]):
            if isinstance(field, ast.AnnAssign):
                name, kind = prefix + ast.unparse(field.target), ast.unparse(field.annotation)
                if kind in classes:
                    yield from texts(kind, name + ".")
                else:
                    is_text = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
                    yield name, " ".join(str(after.value.value).split()) if is_text else ""

    return dict(texts("Settings", ""))
