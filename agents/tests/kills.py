"""Kills a run at each of its calls that change a file, and continues it: `LD_PRELOAD=kill_at.so python kills.py FOLDER`."""

import ctypes
import itertools
import os
import re
import shutil
import signal
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

# Each forked process would import them for seconds.
import torch._dynamo
import torch.utils.tensorboard  # noqa: F401
from agents_helpers import assert_equal_runs, small

from endless_gym_agents.training.train import train


def ended(work: Callable[[], object]) -> int:
    """Do the work in a process of its own, and return 0 or the signal that has ended it."""
    process = os.fork()
    if not process:
        try:
            work()
            os._exit(0)
        except Exception:
            traceback.print_exc()
        finally:
            os._exit(1)
    status = os.waitpid(process, 0)[1]
    assert status in (0, signal.SIGKILL), status
    return status


def main() -> None:
    """Kill and continue a new run, and a run that resumes."""
    folder, library = Path(sys.argv[1]), ctypes.CDLL(None)
    run, whole, half = (folder / name for name in ("run", "whole", "half"))
    given = replace(small("gru", run), keep_checkpoints=True, checkpoint_megabytes=0.04)
    resume = replace(given, run="", resume=str(run))
    ended(lambda: train(replace(given, run=str(whole))))
    ended(lambda: train(replace(given, run=str(half), ppo=replace(given.ppo, updates=2))))
    with (half / "progress.jsonl").open("a") as file:
        file.write('{"update": 3}\n{"upda')

    def killed(number: int) -> None:
        library.kill_at(os.fsencode(run), number)
        train(resume if run.exists() else given)

    for is_resumed in (False, True):
        for number in itertools.count(1):
            shutil.rmtree(run, ignore_errors=True)
            if is_resumed:
                shutil.copytree(half, run)
            status = ended(lambda number=number: killed(number))
            again = resume if (run / "settings.json").exists() else given
            assert ended(lambda again=again: train(again)) == 0, f"after call {number}"
            assert_equal_runs(run, whole, f"after call {number}")
            files = [sorted((each / "checkpoints").iterdir()) for each in (run, whole)]
            # Without the checksums of parts, which differ as the settings have the folder of the run.
            names = [[re.sub("-[0-9a-f]{8}$", "", file.name) for file in each] for each in files]
            assert names[0] == names[1], f"{names} after call {number}"
            if status == 0:
                break
        print(f"{number - 1} kills")


if __name__ == "__main__":
    main()
