"""Checks what every memory must do, one of your own included: `python -m endless_gym_agents.conformance NAME`.

NAME is what `--agent` takes: a name of the package, module:Class or file.py:Class. The checks use the memory as training does,
by the interface `Memory`, with random weights and inputs, and print what they measured:

- `agreement`: over 1,000 steps with random resets, learning computes the outputs that acting has computed;
- `gradient`: the gradients of inputs and weights are those of a plain loop over acting's steps;
- `reset`: an episode after a reset is that of a new memory;
- `leak`: the gradient of an output reaches the inputs of its episode up to its step, and no others;
- `memory`: it reaches a step before it at all;
- `finite`: over 10,000 steps without a reset, outputs, gradients and state stay finite, and the outputs do not become constant;
- `size`: the state does not grow with the number of steps.

```console
python -m endless_gym_agents.conformance mingru
python -m endless_gym_agents.conformance memory.py:Mine --agent-option layers=2
```
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
import tyro
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn
from rich.progress_bar import ProgressBar
from torch import Tensor

from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import command
from endless_gym_agents.common.clock import duration
from endless_gym_agents.common.ranges import Positive
from endless_gym_agents.memories.memory import AnyMemory, MemoryState
from endless_gym_agents.memories.recurrent import RecurrentMemory, RecurrentState
from endless_gym_agents.settings import PRESETS
from endless_gym_agents.training.train import choose_device

#: Environments of the checks. No episode of the first one ends.
ENVS = 4


@dataclass(frozen=True)
class Result:
    """The result of a check.

    Attributes:
        name: Name of the check.
        measured: What was measured.
        allowed: What is allowed, for a reader.
        passed: Whether it is.
    """

    name: str
    measured: float
    allowed: str
    passed: bool


def at_most(name: str, measured: float, limit: float) -> Result:
    """The result of a check of a number that must not exceed a limit."""
    return Result(name, measured, f"at most {limit:g}", measured <= limit)


@dataclass(frozen=True)
class Played:
    """Steps that a memory has computed while acting.

    Attributes:
        state: The state after the steps.
        resets: Whether each step is the first of an episode, bool (T, N).
        outputs: float32 (T, N, width).
    """

    state: MemoryState
    resets: Tensor
    outputs: Tensor


def make_memory(agent: str, options: tuple[str, ...], sequence: int, device: torch.device) -> AnyMemory:
    """A memory with random weights, and inputs of 32 entries.

    Args:
        agent: Name of the memory, as `--agent` takes it.
        options: Arguments of its class, as `--agent-option` takes them.
        sequence: Steps of a sequence while learning; of a transformer at most 50.
        device: Device of weights and states.
    """
    base = dataclasses.replace(PRESETS["quick"], agent=agent, agent_option=options)
    recurrence = dataclasses.replace(base.recurrence, hidden_size=32, sequence_length=sequence)
    transformer = dataclasses.replace(base.transformer, width=32, positions=512, sequence_length=min(sequence, 50))
    ppo = dataclasses.replace(base.ppo, steps=transformer.sequence_length)
    settings = dataclasses.replace(base, recurrence=recurrence, transformer=transformer, ppo=ppo).validated()
    torch.manual_seed(1)
    made = Agent(settings, {"features": (32,)}, (3,), device=device)
    # As after some training: no weight is 0.
    for parameter in made.memory.parameters():
        parameter.data.add_(torch.randn_like(parameter), alpha=0.05)
    return made.memory


def drawn(memory: AnyMemory, steps: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Random embedded observations, float32 (T, N, input width), and resets, bool (T, N): random ones, and one half-way."""
    generator = torch.Generator().manual_seed(2)
    assert memory.embedding is not None
    layer = memory.embedding[0]
    assert isinstance(layer, torch.nn.Linear)
    resets = torch.rand((steps, ENVS), generator=generator) < 0.02
    resets[:, 0] = False
    resets[steps // 2, 1] = resets[0] = True
    return torch.randn((steps, ENVS, layer.out_features), generator=generator).to(device), resets.to(device)


def play(memory: AnyMemory, x: Tensor, resets: Tensor, segment: bool = True) -> Played:
    """Act for T steps, as one segment that is recorded for learning, or without recording."""
    memory.refresh(torch.float32)
    state, outputs = memory.initial_state(x.shape[1]), []
    if segment:
        memory.begin_segment(state, len(x))
    for inputs, restarts in zip(x, resets, strict=True):
        y, update = memory.step(inputs, state, restarts if restarts.any() else None)
        memory.update_state(state, update)
        outputs.append(y)
    return Played(state, resets, torch.stack(outputs))


def learn(memory: AnyMemory, x: Tensor, played: Played) -> Tensor:
    """The outputs that learning computes for steps that were played, float32 (T, N, width)."""
    (minibatch,) = memory.minibatches([played.state], played.resets, 1, torch.Generator().manual_seed(3))
    outputs = memory(x.flatten(0, 1).index_select(0, minibatch.indices), minibatch)
    ordered: Tensor = outputs.index_select(0, minibatch.indices.argsort()).unflatten(0, x.shape[:2])
    return ordered


def state_bytes(state: MemoryState) -> int:
    """Bytes of a state."""

    def size(value: Any) -> int:
        if isinstance(value, dict):
            return sum(map(size, value.values()))
        if isinstance(value, (list, tuple)):
            return sum(map(size, value))
        return value.numel() * value.element_size() if isinstance(value, Tensor) else 0

    return size(state.state_dict())


def check(
    agent: str, options: tuple[str, ...] = (), steps: int = 1000, long: int = 10_000, device: str = "cpu"
) -> Iterator[Result]:
    """Check a memory.

    Args:
        agent: Name of the memory, as `--agent` takes it.
        options: Arguments of its class, as `--agent-option` takes them.
        steps: Steps of the checks of agreement; those of gradients and leaks take a fifth of it.
        long: Steps of the check without resets.
        device: Device of the memory, as for `endless-train`.

    Yields:
        The result of each check.

    Raises:
        ValueError: There is no such memory, or it has no state.
    """
    on = choose_device(device)
    memory = make_memory(agent, options, steps, on)
    if not state_bytes(memory.initial_state(1)):
        raise ValueError(f"agent `{agent}` has no memory to check")
    x, resets = drawn(memory, steps, on)
    with torch.no_grad():
        played = play(memory, x, resets)
        yield at_most("agreement", float((learn(memory, x, played) - played.outputs).abs().max()), 1e-5)
        yield at_most("reset", _reset(memory, x, resets, played.outputs), 1e-5)
        sizes = [state_bytes(play(memory, x[:end], resets[:end], segment=False).state) for end in (steps // 2, steps)]
        yield at_most("size", sizes[1] / ENVS, sizes[0] / ENVS)
    few = steps // 5
    x, resets = x[:few].clone().requires_grad_(), resets[:few]
    memory = make_memory(agent, options, few, on)
    if isinstance(memory, RecurrentMemory):
        # Other memories have no gradients of the steps that they store.
        yield at_most("gradient", _gradient(memory, x, resets), 1e-4)
    yield from _leaks(memory, x, resets)
    yield _finite(make_memory(agent, options, long, on), long, on)


def _reset(memory: AnyMemory, x: Tensor, resets: Tensor, outputs: Tensor) -> float:
    """Largest difference of the outputs of an episode from those of a new memory for the same inputs."""
    episode = slice(len(x) // 2, None)
    alone = resets[episode].clone()
    alone[0] = True
    return float((play(memory, x[episode], alone).outputs - outputs[episode])[:, 1].abs().max())


def _gradient(memory: AnyMemory, x: Tensor, resets: Tensor) -> float:
    """Largest difference of a gradient from that of the loop over the steps of acting, relative to the largest entry."""
    inputs = {"inputs": x, **dict(memory.named_parameters())}
    played = play(memory, x, resets)
    weight = torch.randn(played.outputs.shape, generator=torch.Generator().manual_seed(4)).to(x.device)
    with torch.no_grad():
        again = play(memory, x, resets)
    loops, scans = (
        torch.autograd.grad((outputs * weight).sum(), list(inputs.values()), allow_unused=True)
        for outputs in (played.outputs, learn(memory, x, again))
    )
    worst = 0.0
    for loop, scan in zip(loops, scans, strict=True):
        if loop is None or scan is None:
            worst = max(worst, 0.0 if loop is scan else torch.inf)  # both are unused, or one is not
        else:
            worst = max(worst, float((loop - scan).abs().max() / loop.abs().max().clamp_min(1e-3)))
    return worst


def _leaks(memory: AnyMemory, x: Tensor, resets: Tensor) -> Iterator[Result]:
    with torch.no_grad():
        played = play(memory, x, resets)
    outputs, leaked, reached = learn(memory, x, played), 0, 0
    for env in range(ENVS):
        starts = resets[:, env].nonzero()[:, 0].tolist()
        # The last step before a reset, and one in the middle of an episode.
        for step in {(starts[-1] or len(x)) - 1, (starts[-1] + len(x)) // 2}:
            begin = max(start for start in starts if start <= step)
            (gradient,) = torch.autograd.grad(outputs[step, env].square().sum(), x, retain_graph=True)
            touched = gradient.abs().sum(-1) > 0
            reached += int(touched[begin:step, env].sum())
            touched[begin : step + 1, env] = False
            leaked += int(touched.sum())
    yield at_most("leak", leaked, 0)
    if isinstance(memory, RecurrentMemory):
        yield Result("memory", reached, "at least 1", reached > 0)


def _finite(memory: AnyMemory, steps: int, device: torch.device) -> Result:
    """Over many steps without a reset: the largest output, or infinity if something is not finite or the outputs are constant."""
    x, resets = drawn(memory, steps, device)
    x, resets = x[:, :1].clone().requires_grad_(), resets[:, :1]
    with torch.no_grad():
        played = play(memory, x[:1], resets[:1], segment=False)
        memory.begin_segment(played.state, steps)
        if not isinstance(memory, RecurrentMemory):
            outputs = play(memory, x, resets, segment=False).outputs
    finite = True
    if isinstance(memory, RecurrentMemory):
        # A sequence of all steps needs only the state before them.
        assert isinstance(played.state, RecurrentState)
        played.state.stored = [played.state.tree]
        outputs = learn(memory, x, Played(played.state, resets, x))
        (gradient,) = torch.autograd.grad(outputs.square().mean(), x)
        finite = bool(gradient.isfinite().all())
    largest = float(outputs.detach().abs().max())
    passed = finite and bool(outputs.isfinite().all()) and bool(outputs[-100:].std(0).max() > 1e-4)
    return Result("finite", largest, "finite and not constant", passed)


@dataclass(frozen=True)
class ConformanceArguments:
    """Arguments of the program."""

    agent: tyro.conf.Positional[str]
    """the memory, as `--agent` of `endless-train` takes it: a name, module:Class or file.py:Class"""
    agent_option: tuple[str, ...] = ()
    """arguments of its class, each as NAME=VALUE with a JSON value"""
    steps: Positive = 1000
    """steps of the checks of agreement"""
    long_steps: Positive = 10_000
    """steps of the check without resets"""
    device: str = "cpu"
    """device of the memory, as for `endless-train`"""


class TimeBar(BarColumn):
    """How much of the estimated time has passed, in seconds, since a call that computes many steps reports no progress."""

    def render(self, task: Task) -> ProgressBar:
        """The bar; without an estimate, it pulses."""
        task.completed = min(task.elapsed or 0.0, task.total or 0.0)
        return super().render(task)


def execute(given: ConformanceArguments) -> None:
    """Check a memory, and print the results.

    Raises:
        ValueError: There is no such memory, or a check has failed.
    """
    failed, start, is_first = [], time.monotonic(), True
    console = command.Terminal()
    columns = (TextColumn("checking"), TimeBar(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("checking", total=None)
        for result in check(given.agent, given.agent_option, given.steps, given.long_steps, given.device):
            verdict = "passed" if result.passed else "FAILED"
            print(f"{verdict}  {result.name:<10} {result.measured:<10.3g} {result.allowed}", flush=True)
            failed += [] if result.passed else [result.name]
            if is_first:
                # With gradients, a step takes about twice as long.
                taken = time.monotonic() - start
                left = 2 * taken * given.long_steps / given.steps
                message = f"the last check plays {given.long_steps:,} steps and is the longest: about {duration(left)}"
                print(message, file=sys.stderr, flush=True)
                bar.update(task, total=taken + left)
                is_first = False
    if failed:
        raise ValueError(
            f"{given.agent} fails {', '.join(failed)}; the documentation of the module describes the checks"
        )


def main() -> int:
    """Entry point of the program; returns the exit status."""
    return command.main("conformance", ConformanceArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
