"""End-to-end training throughput on the CPU: `endless-train` compared with CleanRL's ppo_trxl.

    python speed.py --original PYTHON --cleanrl FOLDER

PYTHON is an interpreter with the original (memory-gym 1.0.2), torch, and the dependencies of CleanRL's ppo_trxl; FOLDER is
CleanRL's folder `ppo_trxl`. Both programs use the same numbers of environments, steps, minibatches, epochs and threads and the
same window, and run alternately. The time from the end of the first update to the end of the last is measured in seconds, and
in CPU seconds of all processes, which are less sensitive to other load on the machine. CleanRL's network lacks the 512 hidden
units of the policy and value heads.
"""

import argparse
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from endless_gym_agents.common import atomic


def cpu_seconds(session: int) -> float:
    """CPU time of all running processes of a session, in seconds."""
    ticks = 0
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # the process has ended
        if int(fields[3]) == session:
            ticks += sum(map(int, fields[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def timed(command: list[str], threads: int, pattern: str, folder: str) -> list[tuple[float, float]]:
    """Run a command; returns the wall time and the CPU time at each output line that matches `pattern`."""
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "SDL_VIDEODRIVER": "dummy", "PYTHONUNBUFFERED": "1"}
    if command[0] != sys.executable:
        environment.pop("PYTHONPATH", None)
    times = []
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
        cwd=folder,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if re.search(pattern, line):
                times.append((time.perf_counter(), cpu_seconds(process.pid)))
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} ended with status {process.returncode}")
    return times


def rate(times: list[tuple[float, float]], batch: int) -> tuple[float, float]:
    """Steps per second and per CPU second; the first update is excluded as warm-up."""
    (first, first_cpu), (last, last_cpu) = times[0], times[-1]
    steps = batch * (len(times) - 1)
    return steps / (last - first), steps / (last_cpu - first_cpu)


def main() -> None:
    """Measure, print and write the throughput."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--original", required=True, help="Python interpreter with the original")
    parser.add_argument("--cleanrl", type=Path, required=True, help="CleanRL's folder ppo_trxl")
    parser.add_argument("--env", default="Endless-MortarMayhem-v0", help="environment id (default: %(default)s)")
    parser.add_argument("--num-envs", type=int, default=8, help="number of environments (default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, default=128, help="rollout length: steps per environment and update (default: %(default)s)"
    )
    parser.add_argument(
        "--window", type=int, default=256, help="attention window of the Transformer-XL (default: %(default)s)"
    )
    parser.add_argument("--updates", type=int, default=3, help="updates of each run (default: %(default)s)")
    parser.add_argument(
        "--threads", type=int, default=1, help="CPU threads of PyTorch and of the engine (default: %(default)s)"
    )
    parser.add_argument("--bf16", action="store_true", help="`endless-train` computes in bfloat16, CleanRL in float32")
    parser.add_argument("--rounds", type=int, default=2, help="runs of each program (default: %(default)s)")
    parser.add_argument("--output", type=Path, help="also write the results to this JSON file")
    args = parser.parse_args()
    batch = args.num_envs * args.steps
    sides: dict[str, list[tuple[float, float]]] = {"endless": [], "other": []}
    shares: dict[str, float] = {}
    for _ in range(args.rounds):
        with tempfile.TemporaryDirectory() as folder:
            ours = [
                *(sys.executable, "-m", "endless_gym_agents.train", "--env", args.env, "--agent", "trxl"),
                *(f"--environment.num-envs={args.num_envs}", "--environment.groups=1", f"--ppo.steps={args.steps}"),
                *(f"--ppo.updates={args.updates}", f"--transformer.window={args.window}", "--device=cpu"),
                *(f"--threads={args.threads}", f"--environment.num-threads={args.threads}", f"--run={folder}/run"),
                *(["--bf16"] if args.bf16 else []),
            ]
            sides["endless"].append(rate(timed(ours, args.threads, r"steps/s|/s  ", folder), batch))
            lines = Path(f"{folder}/run/progress.jsonl").read_text().splitlines()
            progress = [json.loads(line) for line in lines][1:]
            spent = {key[8:]: sum(row[key] for row in progress) for key in progress[0] if key.startswith("seconds/")}
            shares = {key: seconds / sum(spent.values()) for key, seconds in spent.items()}
            other = [
                *(args.original, str(args.cleanrl.resolve() / "ppo_trxl.py"), "--env-id", args.env),
                *(f"--num-envs={args.num_envs}", f"--num-steps={args.steps}", "--no-cuda"),
                *(f"--total-timesteps={batch * args.updates}", f"--trxl-memory-length={args.window}"),
            ]
            sides["other"].append(rate(timed(other, args.threads, r"SPS=", folder), batch))
    row = {
        **{"agent": "trxl", "against": "CleanRL ppo_trxl", "rounds": sides},
        **{"shares_of_time": shares, "load": os.getloadavg()[0]},
    }
    for column, unit in enumerate(("second", "CPU second")):
        one, two = (statistics.median(pair[column] for pair in sides[side]) for side in ("endless", "other"))
        row[f"steps per {unit}"] = {"endless-train": one, "other": two, "times": one / two}
        print(f"{one:.1f} steps per {unit}, CleanRL ppo_trxl {two:.1f}: {one / two:.1f} times", flush=True)
    print(", ".join(f"{key} {share:.1%}" for key, share in shares.items()), flush=True)
    if args.output:
        settings = {
            key: str(value) for key, value in vars(args).items() if key not in ("original", "cleanrl", "output")
        }
        atomic.write(args.output, json.dumps({"settings": settings, "results": [row]}, indent=1) + "\n")


if __name__ == "__main__":
    main()
