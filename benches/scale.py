"""Weak scaling of training with `torchrun` on this machine: 1, 2 and 4 ranks with the same number of environments each.

    python benches/scale.py                                  # the GRU agent of the preset quick
    python benches/scale.py --agent trxl -- --ppo.steps 128  # arguments after `--` go to `endless-train`

Each rank has its own cores if there are enough. The upper bound is measured with unconnected runs, as many at once as
ranks, since cores share memory bandwidth, and virtual cores may share a physical one. The gap between the two is
communication and waiting. The first update of a run is not counted. Other load distorts the figures.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

from endless_gym_agents.training.logs import read_progress


def start(ranks: int, folder: Path, cores: list[int], arguments: list[str]) -> subprocess.Popen[bytes]:
    """Start a run with `ranks` ranks on these cores."""
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
    program = [*(launch if ranks > 1 else [sys.executable]), "-m", "endless_gym_agents.train"]
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        return subprocess.Popen(
            [*program, *(["--"] if ranks > 1 else []), *arguments, "--run", str(folder)],
            env=os.environ | {"CUDA_VISIBLE_DEVICES": ""},
            stdout=subprocess.DEVNULL,
            stderr=(folder.with_suffix(".log")).open("w"),
        )
    finally:
        os.sched_setaffinity(0, before)


def steps_per_second(runs: list[tuple[Path, subprocess.Popen[bytes]]]) -> float:
    """Steps per second of all runs together, after they have ended."""
    total = 0.0
    for folder, process in runs:
        if process.wait():
            raise SystemExit(
                f"training ended with status {process.returncode}:\n{folder.with_suffix('.log').read_text()}"
            )
        rows = read_progress(folder)[1:]
        total += len(rows) / sum(1 / row["steps_per_second"] for row in rows)
    return total


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="MortarMayhem-Grid-v0", help="environment id (default: %(default)s)")
    parser.add_argument("--agent", default="gru", help="agent (default: %(default)s)")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4], help="numbers of ranks (default: 1 2 4)")
    parser.add_argument("--num-envs", type=int, default=16, help="environments of each rank (default: %(default)s)")
    parser.add_argument("--cores", type=int, default=1, help="cores of each rank (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=5, help="timed updates (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON (default: a table)")
    parser.add_argument("train", nargs="*", metavar="-- ARGUMENTS", help="further arguments of `endless-train`")
    given = parser.parse_args()
    cores = sorted(os.sched_getaffinity(0))
    shared = ["--preset", "quick", "--env", given.env, "--agent", given.agent, "--device", "cpu", *given.train]
    shared += ["--ppo.updates", str(given.updates + 1), "--no-stop-when-learnt"]
    shared += ["--threads", str(given.cores), "--environment.num-threads", str(given.cores)]
    os.environ["OMP_NUM_THREADS"] = str(given.cores)
    rows = []
    for ranks in given.ranks:
        used = cores[: ranks * given.cores]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            total = [*shared, "--environment.num-envs", str(ranks * given.num_envs)]
            connected = steps_per_second([(folder / "ranks", start(ranks, folder / "ranks", used, total))])
            alone = [*shared, "--environment.num-envs", str(given.num_envs)]
            places = [(folder / f"{run}", (cores[run * given.cores :] or used)[: given.cores]) for run in range(ranks)]
            bound = steps_per_second([(place, start(1, place, some, alone)) for place, some in places])
        rows.append({"ranks": ranks, "cores": len(used), "steps_per_second": connected, "unconnected": bound})
    if given.json:
        print(json.dumps(rows))
        return
    table = Table(
        "ranks", "steps/s", "unconnected runs", "share", title=f"{given.env}, {given.agent}, {len(cores)} cores"
    )
    for row in rows:
        numbers = row["steps_per_second"], row["unconnected"]
        table.add_row(str(row["ranks"]), *(f"{number:,.0f}" for number in numbers), f"{numbers[0] / numbers[1]:.0%}")
    Console().print(table)


if __name__ == "__main__":
    main()
