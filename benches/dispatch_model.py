"""A discrete-event model of how a step is divided among threads: `python benches/dispatch_model.py`.

It compares the division by one queue under a mutex, where the caller unparks every worker, with the present one, where every
thread has a share of its own and takes pieces of the others' when it is done (`engine/core/src/pool/division.rs`).

Some of the default costs are measured, others assumed: see `Costs`. All workers spin when the step begins. Times are in
nanoseconds.
"""

from __future__ import annotations

import heapq
import math
from collections import defaultdict
from dataclasses import dataclass

#: Instructions and cache lines that one environment's step takes, of the table in ARCHITECTURE.md, "What a step costs".
WORK = {
    "MysteryPath-Grid-v0": (1_670, 15),
    "Endless-MortarMayhem-v0": (2_280, 55),
    "SearingSpotlights-v0": (5_430, 111),
}


#: Shares that are divided together.
SHARES_IN_GROUP = 8


@dataclass(frozen=True)
class Costs:
    """Costs of a machine.

    `line`, `next_line` and `lock` are those of `cargo bench --bench handover` on two cores of an Intel Granite Rapids, and
    `instructions_per_ns` is what Searing Spotlights reached there in the caches. The others are assumed.
    """

    #: A cache line that another core has written.
    line: float = 210.0
    #: Each further reader of a line that was just written, and each of several lines read at once.
    next_line: float = 10.0
    #: Locking and unlocking a mutex that is in the core's cache.
    lock: float = 17.0
    #: An unpark of a worker that is not parked.
    unpark: float = 10.0
    #: Dividing a range into two.
    split: float = 20.0
    #: Making a share.
    share: float = 5.0
    #: Instructions of one core.
    instructions_per_ns: float = 8.0
    #: Bytes that all cores together read and write, in a nanosecond (GB/s).
    bandwidth: float = 200.0


@dataclass(frozen=True)
class Step:
    """A predicted step."""

    envs: int
    threads: int
    total: float
    #: Time before the caller's first environment and after the last environment of all.
    serial: float
    #: Time that all threads together wait for a lock or a line that another one uses.
    waiting: float
    #: Time that all threads together spend in environments.
    work: float

    @property
    def steps_per_second(self) -> float:
        return self.envs / self.total * 1e9

    @property
    def efficiency(self) -> float:
        """Share of all threads' time that is spent in environments."""
        return self.work / (self.threads * self.total)

    @property
    def serial_share(self) -> float:
        return self.serial / self.total


class Resources:
    """Locks and lines that one thread uses at a time, in the order of the requests."""

    def __init__(self) -> None:
        self.free: defaultdict[object, float] = defaultdict(float)
        self.waiting = 0.0

    def use(self, name: object, now: float, cost: float) -> float:
        """When a thread that asks now has used it."""
        start = max(now, self.free[name])
        self.waiting += start - now
        self.free[name] = start + cost
        return start + cost


def env_time(costs: Costs, name: str, threads: int) -> float:
    """One environment on one of so many threads: instructions, or its share of the bandwidth. A written line is read before."""
    instructions, lines = WORK[name]
    return max(instructions / costs.instructions_per_ns, threads * lines * 128 / costs.bandwidth)


