"""Compares steps per second with the original, from Rust and Python: whole episodes, random actions, medians.

cargo xtask bench                      # installs the requirements and runs this script; other arguments are passed to it
cargo xtask bench --markdown t.md --json t.json

Requires Python 3.11 with this package and `stable-baselines3`, and another Python 3.11 (`--original`) with
`memory-gym`. The original pins Gymnasium 0.29 and numpy 1. Its environments run in a process of this Python whose
PYTHONPATH lists the packages of the other Python first; Stable-Baselines3 comes from this Python. Each round measures
every contender once, so that the load of other programs affects all of them.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import endless_gym
from endless_gym import _native
from endless_gym.program import program

IDS = ["Endless-MortarMayhem-v0", "Endless-MysteryPath-v0", "Endless-SearingSpotlights-v0"]
VECTORS = ["SyncVectorEnv", "AsyncVectorEnv", "SubprocVecEnv"]
SIZES = [64, 1024]


class Original:
    """The process that runs the original."""

    def __init__(self, python: str) -> None:
        where = "import sys, sysconfig; print(sys.version_info[:2] == (3, 11), sysconfig.get_path('purelib'))"
        right, packages = subprocess.check_output([python, "-c", where], text=True).split(maxsplit=1)
        if right != "True" or sys.version_info[:2] != (3, 11):
            sys.exit("this script and --original must both be Python 3.11, since they share packages")
        self._process = subprocess.Popen(
            [sys.executable, "-W", "ignore", str(Path(__file__).with_name("comparison_original.py"))],
            env={**os.environ, "PYTHONPATH": packages.strip(), "OMP_NUM_THREADS": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )

    def measure(self, kind: str, id: str, num_envs: int, seconds: float) -> float:
        """Steps per second of one kind of environment: `single`, `independent` or a vector environment."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        asked = {"kind": kind, "id": id, "num_envs": num_envs, "seconds": seconds}
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        answer = self._process.stdout.readline()
        if not answer:
            sys.exit(f"the process of the original ended during {asked}; its command was {self._process.args!r}")
        return float(answer)

    def best(self, kind: str, id: str, seconds: float) -> int:
        """The number of environments with the highest steps per second."""
        cores = _native.cores()
        numbers = {1, cores, 2 * cores, 4 * cores, 16, 64}
        return max(sorted(numbers), key=lambda number: self.measure(kind, id, number, seconds))


def vector(make: Any, id: str, num_envs: int, threads: int, seconds: float) -> float:
    """Steps per second of `make_vec` or `serve`, after a short warm-up."""
    with make(id, num_envs, num_threads=threads or None) as envs:
        envs.reset(seed=0)
        envs.action_space.seed(0)
        actions = [np.asarray(envs.action_space.sample()) for _ in range(64)]
        for action in actions[:20]:
            envs.step(action)
        steps, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            envs.step(actions[steps % len(actions)])
            steps += 1
        return steps * num_envs / (time.perf_counter() - start)


def single(id: str, seconds: float) -> float:
    """Steps per second of one environment."""
    env = gymnasium.make(f"EndlessGym/{id}")
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(1009)]
    env.reset(seed=0)
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        if env.step(actions[steps % len(actions)])[2]:
            env.reset()
        steps += 1
    return steps / (time.perf_counter() - start)


def rust(id: str, num_envs: int, threads: int, seconds: float) -> dict[str, float]:
    """Steps per second from `endless bench`, by method."""
    arguments = {"env": id, "num-envs": num_envs, "threads": threads, "seconds": seconds, "rounds": 1}
    command = [*program(), "bench", "--json", *(f"--{name}={value}" for name, value in arguments.items())]
    (row,) = json.loads(subprocess.check_output(command, stderr=subprocess.DEVNULL))
    return {
        f"Rust, {entry['method']}, {num_envs} environments": entry["steps_per_second"] for entry in row["measurements"]
    }


