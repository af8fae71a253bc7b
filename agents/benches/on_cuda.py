"""The agents on CUDA: equality with the CPU, copies, and training throughput. Takes less than ten minutes.

    python on_cuda.py --json on_cuda.json --markdown on_cuda.md

* Equality: each agent computes a rollout's log-probabilities and values, and a minibatch's loss and gradients, on the CPU and on
  the device, in float32 without TF32. The largest difference, relative to the largest value, must be at most 1e-3.
* Copies: frames of a group from pageable and from page-locked memory to the device.
* Training: steps per second with a breakdown, and peak memory, with the networks, frames, environments and steps of the preset
  `paper`, without and with `--compile`, and with more environments; then with environments in this process and in an engine
  process, otherwise with equal settings. The first updates are excluded as warm-up.

`--device cpu` runs the parts that need no GPU with small networks and few steps, to test this program; its numbers mean nothing.
The exit status is 1 if there is no CUDA device, or if a result on the device differs from the CPU's.
"""

import argparse
import json
import math
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
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
#: Environments, steps and `--compile` of the training measurements; the first are the paper's.
TRAININGS = ((32, 512, False), (32, 512, True), (128, 512, False), (512, 128, False))
#: Where the environments are and their number of groups, in measurements with many environments and bfloat16.
ENGINES = (("thread", 1), ("process", 1), ("thread", 2), ("process", 2))
#: Updates before the timed ones. With graphs, a part is compiled in its first call and captured in its third.
WARM_UPS = 2


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


def equality(device: torch.device) -> list[dict[str, Any]]:
    """The largest differences between the results of the CPU and of the device, relative to the largest value."""
    shapes, rows = {FRAME: (84, 84, 3), "vector_observation": (16,)}, []
    for name in AGENTS:
        torch.manual_seed(1)
        here = Agent(networks(name), shapes, (3, 3))
        there = Agent(networks(name), shapes, (3, 3), device=device)
        there.load_state_dict(here.state_dict())
        one, two = (computed(agent, torch.Generator().manual_seed(2)) for agent in (here, there))
        largest, where = max((relative_difference(one[key], two[key]), key) for key in one)
        rows.append({"agent": name, "largest_difference": largest, "of": where, "equal": largest <= TOLERANCE})
    return rows


def copies(device: torch.device) -> list[dict[str, Any]]:
    """Gigabytes per second of copies of the frames of 16 environments to the device."""
    rows, target = [], torch.empty(16, 84, 84, 3, dtype=torch.uint8, device=device)
    for locked in (False, True):
        source = torch.zeros(target.shape, dtype=torch.uint8, pin_memory=locked)
        for _ in range(10):
            target.copy_(source, non_blocking=True)
        torch.cuda.synchronize(device)
        start, repeats = time.perf_counter(), 500
        for _ in range(repeats):
            target.copy_(source, non_blocking=True)
        torch.cuda.synchronize(device)
        seconds = time.perf_counter() - start
        rows.append({"page_locked": locked, "gigabytes_per_second": repeats * target.numel() / seconds / 1e9})
    return rows


def training(settings: Settings, device: torch.device, updates: int) -> dict[str, Any]:
    """Steps per second of some updates after the warm-up, with their breakdown and the peak memory."""
    cuda, num_envs, steps = device.type == "cuda", settings.environment.num_envs, settings.ppo.steps
    if cuda:
        torch.cuda.reset_peak_memory_stats(device)
    with tempfile.TemporaryDirectory() as folder:
        ppo = replace(settings.ppo, updates=updates + WARM_UPS)
        rows = read_progress(train(replace(settings, run=f"{folder}/run", device=str(device), ppo=ppo)))[WARM_UPS:]
    seconds = sum(num_envs * steps / row["steps_per_second"] for row in rows)
    phases = [name for name in rows[0] if name.startswith("seconds/")]
    return {
        "agent": settings.agent,
        "num_envs": num_envs,
        "steps": steps,
        "engine": settings.environment.engine,
        "groups": settings.environment.groups,
        "bf16": settings.bf16,
        "compile": settings.compile,
        "steps_per_second": updates * num_envs * steps / seconds,
        "shares_of_time": {name.removeprefix("seconds/"): sum(row[name] for row in rows) / seconds for name in phases},
        "peak_gigabytes": torch.cuda.max_memory_allocated(device) / 1e9 if cuda else None,
    }


