"""The agents on CUDA: equality with the CPU, training throughput, and a learning curve. Takes less than eight minutes.

    python on_cuda.py --json on_cuda.json --markdown on_cuda.md

* Equality: each agent computes a rollout's log-probabilities and values, and a minibatch's loss and gradients, on the CPU and on
  the device, in float32 without TF32. The largest difference, relative to the largest value, must be at most 1e-3.
* Copies: frames of all environments from pageable and from page-locked memory to the device.
* Training: steps per second, shares of time, CPU cores in use and peak memory, with networks and frames as in the preset `paper`.
  After a warm-up of one update, a measurement takes `--seconds`, and at least one update.
* Learning: one command of Mortar Mayhem's grid, from frames, until it is learnt.

Each result is written as soon as it is there, so a run that is cut off leaves the others. `--device cpu` runs the parts that need
no GPU with small networks and few steps, to test this program; its numbers mean nothing. The exit status is 1 if there is no CUDA
device, if a result on the device differs from the CPU's, or if a measurement fails.
"""

import argparse
import functools
import itertools
import json
import math
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.agent.encoders import FRAME
from endless_gym_agents.common import atomic
from endless_gym_agents.settings import AGENTS, PPO, PRESETS, Model, Recurrence, Settings, Transformer
from endless_gym_agents.training import losses
from endless_gym_agents.training.logs import read_progress
from endless_gym_agents.training.ppo import minibatch_loss
from endless_gym_agents.training.rollout import Segment
from endless_gym_agents.training.train import choose_device, train

TOLERANCE = 1e-3
ENV = "Endless-MortarMayhem-v0"
#: Environments, steps and bfloat16 of the training measurements; the first are the paper's.
SIZES = ((32, 512, False), (128, 512, False), (1024, 128, True))
#: The same for the test on the CPU.
SMALL = ((4, 16, False), (8, 16, True))
#: Updates before the timed ones.
WARM_UPS = 1


def networks(agent: str) -> Settings:
    """Small networks for frames."""
    return replace(
        PRESETS["paper"],
        env=ENV,
        agent=agent,
        environment=replace(PRESETS["paper"].environment, num_envs=4, groups=1),
        recurrence=Recurrence(hidden_size=32, sequence_length=8),
        transformer=Transformer(layers=2, width=32, heads=2, window=8, sequence_length=8, positions=64),
        model=Model(vector_width=16, head_width=16),
        ppo=PPO(updates=2, steps=16, epochs=1, minibatches=2),
    )


def computed(agent: Agent, draws: torch.Generator) -> dict[str, torch.Tensor]:
    """An agent's results on a random segment of 16 steps: outputs while acting, loss and gradients; moved to the CPU."""
    steps, envs, device = 16, 4, agent.device
    frames = torch.randint(0, 256, (steps, envs, 84, 84, 3), dtype=torch.uint8, generator=draws)
    vectors = torch.randn(steps, envs, 16, generator=draws)
    done = (torch.rand(steps, envs, generator=draws) < 0.1).to(device)
    memory = agent.initial_memory(envs)
    agent.memory.begin_segment(memory.state, steps)
    rows = []
    for step in range(steps):
        first = memory.reset_mask
        output = agent.act({FRAME: frames[step], "vector_observation": vectors[step]}, memory, greedy=True)
        rows.append((first, output.action, output.log_prob, output.value, output.observation))
        memory.reset(done[step])
    first, action, log_prob, value = (torch.stack([row[i] for row in rows]) for i in range(4))
    observation = {key: torch.stack([row[4][key] for row in rows]) for key in rows[0][4]}
    reward = torch.randn(steps, envs, generator=draws).to(device)
    last = torch.zeros(envs, device=device)
    segment = Segment(observation, first, action, log_prob, value, reward, done, None, last)
    advantages = losses.generalised_advantages(reward, value, done, last, 0.99, 0.95)
    returns = (advantages + value).flatten()
    (minibatch,) = agent.memory.minibatches([memory.state], first.cpu(), 1, torch.Generator().manual_seed(0))
    loss, _ = minibatch_loss(agent, segment.flat(), minibatch, advantages.flatten(), returns, agent.settings.ppo, 0.01)
    loss.backward()
    gradients = {f"gradient of {name}": weight.grad for name, weight in agent.named_parameters()}
    return {
        name: tensor.detach().cpu()
        for name, tensor in {"log_prob": log_prob, "value": value, "loss": loss, **gradients}.items()
    }


def relative_difference(one: torch.Tensor, other: torch.Tensor) -> float:
    """The largest difference, relative to the largest value of the first; infinite if a value is NaN or infinite."""
    difference = float((one - other).abs().max() / one.abs().max().clamp(min=1e-6))
    return difference if math.isfinite(difference) else math.inf