def compare(id: str, original: Original, args: argparse.Namespace) -> dict[str, Any]:
    """Measure all contenders for one environment id."""
    cores = _native.cores()
    best = {kind: original.best(kind, id, args.seconds / 2) for kind in VECTORS}
    contenders: dict[str, Any] = {}
    for kind in VECTORS:
        contenders[f"original, {kind}, {best[kind]} environments"] = (original.measure, kind, id, best[kind])
    contenders[f"original, {cores} independent processes"] = (original.measure, "independent", id, cores)
    contenders["original, gymnasium.make"] = (original.measure, "single", id, 1)
    contenders["gymnasium.make"] = (single, id)
    for size in SIZES:
        contenders[f"make_vec, {size} environments"] = (vector, endless_gym.make_vec, id, size, args.threads)
        contenders[f"serve, {size} environments"] = (vector, endless_gym.serve, id, size, args.threads)
    results: dict[str, list[float]] = {name: [] for name in contenders}
    for number in range(args.rounds):
        for name, (contender, *arguments) in contenders.items():
            progress(f"{id}, round {number + 1} of {args.rounds}: {name}")
            results[name].append(contender(*arguments, args.seconds))
        for size in SIZES:
            progress(f"{id}, round {number + 1} of {args.rounds}: Rust, {size} environments")
            for name, value in rust(id, size, args.threads, args.seconds).items():
                results.setdefault(name, []).append(value)
    progress("")
    medians = {name: statistics.median(values) for name, values in results.items()}
    vectors = {name: median for name, median in medians.items() if any(kind in name for kind in VECTORS)}
    return {
        "id": id,
        "steps_per_second": {name: [round(value) for value in values] for name, values in results.items()},
        "best_original": max(vectors, key=lambda name: vectors[name]),
        "medians": {name: round(median) for name, median in medians.items()},
    }


def markdown(whole: dict[str, Any]) -> str:
    """The results as Markdown."""
    lines = ["# Steps per second compared with the original", ""]
    lines += [f"- {name.replace('_', ' ')}: {value}" for name, value in whole["machine"].items()]
    lines += [f"- medians of {whole['rounds']} rounds of {whole['seconds']} s"]
    for row in whole["environments"]:
        reference = row["medians"][row["best_original"]]
        lines += ["", f"## {row['id']}", "", "| | steps/s | lowest | highest | x best vectorised original |"]
        lines += ["| --- | ---: | ---: | ---: | ---: |"]
        for name, values in row["steps_per_second"].items():
            median = row["medians"][name]
            lines.append(f"| {name} | {median:,} | {min(values):,} | {max(values):,} | {median / reference:.1f} |")
    return "\n".join(lines) + "\n"


def machine() -> dict[str, Any]:
    """The machine and the versions."""
    models = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": models[0].split(":")[1].strip() if models else platform.machine(),
        "cores": _native.cores(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "endless_gym": endless_gym.__version__,
        "date": datetime.date.today().isoformat(),
        "load_average": os.getloadavg()[0],
    }


def progress(text: str) -> None:
    """Print the current measurement if stderr is a terminal."""
    if sys.stderr.isatty():
        print(f"\r{text:110}\r", end="", file=sys.stderr, flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--original", required=True, metavar="PYTHON", help="Python interpreter with memory-gym 1.0.2")
    parser.add_argument("--ids", nargs="+", default=IDS, metavar="ID", help="environment ids (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each contender (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=1.0, help="seconds of each measurement (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=0, help="engine threads; 0 for one per core (default: 0)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write all results to this file")
    parser.add_argument("--markdown", type=Path, metavar="FILE", help="also write the tables to this file, as Markdown")
    args = parser.parse_args()
    whole = {"machine": machine(), "rounds": args.rounds, "seconds": args.seconds}
    original = Original(args.original)
    whole["environments"] = [compare(id, original, args) for id in args.ids]
    print(markdown(whole))
    if args.markdown:
        args.markdown.write_text(markdown(whole))
    if args.json:
        args.json.write_text(json.dumps(whole, indent=2) + "\n")


if __name__ == "__main__":
    main()
