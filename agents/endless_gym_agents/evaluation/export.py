"""Export a trained agent as one small file, which the browser page reads.

```console
python -m endless_gym_agents.export runs/mine --out mine.safetensors
python -m endless_gym_agents.export runs/mine --weights mine.safetensors         # of any agent, for `endless learn --init-from`
python -m endless_gym_agents.export mine.safetensors --vectors mine.json   # outputs of the network, for tests of other programs
```

The file is in the format of a checkpoint of `endless learn`; its header has settings and length of the training, and the measured
success. The weights are rounded to bfloat16, so that browsers download half as many bytes after compression. `checkpoint.load`
reads the file.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from endless_gym._native import PAGE_AGENTS
from endless_gym.program.printable import printable
from endless_gym.specs import spec
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import atomic, command
from endless_gym_agents.common.ranges import Positive
from endless_gym_agents.environments import wrappers
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS, evaluate, mean
from endless_gym_agents.settings import Settings, to_dict
from endless_gym_agents.training.checkpoint import Checkpoint, load, protected, to_safetensors

#: Seed of the episodes and of the sampled actions of recorded vectors.
VECTORS_SEED = EVALUATION_SEEDS.start


@dataclass(frozen=True)
class ExportArguments:
    """Arguments of this program."""

    source: tyro.conf.Positional[Path]
    """a checkpoint file, the folder of a run for its last checkpoint, or an exported file"""
    out: Path | None = None
    """file in the format safetensors to write the agent to"""
    weights: Path | None = None
    """file in the format safetensors to write the weights of a checkpoint of any agent to, for `endless learn --init-from`"""
    vectors: Path | None = None
    """JSON file to write recorded inputs and outputs of the network to"""
    vector_steps: Positive = 96
    """number of recorded steps"""


def export(checkpoint: Checkpoint, evaluation: list[dict[str, Any]]) -> bytes:
    """The exported file of a trained agent.

    Args:
        checkpoint: Checkpoint of the agent.
        evaluation: What `evaluations` returned for it.
    """
    header = {
        "update": checkpoint.update,
        "steps": checkpoint.steps,
        "evaluation": evaluation,
        # The folder of the run is a path on the training machine.
        "settings": to_dict(checkpoint.settings) | {"run": "", "resume": ""},
    }
    return to_safetensors(weights(checkpoint.agent), header)


def weights(agent: Agent) -> dict[str, torch.Tensor]:
    """The weights of an agent by name, as `safetensors` takes them."""
    return {name: part.float().cpu().contiguous() for name, part in agent.state_dict().items()}


def evaluations(agent: Agent) -> list[dict[str, Any]]:
    """The agent's success on the seeds of the paper's evaluation, with sampled actions.

    Several values of `command_count` are evaluated separately, since the final infos of an episode do not contain it.

    Returns:
        For each evaluation: `options`, `episodes`, `mean_reward`, and in finite environments `success`, the fraction of episodes
        in which the whole task was done, 0 to 1.
    """
    trained = agent.settings
    options = trained.options()
    counts = options.get("command_count", [])
    each = [options | {"command_count": [count]} for count in counts] if len(counts) > 1 else [options]
    found = []
    for chosen in each:
        environment = replace(trained.environment, option=command.assignments(chosen))
        results = evaluate(agent, num_threads=1, settings=replace(trained, environment=environment))
        measured: dict[str, Any] = {"options": chosen, "episodes": len(results), "mean_reward": round(mean(results), 6)}
        if "task_progress" in results[0]:
            successes = sum(result["task_progress"] > 1.0 - 1e-6 for result in results)
            measured["success"] = round(successes / len(results), 6)
        found.append(measured)
    return found


def check(settings: Settings, agent: Agent) -> None:
    """Raise an error if the page cannot compute this agent, unless only since its environment returns integers.

    Raises:
        ValueError: The agent is not one of `PAGE_AGENTS`, has parts of your own, or observes more than features.
    """
    wrong = {
        f"--agent must be {', '.join(PAGE_AGENTS)}": settings.agent not in PAGE_AGENTS and settings.agent,
        "mingru must have no --agent-option": settings.agent == "mingru" and " ".join(settings.agent_option),
        "--encoder must be the package's": settings.encoder,
        "--environment.wrapper must be empty": " ".join(settings.environment.own_wrappers),
        "the observation must be `features` alone": list(agent.observation_shapes) != ["features"]
        and list(agent.observation_shapes),
    }
    for allowed, given in wrong.items():
        if given:
            raise ValueError(f"an agent cannot be exported: {allowed}, got {given}; train another agent")


def record_vectors(agent: Agent, steps: int) -> dict[str, Any]:
    """Play episodes one after the other, and record the network's inputs and outputs.

    Args:
        agent: An agent with feature observations.
        steps: Number of steps.

    Returns:
        Lists of `steps` entries: `reset` (bool, whether the step is the first of an episode), `features` (floats), `logits`
        (floats, those of all branches in order) and `action` (integers, sampled).
    """
    settings, env_spec = agent.settings, spec(agent.settings.env)
    generator, memory = torch.Generator().manual_seed(VECTORS_SEED), agent.initial_memory(1)
    recorded: dict[str, Any] = {"env": env_spec.id, "reset": [], "features": [], "logits": [], "action": []}
    with wrappers.make(settings, 1, 1, seed=VECTORS_SEED) as envs:
        observation, _ = envs.reset()
        for _ in range(steps):
            observed, transform_update = agent.observe(agent.to_tensors(observation), memory)
            decision = agent.decide(observed, memory, agent.noise((1,), generator))
            logits = agent.acting_weights().logits(decision.outputs)[0]
            recorded["reset"].append(bool(memory.reset_mask[0]))
            recorded["features"].append(observed["features"][0].tolist())
            rows = [row[:choices] for row, choices in zip(logits, agent.branches, strict=True)]
            recorded["logits"].append(torch.cat(rows).tolist())
            recorded["action"].append(decision.action[0].tolist())
            agent.remember(memory, decision, transform_update)
            observation, _, terminated, truncated, _ = envs.step(env_spec.batched_actions(decision.action.numpy()))
            memory.reset(terminated | truncated)
    return recorded


def execute(arguments: ExportArguments) -> None:
    """Write the files that the arguments name."""
    if arguments.out is None and arguments.vectors is None and arguments.weights is None:
        raise ValueError("nothing to write; add --out FILE, --weights FILE or --vectors FILE")
    command.check_outputs((arguments.out, arguments.weights, arguments.vectors), protected(arguments.source))
    checkpoint = load(arguments.source)
    agent = checkpoint.agent
    if arguments.weights is not None:
        atomic.write(arguments.weights, to_safetensors(weights(agent)))
    if arguments.out is not None or arguments.vectors is not None:
        check(agent.settings, agent)
    if arguments.out is not None:
        for weight in agent.parameters():
            weight.data.copy_(weight.bfloat16())
        evaluation = evaluations(agent)
        atomic.write(arguments.out, export(checkpoint, evaluation))
        print(f"{printable(arguments.out)}: {arguments.out.stat().st_size} bytes, {evaluation}")
        if agent.settings.environment.wrapper:
            print(
                "the programs of this package read it; the page does not, since it has no agents that observe integers"
            )
    if arguments.vectors is not None:
        vectors = record_vectors(agent, arguments.vector_steps)
        atomic.write(arguments.vectors, json.dumps(vectors, separators=(",", ":")) + "\n")


def main() -> int:
    """Entry point of this program; returns the exit status."""
    return command.main("endless_gym_agents.evaluation.export", ExportArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
