"""Checkpoints: the state from which a run resumes, and the agent for evaluation.

```python
from endless_gym_agents import checkpoint

loaded = checkpoint.load("runs/mine")    # the last checkpoint of a run, or a checkpoint file
agent, steps = loaded.agent, loaded.steps
```
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from endless_gym.specs import spec
from endless_gym_agents.agent import Agent, make_agent
from endless_gym_agents.settings import Settings, from_dict

#: Version of a checkpoint's content. It changes when an older checkpoint can no longer be resumed or evaluated.
CHECKPOINT_VERSION = 1

#: Names inside the folder of a run: the settings, the folder of the checkpoints, and the last checkpoint in it.
SETTINGS = "settings.json"
FOLDER = "checkpoints"
LAST = "last.pt"


@dataclass
class Checkpoint:
    """A loaded checkpoint.

    Attributes:
        settings: Settings of the run.
        agent: The agent with the weights of the checkpoint, in evaluation mode.
        update: Number of updates so far.
        steps: Number of environment steps so far.
        state: The saved state; see `save`.
    """

    settings: Settings
    agent: Agent
    update: int
    steps: int
    state: dict[str, Any]


def save(run: Path, state: dict[str, Any], keep: bool) -> Path:
    """Write a checkpoint as the last one of a run, atomically.

    Args:
        run: Folder of the run.
        state: `settings` (from `to_dict`), `update`, `steps`, `model`; and to resume, `optimizer`, `generators`, `player` (the
            state of the rollout collector) and `episodes`.
        keep: Also keep the checkpoint under the number of its update.

    Returns:
        Path of the last checkpoint.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    last, temporary = folder / LAST, folder / f"{LAST}.new"
    torch.save({"version": CHECKPOINT_VERSION} | state, temporary)
    if keep:
        # A hard link: the same file under a second name.
        numbered = folder / f"update-{state['update']:06d}.pt"
        numbered.unlink(missing_ok=True)
        os.link(temporary, numbered)
    os.replace(temporary, last)
    return last


def files(run: str | Path) -> list[Path]:
    """The numbered checkpoints of a run in order of their updates, or the last checkpoint if there are none."""
    folder = Path(run) / FOLDER
    return sorted(folder.glob("update-*.pt")) or [folder / LAST]


def load(path: str | Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Load a checkpoint.

    Args:
        path: A checkpoint file, or the folder of a run for its last checkpoint.
        device: Device of the agent.

    Raises:
        FileNotFoundError: There is no such checkpoint.
        ValueError: The file is not a checkpoint of this version, or its weights are not finite.
    """
    file = Path(path)
    if file.is_dir():
        file = file / FOLDER / LAST
    if not file.exists():
        raise FileNotFoundError(
            f"no checkpoint {file}; expected the folder of a run, or a file of its folder `{FOLDER}`"
        )
    try:
        # `weights_only` reads nothing but tensors and plain values, so an untrusted checkpoint cannot execute code.
        state: dict[str, Any] = torch.load(file, map_location="cpu", weights_only=True)
        version = state.get("version")
        if version == CHECKPOINT_VERSION:
            settings = from_dict(state["settings"])
            agent = make_agent(settings, spec(settings.env), device)
            agent.load_state_dict(state["model"])
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # `torch.load` and `load_state_dict` raise many types
        message = f"{path} is not a checkpoint of this version of endless-train; expected a file of a run's folder `checkpoints`"
        raise ValueError(message) from error
    if version != CHECKPOINT_VERSION:
        raise ValueError(
            f"checkpoint {file} must be of version {CHECKPOINT_VERSION}, got {version}; "
            "use the version of endless-gym that wrote it"
        )
    broken = [name for name, weights in agent.state_dict().items() if not bool(weights.isfinite().all())]
    if broken:
        raise ValueError(
            f"checkpoint {file} has weights that are not finite, in {broken[0]}: its run had diverged; use an earlier "
            "checkpoint, or train again with a smaller --ppo.learning-rate"
        )
    agent.eval()
    return Checkpoint(settings, agent, state["update"], state["steps"], state)


def start_from(agent: Agent, path: str | Path) -> str:
    """Copy the weights of a checkpoint into an agent. The encoder and the heads keep their values where the shapes differ.

    Returns:
        A line of text that says which weights were copied.

    Raises:
        FileNotFoundError: As for `load`.
        ValueError: As for `load`, or the memories or the layers after them differ.
    """
    own = agent.state_dict()
    given = load(path).agent.state_dict()
    fitting = {name: part for name, part in given.items() if name in own and own[name].shape == part.shape}
    missing = sorted(own.keys() - fitting.keys())
    core = [name for name in missing if name.startswith(("memory.", "body."))]
    if core or not fitting:
        raise ValueError(
            f"--init-from {path}: its {', '.join(core)} do not fit this agent's; use the same --agent and sizes"
        )
    agent.load_state_dict(own | fitting)
    others = f"; newly initialised: {', '.join(missing)}" if missing else ""
    return f"started from {len(fitting)} of {len(own)} tensors of {path}{others}"


def read_settings(run: str | Path) -> Settings:
    """Read the settings of the run in folder `run`.

    Raises:
        FileNotFoundError: The folder contains no run.
        ValueError: The run is of another program, or of another version of this one.
    """
    if not (Path(run) / SETTINGS).exists():
        raise FileNotFoundError(f"no run in {run}; expected a folder with {SETTINGS}, as endless-train writes it")
    try:
        return from_dict(json.loads((Path(run) / SETTINGS).read_text()))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{Path(run) / SETTINGS} is not of this version of endless-train ({error})") from None
