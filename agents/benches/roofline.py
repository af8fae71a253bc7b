"""Floating-point operations of training on the CPU: how many there are, at which rate they run, and the machine's peak.

    python roofline.py --threads 1 --json roofline.json

Collects rollouts and learns with the networks and settings of the preset `paper`, by default with 8 environments and 256 steps.
Every operation that PyTorch dispatches is timed, and the floating-point operations (FLOP) of convolutions, matrix products and
attention are counted by PyTorch's formulas: a multiplication and an addition are two. Other operations count as none; their
time is that of memory traffic and of starting them. The peak is the best rate of a large matrix product on the same threads.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections import defaultdict
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry, sdpa_flop_count

from endless_gym_agents.agent import make_agent
from endless_gym_agents.clock import Clock
from endless_gym_agents.environments import Environments
from endless_gym_agents.ppo import learn, make_optimizer
from endless_gym_agents.rollout import RolloutCollector
from endless_gym_agents.settings import PRESETS, Settings

#: Operations with fewer seconds than this share of the phase are shown together.
SMALL = 0.02


#: PyTorch's attention on the CPU, which its registry of formulas lacks.
ATTENTION = "_scaled_dot_product_flash_attention_for_cpu"


@dataclass
class Cost:
    """What the calls of an operation cost.

    Attributes:
        calls: Number of calls.
        seconds: Their time.
        flop: Their floating-point operations.
    """

    calls: int = 0
    seconds: float = 0.0
    flop: int = 0


@dataclass
class Phase:
    """The costs of a phase: rollout or learning.

    Attributes:
        seconds: Time of the phase without timing each operation.
        operations: Costs by name of the operation.
    """

    seconds: float = 0.0
    operations: dict[str, Cost] = field(default_factory=lambda: defaultdict(Cost))

    @property
    def flop(self) -> int:
        """Floating-point operations of the phase."""
        return sum(cost.flop for cost in self.operations.values())


class Meter(TorchDispatchMode):
    """Context that times the operations and counts their FLOP."""

    def __init__(self, operations: dict[str, Cost]) -> None:
        """Add to `operations`."""
        super().__init__()
        self.operations = operations

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Run an operation."""
        start = time.perf_counter()
        out = operation(*args, **(kwargs or {}))
        cost = self.operations[operation.overloadpacket.__name__]
        cost.seconds += time.perf_counter() - start
        cost.calls += 1
        name, packet = operation.overloadpacket.__name__, operation.overloadpacket
        if name == ATTENTION:
            cost.flop += int(sdpa_flop_count(*(tensor.shape for tensor in args[:3])))
        elif packet in flop_registry:
            cost.flop += int(flop_registry[packet](*args, **(kwargs or {}), out_val=out))
        return out


def peak(dtype: torch.dtype, size: int = 2048) -> float:
    """Floating-point operations per second of a large matrix product, the best of several."""
    one, two = (torch.randn(size, size).to(dtype) for _ in range(2))
    best = 0.0
    for _ in range(8):
        start = time.perf_counter()
        torch.mm(one, two)
        best = max(best, 2 * size**3 / (time.perf_counter() - start))
    return best


def measure(settings: Settings, updates: int) -> dict[str, Phase]:
    """The costs of one update, by phase; the times without the meter are means over `updates` updates."""
    settings = settings.validated()
    phases = {"rollout": Phase(), "learning": Phase()}
    torch.manual_seed(1)
    with Environments(settings) as environments:
        agent = make_agent(settings, environments.spec)
        optimizer = make_optimizer(agent, settings.ppo.learning_rate)
        collector = RolloutCollector(agent, environments, settings.ppo.steps, torch.Generator().manual_seed(1))
        shuffle = torch.Generator().manual_seed(1)

        def rollout() -> Any:
            return collector.collect(Clock())[0]

        def learning(segment: Any) -> None:
            learn(agent, optimizer, segment, [memory.state for memory in collector.memories], 0, settings.ppo, shuffle)

        learning(rollout())  # warm-up
        for _ in range(updates):
            start = time.perf_counter()
            segment = rollout()
            between = time.perf_counter()
            learning(segment)
            phases["rollout"].seconds += (between - start) / updates
            phases["learning"].seconds += (time.perf_counter() - between) / updates
        with Meter(phases["rollout"].operations):
            segment = rollout()
        with Meter(phases["learning"].operations):
            learning(segment)
    return phases


