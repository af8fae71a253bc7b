"""Compares the time of a step between two builds: `python benches/compare_builds.py OLD NEW [--env ID ...] [--num-envs N ...]`.

OLD and NEW are programs built by `cargo bench --bench step_profile --no-run`; copy the first before building the
second. Both keep running and take turns of a few milliseconds of CPU time, so that other load affects both equally.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess

#: Environment steps of a turn.
TURN = 32768


class Build:
    """A program that steps on request."""

    def __init__(self, program: str, env: str, num_envs: int) -> None:
        self.steps = max(3, TURN // num_envs)
        self.process = subprocess.Popen(
            [program, "--on-request", env, str(num_envs)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def turn(self) -> float:
        """Takes steps, and returns the CPU time of one environment's step in nanoseconds."""
        assert self.process.stdin is not None and self.process.stdout is not None
        print(self.steps, file=self.process.stdin, flush=True)
        return float(self.process.stdout.readline())

    def stop(self) -> None:
        """Ends the program."""
        self.process.communicate()


def compare(paths: list[str], env: str, num_envs: int, rounds: int) -> str:
    """A row of the table."""
    builds = [Build(path, env, num_envs) for path in paths]
    times: list[list[float]] = [[], []]
    for number in range(rounds):
        # The builds take turns to begin.
        for build in (0, 1) if number % 2 else (1, 0):
            times[build].append(builds[build].turn())
    for each in builds:
        each.stop()
    old, new = map(statistics.median, times)
    first, median, third = statistics.quantiles([new / old for old, new in zip(*times, strict=True)], n=4)
    return f"{env:30} {num_envs:6} {old:8.0f} {new:8.0f} {median:8.3f} {first:8.3f} to {third:.3f}"


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("old", help="program of the first build")
    parser.add_argument("new", help="program of the second build")
    parser.add_argument("--env", nargs="+", default=["SearingSpotlights-v0"], help="ids (default: %(default)s)")
    parser.add_argument(
        "--num-envs", nargs="+", type=int, default=[64, 1024], help="numbers of environments (default: %(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=60, help="turns of each (default: %(default)s)")
    arguments = parser.parse_args()
    print(f"{'nanoseconds a step':30} {'envs':>6} {'old':>8} {'new':>8} {'new/old':>8}   quartiles")
    for env in arguments.env:
        for num_envs in arguments.num_envs:
            print(compare([arguments.old, arguments.new], env, num_envs, arguments.rounds), flush=True)


if __name__ == "__main__":
    main()
