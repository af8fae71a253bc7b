"""Common parts of the commands: error messages, exit statuses and loading of checkpoints."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import torch

from endless_gym_agents import checkpoint

#: Exit status after SIGINT, by the convention of shells: 128 + 2.
INTERRUPTED = 130


def run(name: str, work: Callable[[], object]) -> int:
    """Run a command, and report errors of the user in one line on standard error.

    Args:
        name: Name of the command.
        work: The command. `ValueError`, `OSError`, `ModuleNotFoundError` and `KeyboardInterrupt` are reported without traceback.

    Returns:
        The exit status.
    """
    try:
        work()
    except KeyboardInterrupt:
        print(f"{name}: stopped", file=sys.stderr)
        return INTERRUPTED
    except ModuleNotFoundError as error:
        print(f"{name}: {error.name} is not installed", file=sys.stderr)
        return 1
    except (ValueError, OSError) as error:
        print(f"{name}: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    return 0


def load_checkpoint(path: Path, device: torch.device | str) -> checkpoint.Checkpoint:
    """Load a checkpoint, with an error message for users if the file is none.

    Args:
        path: A checkpoint file, or the folder of a run for its last checkpoint.
        device: Device of the agent.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file is not a checkpoint of this version.
    """
    try:
        return checkpoint.load(path, device)
    except (FileNotFoundError, IsADirectoryError, PermissionError):
        raise
    except Exception as error:  # `torch.load` and `load_state_dict` raise many types
        message = f"{path} is not a checkpoint of this version of endless-train; expected a file of a run's folder `checkpoints`"
        raise ValueError(message) from error


def description(text: str | None) -> str:
    """The part of a module's docstring before its examples, as the description in a command's help."""
    return (text or "").split("```")[0].strip()
