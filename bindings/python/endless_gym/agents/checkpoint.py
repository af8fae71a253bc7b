"""Checkpoints: all that a run needs to go on, and all that an evaluation needs to act.

```python
agent = checkpoint.load("runs/mine").agent         # the run's last checkpoint; or a checkpoint's file
memory = agent.initial_memory(num_envs)
acted = agent.act(observation, memory)
```
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from endless_gym.agents.agent import Agent, make_agent
from endless_gym.agents.settings import Settings, from_dict
from endless_gym.specs import spec

SETTINGS = "settings.json"
FOLDER = "checkpoints"
LAST = "last.pt"


@dataclass
class Checkpoint:
    """A loaded checkpoint.

    Attributes:
        settings: Of the run.
        agent: With the checkpoint's weights.
        update: Updates that the agent has learned from.
        steps: Steps of environments that these updates saw.
        state: All that was saved; see `save`.
    """

    settings: Settings
    agent: Agent
    update: int
    steps: int
    state: dict[str, Any]


def save(run: Path, state: dict[str, Any], keep: bool) -> Path:
    """Write a checkpoint into a run's folder, as its last one.

    Args:
        run: The run's folder.
        state: `settings` as a dict, `update`, `steps`, `model`, and for going on `optimizer`, `generators`, `player`, `episodes`.
        keep: Keep it under the update's number, too.

    Returns:
        The file.
    """
    folder = run / FOLDER
    folder.mkdir(parents=True, exist_ok=True)
    last, fresh = folder / LAST, folder / f"{LAST}.new"
    torch.save(state, fresh)
    if keep:
        # The same file under two names.
        numbered = folder / f"update-{state['update']:06d}.pt"
        numbered.unlink(missing_ok=True)
        os.link(fresh, numbered)
    os.replace(fresh, last)
    return last


def files(run: str | Path) -> list[Path]:
    """The numbered checkpoints of a run, in order, or its last one if it kept no others."""
    folder = Path(run) / FOLDER
    return sorted(folder.glob("update-*.pt")) or [folder / LAST]


def load(path: str | Path, device: torch.device | str = "cpu") -> Checkpoint:
    """Load a checkpoint.

    Args:
        path: A checkpoint's file, or a run's folder for its last one.
        device: Where the agent is to compute.

    Raises:
        FileNotFoundError: There is none.
    """
    file = Path(path)
    if file.is_dir():
        file = file / FOLDER / LAST
    if not file.exists():
        raise FileNotFoundError(f"no checkpoint {file}; give a run's folder, or a file of its folder `{FOLDER}`")
    # Nothing but tensors, numbers and strings is read: a checkpoint cannot run code.
    state: dict[str, Any] = torch.load(file, map_location="cpu", weights_only=True)
    settings = from_dict(state["settings"])
    agent = make_agent(settings, spec(settings.env), device)
    agent.load_state_dict(state["model"])
    agent.eval()
    return Checkpoint(settings, agent, state["update"], state["steps"], state)


def read_settings(run: str | Path) -> Settings:
    """The settings of a run.

    Raises:
        FileNotFoundError: The folder has no run.
    """
    if not (Path(run) / SETTINGS).exists():
        raise FileNotFoundError(f"no run in {run}; give a folder with {SETTINGS}, as endless-train writes it")
    return from_dict(json.loads((Path(run) / SETTINGS).read_text()))
