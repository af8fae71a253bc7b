"""Export a trained GRU agent as one small file, in the format that the browser page reads.

```console
python -m endless_gym_agents.export runs/mine --out mine.agent.bin
python -m endless_gym_agents.export runs/mine --weights mine.safetensors         # of any agent, for `endless learn --init-from`
python -m endless_gym_agents.export mine.agent.bin --vectors mine.json   # outputs of the network, for tests of other programs
```

The file has these parts, with all numbers in little-endian order:

| bytes | content |
| --- | --- |
| 8 | `MAGIC` |
| 4 | format version, uint32 |
| 4 | length of the header in bytes, uint32 |
| | header: JSON in UTF-8 |
| | all tensors in the order of the header's `tensors`, row-major float32 |

The header contains the environment, its reset parameters, the settings and length of the training, the measured success, and
the name and shape of each tensor. Only what acting needs is exported, so the value head is not.
"""

from __future__ import annotations

import json
import struct
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from safetensors.torch import save_file

from endless_gym.create import make_vec
from endless_gym.specs import spec
from endless_gym_agents import command
from endless_gym_agents.agent import Agent, make_agent
from endless_gym_agents.checkpoint import Checkpoint, load
from endless_gym_agents.evaluate import evaluate, mean
from endless_gym_agents.metrics import TASK_PROGRESS
from endless_gym_agents.ranges import Positive
from endless_gym_agents.settings import Settings, from_dict, to_dict

#: The first bytes of a file.
MAGIC = b"ENDLAGNT"
#: Version of the format. It changes when an older reader cannot read the file.
FORMAT_VERSION = 1
#: Prefix of the parameters that acting does not need.
NOT_EXPORTED = "value."
#: Seed of the episodes and of the sampled actions of recorded vectors.
VECTORS_SEED = 200_000

_PREFIX = struct.Struct("<8sII")


@dataclass(frozen=True)
class ExportArguments:
    """Arguments of this program."""

    source: tyro.conf.Positional[Path]
    """a checkpoint file, the folder of a run for its last checkpoint, or an exported file"""
    out: Path | None = None
    """file to write the agent to; needs a checkpoint"""
    weights: Path | None = None
    """file in the format safetensors to write the weights of a checkpoint of any agent to, for `endless learn --init-from`"""
    vectors: Path | None = None
    """JSON file to write recorded inputs and outputs of the network to"""
    vector_steps: Positive = 96
    """number of recorded steps"""


def export(checkpoint: Checkpoint) -> bytes:
    """The exported file of a trained agent, with its success on the seeds of the paper's evaluation.

    Args:
        checkpoint: Checkpoint of an agent `gru` with feature observations.

    Raises:
        ValueError: The format does not support this kind of agent.
    """
    settings, agent = checkpoint.settings, checkpoint.agent
    check(settings, agent)
    weights = {name: tensor for name, tensor in agent.state_dict().items() if not name.startswith(NOT_EXPORTED)}
    env_spec = spec(settings.env)
    # The folder of the run is a path on the training machine.
    recorded = to_dict(settings) | {"run": "", "resume": ""}
    header = {
        "env": env_spec.id,
        "options": settings.options(),
        "observation": settings.environment.observation,
        "branches": list(env_spec.branches),
        "updates": checkpoint.update,
        "steps": checkpoint.steps,
        "evaluation": evaluations(agent),
        "settings": recorded,
        "tensors": [{"name": name, "shape": list(tensor.shape)} for name, tensor in weights.items()],
    }
    text = json.dumps(header, separators=(",", ":")).encode()
    numbers = [np.ascontiguousarray(tensor.numpy(), dtype="<f4").tobytes() for tensor in weights.values()]
    return b"".join([_PREFIX.pack(MAGIC, FORMAT_VERSION, len(text)), text, *numbers])


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
        given = tuple(f"{name}={json.dumps(value)}" for name, value in chosen.items())
        agent.settings = replace(trained, environment=replace(trained.environment, option=given))
        try:
            results = evaluate(agent, num_threads=1)
        finally:
            agent.settings = trained
        measured: dict[str, Any] = {"options": chosen, "episodes": len(results), "mean_reward": round(mean(results), 6)}
        if TASK_PROGRESS in results[0]:
            successes = sum(result[TASK_PROGRESS] > 1.0 - 1e-6 for result in results)
            measured["success"] = round(successes / len(results), 6)
        found.append(measured)
    return found