def table(title: str, phase: Phase, best: float) -> Table:
    """The operations of a phase, by time."""
    shown = Table(title=title, title_justify="left")
    for name in ("operation", "calls", "seconds", "share", "GFLOP", "GFLOP/s", "of the peak"):
        shown.add_column(name, justify="left" if name == "operation" else "right")
    timed = sum(cost.seconds for cost in phase.operations.values())
    rest = Cost()

    def add(name: str, cost: Cost) -> None:
        rate = cost.flop / cost.seconds if cost.seconds else 0.0
        numbers = (f"{cost.flop / 1e9:,.1f}", f"{rate / 1e9:,.1f}", f"{rate / best:.0%}") if cost.flop else ("", "", "")
        shown.add_row(name, f"{cost.calls:,}", f"{cost.seconds:.3f}", f"{cost.seconds / timed:.0%}", *numbers)

    for name, cost in sorted(phase.operations.items(), key=lambda item: -item[1].seconds):
        if cost.seconds < SMALL * timed and not cost.flop:
            rest = Cost(rest.calls + cost.calls, rest.seconds + cost.seconds)
        else:
            add(name, cost)
    add("others", rest)
    rate = phase.flop / phase.seconds
    shown.caption = (
        f"{phase.seconds:.2f} s without timing the operations: {phase.flop / 1e9:,.0f} GFLOP at {rate / 1e9:,.1f} GFLOP/s, "
        f"{rate / best:.0%} of the peak"
    )
    return shown


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Endless-MortarMayhem-v0", help="environment id (default: %(default)s)")
    parser.add_argument("--agents", nargs="+", default=["gru", "trxl"], help="agents (default: gru trxl)")
    parser.add_argument("--num-envs", type=int, default=8, help="number of environments (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=256, help="steps of a rollout (default: %(default)s)")
    parser.add_argument(
        "--threads", type=int, default=1, help="threads of PyTorch and the engine (default: %(default)s)"
    )
    parser.add_argument("--updates", type=int, default=2, help="updates that are timed (default: %(default)s)")
    parser.add_argument("--bf16", action="store_true", help="compute in bfloat16; the peak is that of bfloat16, too")
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    given = parser.parse_args()
    torch.set_num_threads(given.threads)
    console, results = Console(width=120), []
    best = peak(torch.bfloat16 if given.bf16 else torch.float32)
    console.print(f"peak on {given.threads} threads: {best / 1e9:,.0f} GFLOP/s; load {os.getloadavg()[0]:.1f}")
    for agent in given.agents:
        settings = replace(PRESETS["paper"], env=given.env, agent=agent, bf16=given.bf16)
        settings = replace(
            settings,
            environment=replace(settings.environment, num_envs=given.num_envs, num_threads=given.threads),
            ppo=replace(settings.ppo, steps=given.steps),
        )
        for name, phase in measure(settings, given.updates).items():
            console.print(table(f"{agent}, {name}, {given.num_envs} x {given.steps} steps", phase, best))
            operations = {key: vars(cost) for key, cost in phase.operations.items()}
            results.append({"agent": agent, "phase": name, "seconds": phase.seconds, "operations": operations})
    if given.json:
        described = {key: value for key, value in vars(given).items() if key != "json"}
        machine = {"processor": platform.processor(), "torch": torch.__version__, "peak": best}
        given.json.write_text(json.dumps({"settings": described, **machine, "results": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
