"""What the commands have in common: how they fail and how they stop."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import torch

from endless_gym.agents import checkpoint

#: The exit status of a program that Ctrl-C has stopped, as shells have it.
INTERRUPTED = 130


def run(name: str, work: Callable[[], object]) -> int:
    """Run a command's work; what the user can put right becomes one line.

    Returns:
        The exit status.
    """
    try:
        work()
    except KeyboardInterrupt:
        print(f"{name}: stopped", file=sys.stderr)
        return INTERRUPTED
    except ModuleNotFoundError as error:
        print(
            f"{name}: {error.name} is not installed; the agents need: pip install 'endless-gym[agents]'",
            file=sys.stderr,
        )
        return 1
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


def load_checkpoint(path: Path, device: torch.device | str) -> checkpoint.Checkpoint:
    """A checkpoint's agent.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is something else.
    """
    try:
        return checkpoint.load(path, device)
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # torch.load raises what its parts raise
        message = (
            f"{path} is not a checkpoint of this version's `endless-train`; give a file of a run's folder `checkpoints`"
        )
        raise ValueError(message) from error


def description(text: str | None) -> str:
    """A module's text for its command's help, without the examples."""
    return (text or "").split("```")[0].strip()
