"""The time of a step of a rollout with small networks: of all of it, and of its operations alone.

    python acting.py --json acting.json

Small networks act for 8 environments with feature observations, on one core. There the number of operations and the Python around
them determine the time, not the arithmetic. For each agent the program prints, in microseconds for each step, as medians of the
repetitions:

* rollout: a step of `RolloutCollector.collect`, with its share of what is done once for a segment, and the environments' step.
* inference: the part of it that the clock counts as `inference`: all but the environments.
* act: a call of `Agent.act`, which also draws the noise and computes the log-probabilities.
* replay: the operations of the step's `inference`, called one after the other with their recorded arguments. Each is called as
  the function or method of PyTorch that has its name. It has no Python of the agents, but that of the calls.

and the number of operations of a step's inference, with and without those that only make a view.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from endless_gym_agents.agent import make_agent
from endless_gym_agents.clock import Clock
from endless_gym_agents.environments import Environments
from endless_gym_agents.rollout import RolloutCollector
from endless_gym_agents.settings import PRESETS, Model, Recurrence, Settings, Transformer

AGENTS = ("gru", "trxl")
ENVS, STEPS = 8, 128


def networks(agent: str) -> Settings:
    """Small networks for feature observations."""
    quick = PRESETS["quick"]
    return replace(
        quick,
        env="Endless-MortarMayhem-v0",
        agent=agent,
        threads=1,
        environment=replace(quick.environment, num_envs=ENVS, groups=1, num_threads=1, observation="features"),
        recurrence=Recurrence(hidden_size=16, sequence_length=8),
        transformer=Transformer(layers=2, width=16, heads=2, window=6, sequence_length=8, positions=64),
        model=Model(vector_width=12, head_width=10),
        ppo=replace(quick.ppo, steps=STEPS),
    )


class Recording(TorchDispatchMode):
    """Context that records operations with their arguments.

    Attributes:
        calls: Each operation's function, arguments and keyword arguments.
        computed: Number of operations that do not only make a view.
    """

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[tuple[Callable[..., Any], Any, Any]] = []
        self.computed = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        result = operation(*args, **kwargs)
        # An operation that only makes a view has no result of its own, and writes into no argument.
        aliases = [value.alias_info for value in operation._schema.returns]
        makes_view = "unsafe" in operation.overloadpacket.__name__ or all(a and not a.is_write for a in aliases)
        self.computed += not makes_view
        self.calls.append((direct(operation, args, kwargs), args, kwargs))
        return result

    def replay(self) -> None:
        """Call the operations again."""
        for function, args, kwargs in self.calls:
            function(*args, **kwargs)


def direct(operation: Any, args: Any, kwargs: Any) -> Callable[..., Any]:
    """The method or function of PyTorch with the operation's name, whose call costs less; else the operation itself."""
    name = operation.overloadpacket.__name__
    for module in (torch.Tensor, torch):
        function = getattr(module, name, None)
        if function is None:
            continue
        copies = [value.clone() if isinstance(value, torch.Tensor) else value for value in args]
        try:
            function(*copies, **kwargs)
        except (TypeError, RuntimeError):
            continue
        return function
    return operation


def microseconds(function: Callable[[], Any], calls: int) -> float:
    """Microseconds of a call."""
    start = time.perf_counter()
    for _ in range(calls):
        function()
    return (time.perf_counter() - start) / calls * 1e6


def measure(name: str, segments: int, repetitions: int) -> dict[str, Any]:
    """The figures of an agent; see the module.

    Args:
        name: The agent.
        segments: Segments of each repetition.
        repetitions: Repetitions, of which the medians are taken.
    """
    settings = networks(name).validated()
    with Environments(settings) as environments:
        torch.manual_seed(1)
        agent = make_agent(settings, environments.spec)
        generator, clock = torch.Generator().manual_seed(1), Clock()
        collector = RolloutCollector(agent, environments, STEPS, generator)
        memory, observation = agent.initial_memory(ENVS), collector.current[0].observation

        def act() -> None:
            agent.memory.begin_segment(memory.state, STEPS)
            for _ in range(STEPS):
                agent.act(observation, memory, generator)

        collector.collect(clock)
        act()
        recording = recorded(collector)
        rows = []
        for _ in range(repetitions):
            clock.take()
            rollout = microseconds(lambda: collector.collect(clock), segments)
            row = {"rollout": rollout, "inference": clock.take()["inference"] / segments * 1e6}
            row["act"] = microseconds(act, segments)
            row = {key: value / STEPS for key, value in row.items()}
            with torch.no_grad():
                row["replay"] = microseconds(recording.replay, segments * STEPS)
            rows.append(row)
    medians = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
    return {"agent": name, **medians, "operations": recording.computed, "with_views": len(recording.calls)}


def recorded(collector: RolloutCollector) -> Recording:
    """The operations of a step in which no episode starts, from the observation to the updated memory."""
    recording, act = Recording(), collector._act

    def recording_act(group: int, step: int, *rest: Any) -> None:
        memory = collector.memories[group]
        if recording.calls or step < STEPS // 2 or memory.reset_mask is not memory.no_reset:
            act(group, step, *rest)
            return
        with recording:
            act(group, step, *rest)

    collector._act = recording_act  # type: ignore[method-assign]
    collector.collect(Clock())
    collector._act = act  # type: ignore[method-assign]
    return recording


def main() -> None:
    """Measure, and print or write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repetitions", type=int, default=7, help="repetitions (default: %(default)s)")
    parser.add_argument(
        "--segments", type=int, default=10, help=f"segments of {STEPS} steps in each repetition (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, help="also write the figures to this file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    # Repeated operations in place go towards zero.
    torch.set_flush_denormal(True)
    rows = [measure(agent, args.segments, args.repetitions) for agent in AGENTS]
    for row in rows:
        times = ", ".join(f"{key} {row[key]:.0f} µs" for key in ("rollout", "inference", "act", "replay"))
        print(f"{row['agent']}: {times}; {row['operations']} operations, {row['with_views']} with views")
    if args.json is not None:
        args.json.write_text(json.dumps({"torch": torch.__version__, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