def check(settings: Settings, agent: Agent) -> None:
    """Raise an error if the format does not support this agent.

    Raises:
        ValueError: The agent is not a one-layer GRU with an embedding and without a residual connection, or it observes more
            than features.
    """
    memory = settings.recurrence
    wrong = {
        "--agent must be gru": settings.agent != "gru" and settings.agent,
        "--encoder must be the package's": settings.encoder,
        "--environment.wrapper must be empty": " ".join(settings.environment.wrapper),
        "--recurrence.layers must be 1": memory.layers != 1 and memory.layers,
        "--recurrence.residual must be off": memory.residual,
        "--recurrence.embedding must be on": not memory.embedding,
        "the observation must be `features` alone": list(agent.observation_shapes) != ["features"]
        and list(agent.observation_shapes),
    }
    for allowed, given in wrong.items():
        if given:
            raise ValueError(f"an agent cannot be exported: {allowed}, got {given}; train another agent")


def read(file: Path) -> tuple[dict[str, Any], Agent]:
    """Read an exported file.

    Returns:
        The header, and the agent in evaluation mode. Its value head is not trained, since it is not in the file.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not of this format and version, or truncated.
    """
    content = file.read_bytes()
    if len(content) < _PREFIX.size or not content.startswith(MAGIC):
        raise ValueError(f"{file} is not an exported agent; expected a file that starts with {MAGIC.decode()}")
    _, version, length = _PREFIX.unpack_from(content)
    if version != FORMAT_VERSION:
        raise ValueError(f"exported agent {file} must be of version {FORMAT_VERSION}, got {version}; export it again")
    text, rest = content[_PREFIX.size : _PREFIX.size + length], content[_PREFIX.size + length :]
    if len(text) != length:
        raise ValueError(f"exported agent {file} is truncated: its header has {length} bytes, got {len(text)}")
    header: dict[str, Any] = json.loads(text)
    shapes = {tensor["name"]: tuple(tensor["shape"]) for tensor in header["tensors"]}
    sizes = [int(np.prod(shape)) for shape in shapes.values()]
    if len(rest) != 4 * sum(sizes):
        raise ValueError(f"exported agent {file} must have {4 * sum(sizes)} bytes of weights, got {len(rest)}")
    parts = np.split(np.frombuffer(rest, dtype="<f4"), np.cumsum(sizes)[:-1])
    weights = {
        name: torch.from_numpy(part.astype(np.float32)).reshape(shape)
        for (name, shape), part in zip(shapes.items(), parts, strict=True)
    }
    settings = from_dict(header["settings"])
    agent = make_agent(settings, spec(settings.env))
    missing, unexpected = agent.load_state_dict(weights, strict=False)
    if unexpected or not all(name.startswith(NOT_EXPORTED) for name in missing):
        raise ValueError(f"exported agent {file} lacks {missing} and has the unknown {unexpected}; export it again")
    agent.eval()
    return header, agent


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
    with make_vec(
        settings.env, 1, 1, seed=VECTORS_SEED, options=settings.options(), autoreset="same_step", observation="features"
    ) as envs:
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
    if arguments.source.is_file() and arguments.source.read_bytes()[: len(MAGIC)] == MAGIC:
        for flag, file in (("out", arguments.out), ("weights", arguments.weights)):
            if file is not None:
                raise ValueError(f"--{flag} needs a checkpoint, got the exported file {arguments.source}")
        agent = read(arguments.source)[1]
    else:
        checkpoint = load(arguments.source)
        agent = checkpoint.agent
        if arguments.weights is not None:
            save_file(
                {name: part.float().cpu().contiguous() for name, part in agent.state_dict().items()}, arguments.weights
            )
        if arguments.out is not None:
            content = export(checkpoint)
            arguments.out.write_bytes(content)
            evaluation = read(arguments.out)[0]["evaluation"]
            print(f"{arguments.out}: {len(content)} bytes, {evaluation}")
    if arguments.vectors is not None:
        check(agent.settings, agent)
        vectors = record_vectors(agent, arguments.vector_steps)
        arguments.vectors.write_text(json.dumps(vectors, separators=(",", ":")) + "\n")


def main() -> int:
    """Entry point of this program; returns the exit status."""
    return command.main("endless_gym_agents.export", ExportArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
