"""Compares hyperparameters for 1,024 environments with those of the preset `paper`, by learning per environment step, on the CPU.

    python preset.py runs        # the same command again resumes what was interrupted

Networks and batches are an eighth as large as on a GPU, so that their ratio is the same: a GRU of 64 units, 128 environments with
rollouts of 128 steps, and 4 environments with 512 for `paper`. All runs have 2,097,152 steps from feature observations, by
`endless learn`. `gpu/preset.json` has each run's mean reward, over the whole run and over the last tenth of its updates.
"""

import json
import statistics
import subprocess
import sys
from pathlib import Path

from endless_gym.program import program
from endless_gym_agents.common.command import on_stop_signals
from endless_gym_agents.training.logs import read_progress

SEEDS = (1, 2, 3)
STEPS = 2_097_152
TASKS = {
    "MortarMayhem-Grid-v0": ["command_count=[2]"],
    "MysteryPath-Grid-v0": ["show_origin=true", "show_goal=true", "reward_path_progress=0.1"],
}
SMALL = (
    "--preset paper --threads 1 --stop-when-learnt=false --environment.observation features --recurrence.hidden-size 64 "
    "--model.vector-width 64 --model.head-width 64"
)
#: Minibatches and multiple of the paper's learning rates.
CHOICES = ((8, 1), (8, 3), (32, 1), (32, 2), (64, 1))


def flags(minibatches: int, rate: int) -> str:
    """The flags that differ from the preset `paper`."""
    updates = STEPS // (128 * 128)
    return (
        f"--environment.num-envs 128 --ppo.steps 128 --ppo.updates {updates} --ppo.decay-updates {updates} "
        f"--ppo.minibatches {minibatches} --ppo.learning-rate {2.75e-4 * rate:f} --ppo.final-learning-rate {1e-5 * rate:f}"
    )


def main(folder: Path) -> None:
    """Run what is missing, and write the results."""
    updates = STEPS // (4 * 512)
    choices = {"paper": f"--environment.num-envs 4 --ppo.updates {updates} --ppo.decay-updates {updates}"}
    choices |= {f"{n} minibatches, rate x {rate}": flags(n, rate) for n, rate in CHOICES}
    rows = []
    for env, options in TASKS.items():
        for name, own in choices.items():
            for seed in SEEDS:
                run = folder / f"{env}-{name.replace(' ', '').replace(',', '-')}-{seed}"
                place = ["--resume" if run.exists() else "--run", str(run)]
                given = [word for option in options for word in ("--environment.option", option)]
                words = ["learn", env, "--seed", str(seed), *SMALL.split(), *given, *own.split(), *place]
                if not run.exists() or read_progress(run)[-1]["steps"] < STEPS:
                    subprocess.run([*program(), *words], check=True)
                rewards = [row["episode/reward"] for row in read_progress(run)]
                end, mean = statistics.mean(rewards[-max(1, len(rewards) // 10) :]), statistics.mean(rewards)
                rows.append({"env": env, "name": name, "seed": seed, "end": round(end, 4), "mean": round(mean, 4)})
                print(rows[-1], flush=True)
    Path(__file__).with_name("gpu").joinpath("preset.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    # An exception ends the program that learns; the default action of SIGTERM would leave it running.
    with on_stop_signals(lambda number, _: sys.exit(128 + number)):
        main(Path(sys.argv[1]))