def one_queue(costs: Costs, env: float, envs: int, threads: int, piece: int = 16) -> Step:
    """The old division."""
    if threads == 1:
        return alone(env, envs)
    threads = min(threads, -(-envs // piece))
    resources = Resources()
    opened = 2 * costs.lock + costs.line
    begin = opened + (threads - 1) * costs.unpark
    events = [(begin, 0)]
    for worker in range(1, threads):
        seen = opened + costs.line + worker * costs.next_line
        # The mutex, the task and the counter of the workers that have joined.
        events.append((resources.use("open", seen, 2 * costs.line + costs.lock), worker))
    heapq.heapify(events)
    left, ended, last = envs, 0.0, 0.0
    while events:
        now, thread = heapq.heappop(events)
        # The mutex and what is left: the range takes four lines.
        now = resources.use("queue", now, costs.lock + costs.line + 4 * costs.next_line)
        if left:
            taken = min(piece, left)
            left -= taken
            last = max(last, now + taken * env)
            heapq.heappush(events, (now + taken * env, thread))
        else:
            ended = max(ended, now if thread == 0 else resources.use("joined", now, costs.line))
    total = ended + costs.line
    return Step(envs, threads, total, begin + total - last, resources.waiting, envs * env)


def shares(costs: Costs, env: float, envs: int, threads: int) -> Step:
    """The present division."""
    if threads == 1:
        return alone(env, envs)
    threads = min(threads, envs // 16)
    resources = Resources()
    left = [envs * (share + 1) // threads - envs * share // threads for share in range(threads)]
    pieces = [min(max(share // 8, 8), 16) for share in left]
    groups = -(-threads // SHARES_IN_GROUP)
    begin = groups * (costs.split + costs.lock)
    begin += 2 * costs.lock + costs.line + 3 * costs.unpark
    # A worker writes that it has joined into a line that the caller has read, and wakes three others.
    joins = 2 * costs.line + 3 * costs.unpark
    events = [(begin + (joins + thread * costs.next_line if thread else 0), thread) for thread in range(threads)]
    heapq.heapify(events)
    holder: dict[int, int] = {}
    # When each group of shares is divided, by the first thread that needs one of them.
    divided: dict[int, float] = {}
    first, ended, last = math.inf, 0.0, 0.0
    while events:
        now, thread = heapq.heappop(events)
        share = thread
        if not left[share]:
            # It reads of 64 shares at once whether they are empty. Writing that one is empty does not wait for the line.
            now += costs.line + threads // 64 * costs.next_line
            order = [(thread + distance) % threads for distance in range(1, threads)]
            share = next((other for other in order if left[other]), -1)
        if share < 0:
            ended = max(ended, now)
            continue
        group = share // SHARES_IN_GROUP
        if group not in divided:
            shares_of_group = min(SHARES_IN_GROUP, threads - group * SHARES_IN_GROUP)
            read = costs.line + 4 * costs.next_line if thread else 0.0
            divided[group] = now + read + costs.lock + shares_of_group * (costs.split + costs.share)
        resources.waiting += max(divided[group] - now, 0.0)
        now = max(now, divided[group])
        moved = holder.get(share, 0) != thread
        holder[share] = thread
        now = resources.use(
            ("share", share), now, costs.lock + costs.split + moved * (costs.line + 4 * costs.next_line)
        )
        if thread == 0:
            first = min(first, now)
        taken = min(pieces[share], left[share])
        left[share] -= taken
        last = max(last, now + taken * env) if taken else last
        heapq.heappush(events, (now + taken * env, thread))
    total = ended + costs.line + threads * costs.next_line
    return Step(envs, threads, total, first + total - last, resources.waiting, envs * env)


def alone(env: float, envs: int) -> Step:
    """The calling thread."""
    return Step(envs, 1, envs * env, 0.0, 0.0, envs * env)


def main() -> None:
    """Prints the predictions."""
    costs = Costs()
    print(costs)
    print(
        "id, environments, threads: million steps per second, serial share and efficiency of the old and the present one"
    )
    for name in WORK:
        for envs in (1_024, 4_096, 16_384):
            for threads in (1, 2, 4, 16, 64, 192):
                # Each thread has 16 environments at least.
                env = env_time(costs, name, min(threads, envs // 16))
                steps = [divide(costs, env, envs, threads) for divide in (one_queue, shares)]
                figures = (f"{s.steps_per_second / 1e6:7.1f} {s.serial_share:4.0%} {s.efficiency:4.0%}" for s in steps)
                print(f"{name:24} {envs:6} {threads:4}  {'   '.join(figures)}")


if __name__ == "__main__":
    main()