def trainings() -> Iterator[Settings]:
    """The settings of the measurements on CUDA."""
    paper = replace(PRESETS["paper"], env=ENV)
    for num_envs, steps, compile in TRAININGS:
        for agent in ("gru", "trxl"):
            environment, ppo = replace(paper.environment, num_envs=num_envs), replace(paper.ppo, steps=steps)
            yield replace(paper, agent=agent, compile=compile, environment=environment, ppo=ppo)
    for engine, groups in ENGINES:
        environment = replace(paper.environment, num_envs=1024, engine=engine, groups=groups)
        many = replace(paper, bf16=True, environment=environment, ppo=replace(paper.ppo, steps=128))
        yield replace(many, agent="gru", recurrence=replace(paper.recurrence, sequence_length=128))


def markdown(report: dict[str, Any]) -> str:
    """The report as Markdown."""
    lines = [f"# The agents on {report['device']}", "", f"{report['versions']}.", "", "## Equality with the CPU", ""]
    lines += [f"Largest difference, relative to the largest value; at most {TOLERANCE:g} counts as equal.", ""]
    lines += ["| agent | difference | of | equal |", "| --- | --- | --- | --- |"]
    for row in report["equality"]:
        equal = "yes" if row["equal"] else "**no**"
        lines.append(f"| {row['agent']} | {row['largest_difference']:.1e} | {row['of']} | {equal} |")
    if "copies" in report:
        lines += ["", "## Copies of the frames of 16 environments", "", "| memory | GB/s |", "| --- | --- |"]
        for row in report["copies"]:
            kind = "page-locked" if row["page_locked"] else "pageable"
            lines.append(f"| {kind} | {row['gigabytes_per_second']:.1f} |")
    lines += ["", "## Training", ""]
    lines += [
        "| agent | environments x steps | engine, groups | options | steps per second | share of time | peak memory |"
    ]
    lines += ["| --- | --- | --- | --- | --- | --- | --- |"]
    for row in report["training"]:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in row["shares_of_time"].items())
        memory = "" if row["peak_gigabytes"] is None else f"{row['peak_gigabytes']:.1f} GB"
        batch = f"{row['num_envs']} x {row['steps']}"
        engine = f"{row['engine']}, {row['groups']}"
        options = ", ".join(name for name in ("bf16", "compile") if row[name])
        speed = f"{row['steps_per_second']:,.0f}"
        lines.append(f"| {row['agent']} | {batch} | {engine} | {options} | {speed} | {shares} | {memory} |")
    for left_out in report["left_out"]:
        lines += ["", f"Not measured: {left_out}."]
    return "\n".join(lines) + "\n"


def main() -> int:
    """Run all parts, and print and write the report; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="`cuda`, `cuda:INDEX` or `cpu` (default: %(default)s)")
    parser.add_argument("--updates", type=int, default=2, help="timed updates of each training (default: %(default)s)")
    parser.add_argument(
        "--minutes", type=float, default=8.0, help="start no training after this time (default: %(default)s)"
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
    versions = f"PyTorch {torch.__version__}, CUDA {torch.version.cuda}, Python {platform.python_version()}"
    name = torch.cuda.get_device_name(device) if cuda else f"the CPU ({platform.machine()}), as a test of the program"
    report: dict[str, Any] = {"device": name, "versions": versions}
    torch.backends.cudnn.allow_tf32 = False
    report["equality"] = equality(device)
    if cuda:
        report["copies"] = copies(device)
        # As in `endless-train`.
        torch.backends.cudnn.allow_tf32 = True
        torch.set_float32_matmul_precision("high")
    tests = [networks("gru"), networks("trxl")]
    tests.append(replace(tests[0], environment=replace(tests[0].environment, engine="process", groups=2)))
    report["training"], report["left_out"] = [], []
    for settings in trainings() if cuda else tests:
        agent, environment = settings.agent, settings.environment
        name = f"{agent}, {environment.num_envs} x {settings.ppo.steps}, {environment.engine}, {environment.groups}"
        if (time.monotonic() - started) / 60 > args.minutes:
            report["left_out"].append(name)
            continue
        try:
            report["training"].append(training(settings, device, args.updates))
        except torch.cuda.OutOfMemoryError:
            report["left_out"].append(f"{name} (out of memory)")
    text = markdown(report)
    print(text)
    if args.json:
        atomic.write(args.json, json.dumps(report, indent=1) + "\n")
    if args.markdown:
        atomic.write(args.markdown, text)
    return 0 if all(row["equal"] for row in report["equality"]) else 1


if __name__ == "__main__":
    sys.exit(main())
