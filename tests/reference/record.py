"""Records the episodes of this folder in the original, whose traces have the options and the policies.

    python record.py OUT                                      # all of them, to compare them with those of this folder
    python record.py OUT --salt more --only MysteryPath-v0    # others: the salt varies seeds and actions
    python record.py OUT --only MysteryPath-v0 --options '{"max_steps": 50}'    # two more, with these options

Writes OUT/traces, OUT/views and OUT/frames in the format that README.md describes. Recordings with options that the
installed version of memory-gym lacks are skipped, and listed on standard error.
"""

import argparse
import gzip
import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy
from original import Original
from policies import POLICIES

Options = dict[str, Any]

#: Number of frames kept for each id, and the policy of the trace that they come from.
FRAMES = 40
FRAMES_OF = "mixed20"


class Kind(NamedTuple):
    """One folder of recordings."""

    folder: str
    salt: str
    episodes: int
    #: Maximum number of steps of an episode.
    steps: int
    #: Whether the ground-truth view is recorded, too.
    views: bool


TRACES = Kind("traces", salt="a", episodes=6, steps=700, views=False)
VIEWS = Kind("views", salt="render", episodes=2, steps=200, views=True)


class Plan(NamedTuple):
    """One environment object with its options and its player."""

    env_id: str
    number: int
    options: Options
    policy: str

    def __str__(self) -> str:
        return f"{self.env_id}.{self.number:02d}.{self.policy}"

    def kinds(self) -> list[Kind]:
        """The kinds of recordings made of it."""
        return [TRACES] if self.options or self.policy == "constant" else [TRACES, VIEWS]

    def record(self, kind: Kind) -> tuple[dict[str, Any], list[Any]]:
        """Play the episodes. Returns the trace and its frames."""
        original = Original(self.env_id, self.options)
        rng = Random(f"{self.env_id}|{self.policy}|{kind.salt}|{json.dumps(self.options, sort_keys=True)}")
        first_seed = zlib.crc32(kind.salt.encode()) % 90000 + 100 * self.number
        episodes: list[Any] = []
        frames: list[Any] = []
        for episode in range(kind.episodes):
            # Every second episode has no seed and continues the generator.
            seed = first_seed + episode if episode % 2 == 0 else None
            actions = (POLICIES[self.policy](original.env, rng) for _ in range(kind.steps))
            episodes.append(original.episode(seed, actions, kind.views, frames))
        return {"env": self.env_id, "options": self.options, "policy": self.policy, "episodes": episodes}, frames


def plans(only: str | None, further: list[Options]) -> Iterator[Plan]:
    """Those of this folder: every policy with the default options, then two policies with each other set of options."""
    number = -1
    for path in sorted((Path(__file__).parent / "traces").glob(f"{only or '*'}.*.json.gz")):
        trace = json.loads(gzip.decompress(path.read_bytes()))
        number = int(path.name.split(".")[1])
        yield Plan(trace["env"], number, trace["options"], trace["policy"])
    others: list[tuple[Options, str]] = [] if number >= 0 else [({}, policy) for policy in POLICIES]
    others += [(options, policy) for options in further for policy in ("mixed02", "random")]
    for place, (options, policy) in enumerate(others, number + 1):
        yield Plan(only or "", place, options, policy)


def write(path: Path, data: bytes) -> None:
    """Write a gzip file without a timestamp, so that equal recordings give equal files."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(gzip.compress(data, 9, mtime=0))


def main() -> None:
    """Record what the command line requests."""
    parser = argparse.ArgumentParser(description="Record episodes in the original environments.")
    parser.add_argument("out", type=Path, help="folder to write to")
    parser.add_argument("--salt", help="text that varies seeds and actions (default: that of the recordings)")
    parser.add_argument("--only", metavar="ID", help="one environment (default: all)")
    parser.add_argument("--options", type=json.loads, action="append", default=[], help="others of --only, as JSON")
    arguments = parser.parse_args()
    if arguments.options and not arguments.only:
        parser.error("--options needs --only")
    for plan in plans(arguments.only, arguments.options):
        if missing := plan.options.keys() - Original(plan.env_id, {}).parameters:
            print(f"{plan}: left out, this version has no {', '.join(missing)}", file=sys.stderr)
            continue
        for kind in plan.kinds():
            trace, frames = plan.record(kind._replace(salt=arguments.salt or kind.salt))
            text = json.dumps(trace, separators=(",", ":"))
            write(arguments.out / kind.folder / f"{plan}.json.gz", text.encode())
            if kind is TRACES and not plan.options and plan.policy == FRAMES_OF:
                write(arguments.out / "frames" / f"{plan.env_id}.gz", numpy.stack(frames[:FRAMES]).tobytes())
        print(plan, flush=True)


if __name__ == "__main__":
    main()
