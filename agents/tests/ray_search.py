"""A search of three trials on Ray Tune, two at a time, for `test_agents_ray.py`. The rewards are fixed; the runs are real.

Trial 0 kills its process after update 3, once. Trial 1 has the lowest reward, and waits until trial 0 is complete.
"""

import os
import shutil
import signal
import sys
import time
from pathlib import Path

import optuna

from endless_gym_agents import search
from endless_gym_agents.train import train

#: Mean rewards by the number of epochs.
REWARDS = {3: 1.0, 2: 0.5, 4: 2.0}


def trained(given, watch):
    run, epochs = Path(given.run), given.ppo.epochs
    folder = run.parent
    (folder / "threads").write_text(f"{given.threads} {given.environment.num_threads}")

    def watched(update, means):
        watch(update, {"episode/reward": REWARDS[epochs]})
        if update == 3:
            (folder / f"met-{epochs}").touch()
            while not (folder / "met-3").exists() or not (folder / "met-2").exists():
                time.sleep(0.01)
        if update == 3 and epochs == 3 and not (folder / "killed").exists():
            shutil.copy(run / "progress.jsonl", folder / "killed")
            os.kill(os.getpid(), signal.SIGKILL)
        if update == 4 and epochs == 2:
            study = optuna.load_study(study_name="search", storage=f"sqlite:///{folder / 'study.db'}")
            while not study.get_trials(states=(optuna.trial.TrialState.COMPLETE,)):
                time.sleep(0.05)
        return False

    return train(given, watched)


if __name__ == "__main__":
    search.train = trained
    sys.exit(search.main())