def equality(name: str, device: torch.device) -> dict[str, Any]:
    """The largest difference between an agent's results on the CPU and on the device, relative to the largest value."""
    shapes = {FRAME: (84, 84, 3), "vector_observation": (16,)}
    torch.manual_seed(1)
    here = Agent(networks(name), shapes, (3, 3))
    there = Agent(networks(name), shapes, (3, 3), device=device)
    there.load_state_dict(here.state_dict())
    one, two = (computed(agent, torch.Generator().manual_seed(2)) for agent in (here, there))
    largest, where = max((relative_difference(one[key], two[key]), key) for key in one)
    return {"agent": name, "largest_difference": largest, "of": where, "equal": largest <= TOLERANCE}


def copies(device: torch.device) -> list[dict[str, Any]]:
    """Seconds that copying the frames of a step of all environments to the device takes alone."""
    rows = []
    for num_envs, _, _ in SIZES:
        target = torch.empty(num_envs, 84, 84, 3, dtype=torch.uint8, device=device)
        for locked in (False, True):
            source = torch.zeros(target.shape, dtype=torch.uint8, pin_memory=locked)
            for repeats in (10, 100):
                torch.cuda.synchronize(device)
                start = time.perf_counter()
                for _ in range(repeats):
                    target.copy_(source, non_blocking=True)
                torch.cuda.synchronize(device)
                seconds = (time.perf_counter() - start) / repeats
            gigabytes = target.numel() / seconds / 1e9
            row = {"num_envs": num_envs, "page_locked": locked, "seconds": seconds, "gigabytes_per_second": gigabytes}
            rows.append(row)
    return rows


def training(settings: Settings, device: torch.device, seconds: float, copy: float | None) -> dict[str, Any]:
    """Steps per second of the updates after the warm-up, with their breakdown.

    Args:
        settings: Settings of the run.
        device: Where it learns.
        seconds: How long to measure.
        copy: Seconds that copying the frames of a step takes alone, if known.
    """
    cuda, num_envs, steps = device.type == "cuda", settings.environment.num_envs, settings.ppo.steps
    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    times: list[tuple[float, float]] = []

    def watch(update: int, means: dict[str, float]) -> bool:
        times.append((time.perf_counter(), time.process_time()))
        updates = len(times) - WARM_UPS
        # Whether another update would take too long.
        return updates > 0 and (times[-1][0] - times[WARM_UPS - 1][0]) * (updates + 1) / updates > seconds

    with tempfile.TemporaryDirectory() as folder:
        run = train(replace(settings, run=f"{folder}/run", device=str(device)), watch)
        rows = read_progress(run)[WARM_UPS:]
    wall, cpu = (last - first for first, last in zip(times[WARM_UPS - 1], times[-1], strict=True))
    phases = [name for name in rows[0] if name.startswith("seconds/")]
    return {
        "agent": settings.agent,
        "num_envs": num_envs,
        "steps": steps,
        "bf16": settings.bf16,
        "updates": len(rows),
        "steps_per_second": len(rows) * num_envs * steps / wall,
        "shares_of_time": {name.removeprefix("seconds/"): sum(row[name] for row in rows) / wall for name in phases},
        "copy": None if copy is None else len(rows) * steps * copy / wall,
        "cpu_cores": cpu / wall,
        "peak_gigabytes": torch.cuda.max_memory_allocated(device) / 1e9 if cuda else None,
    }


def trainings(agents: list[str], small: bool) -> Iterator[Settings]:
    """The settings of the measurements, first all agents with the paper's batch."""
    for (num_envs, steps, bf16), agent in itertools.product(SMALL if small else SIZES, agents):
        given = networks(agent) if small else replace(PRESETS["paper"], env=ENV, agent=agent)
        environment, ppo = replace(given.environment, num_envs=num_envs), replace(given.ppo, updates=0, steps=steps)
        # One sequence per segment, since overlapping windows share their steps.
        transformer = replace(given.transformer, sequence_length=steps) if bf16 else given.transformer
        yield replace(given, environment=environment, ppo=ppo, bf16=bf16, transformer=transformer)


def learning(device: torch.device, seconds: float) -> list[dict[str, float]]:
    """Steps, seconds of training and task progress after each update, until the task is learnt or the time is over."""
    given = replace(PRESETS["quick"], env="MortarMayhem-Grid-v0", device=str(device), time_limit=seconds / 60)
    options = {"option": ("command_count=[1]",), "observation": "rgb", "num_envs": 256 if device.type == "cuda" else 4}
    with tempfile.TemporaryDirectory() as folder:
        run = train(replace(given, run=f"{folder}/run", environment=replace(given.environment, **options)))
        rows = read_progress(run)
    durations = itertools.accumulate(rows[0]["steps"] / row["steps_per_second"] for row in rows)
    reached = [row.get("episode/task_progress", 0.0) for row in rows]
    return [
        {"steps": row["steps"], "seconds": duration, "task_progress": progress}
        for row, duration, progress in zip(rows, durations, reached, strict=True)
    ]


def markdown(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [f"# The agents on {report['device']}", "", f"{report['versions']}, {report['cores']} CPU cores.", ""]
    lines += ["## Equality with the CPU", ""]
    lines += [f"Largest difference, relative to the largest value; at most {TOLERANCE:g} counts as equal.", ""]
    lines += ["| agent | difference | of | equal |", "| --- | --- | --- | --- |"]
    for row in report["equality"]:
        equal = "yes" if row["equal"] else "**no**"
        lines.append(f"| {row['agent']} | {row['largest_difference']:.1e} | {row['of']} | {equal} |")
    if report["copies"]:
        lines += ["", "## Copies of the frames of a step", "", "| environments | memory | ms | GB/s |"]
        lines += ["| --- | --- | --- | --- |"]
        for row in report["copies"]:
            kind, speed = "page-locked" if row["page_locked"] else "pageable", row["gigabytes_per_second"]
            lines.append(f"| {row['num_envs']} | {kind} | {1e3 * row['seconds']:.3f} | {speed:.1f} |")
    lines += ["", "## Training", ""]
    lines += ["The copy of the frames is timed alone; while training, it may overlap with other work.", ""]
    lines += [
        "| agent | environments x steps | options | steps per second | share of time | copy | CPU cores | peak memory |"
    ]
    lines += ["| --- | --- | --- | --- | --- | --- | --- | --- |"]
    for row in report["training"]:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in row["shares_of_time"].items())
        memory = "" if row["peak_gigabytes"] is None else f"{row['peak_gigabytes']:.1f} GB"
        copy = "" if row["copy"] is None else f"{row['copy']:.0%}"
        batch, options = f"{row['num_envs']} x {row['steps']}", "bf16" if row["bf16"] else ""
        speed, cores = f"{row['steps_per_second']:,.0f}", f"{row['cpu_cores']:.1f}"
        lines.append(f"| {row['agent']} | {batch} | {options} | {speed} | {shares} | {copy} | {cores} | {memory} |")
    if curve := report["learning"]:
        lines += ["", "## Learning one command from frames", "", "| steps | seconds of training | task progress |"]
        lines += ["| --- | --- | --- |"]
        for row in [*curve[: -1 : -(-len(curve) // 10)], curve[-1]]:
            lines.append(f"| {row['steps']:,} | {row['seconds']:.1f} | {row['task_progress']:.2f} |")
    for failure in report["failures"]:
        lines += ["", f"Not measured: {failure}."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run all parts, and print and write the report; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="`cuda`, `cuda:INDEX` or `cpu` (default: %(default)s)")
    agents = ["gru", "trxl", "mingru", "lru"]
    parser.add_argument("--agents", nargs="*", default=agents, help=f"agents that train (default: {' '.join(agents)})")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each measurement (default: %(default)s)")
    parser.add_argument(
        "--minutes", type=float, default=7.0, help="start no measurement after this time (default: %(default)s)"
    )
    parser.add_argument("--json", type=Path, help="write the report to this JSON file")
    parser.add_argument("--markdown", type=Path, help="write the report to this Markdown file")
    args = parser.parse_args()
    device, started = torch.device(args.device), time.monotonic()
    cuda = device.type == "cuda"
    if cuda and not torch.cuda.is_available():
        print(
            "on_cuda.py: PyTorch finds no CUDA device; `--device cpu` tests this program without one", file=sys.stderr
        )
        return 1
    if cuda:
        device = choose_device(args.device)
        torch.cuda.set_device(device)
    name = torch.cuda.get_device_name(device) if cuda else f"the CPU ({platform.machine()}), as a test of the program"
    report: dict[str, Any] = {
        "device": name,
        "versions": f"PyTorch {torch.__version__}, CUDA {torch.version.cuda}, Python {platform.python_version()}",
        "cores": len(os.sched_getaffinity(0)),
        "equality": [],
        "copies": [],
        "training": [],
        "learning": [],
        "failures": [],
    }

    def measure(name: str, part: str, work: Callable[[], Any]) -> None:
        """Add results to a part of the report, and write it."""
        if (time.monotonic() - started) / 60 > args.minutes:
            report["failures"].append(f"{name}: no time was left")
        else:
            try:
                result = work()
                report[part] += result if isinstance(result, list) else [result]
            except Exception as error:  # of any type; the other measurements go on
                traceback.print_exc()
                report["failures"].append(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:200]}")
        if args.json:
            atomic.write(args.json, json.dumps(report, indent=1) + "\n")
        if args.markdown:
            atomic.write(args.markdown, markdown(report))

    torch.backends.cudnn.allow_tf32 = False
    for agent in AGENTS:
        measure(f"equality of {agent}", "equality", functools.partial(equality, agent, device))
    if cuda:
        measure("copies", "copies", functools.partial(copies, device))
        # As in `endless-train`.
        torch.backends.cudnn.allow_tf32 = True
        torch.set_float32_matmul_precision("high")
    measure("learning", "learning", functools.partial(learning, device, 6 * args.seconds))
    copied = {row["num_envs"]: row["seconds"] for row in report["copies"] if row["page_locked"]}
    for given in trainings(args.agents, not cuda):
        num_envs = given.environment.num_envs
        work = functools.partial(training, given, device, args.seconds, copied.get(num_envs))
        measure(f"{given.agent}, {num_envs} x {given.ppo.steps}", "training", work)
    print(markdown(report))
    return 0 if all(row["equal"] for row in report["equality"]) and not report["failures"] else 1


if __name__ == "__main__":
    sys.exit(main())
