"""The steps of a rollout as CUDA graphs: each is two launches instead of one for each operation.

A step of a group of environments is divided where the actions are sent:

* `decide`: from the uploaded observation to the actions: transform, encoder, memory, heads, sampling.
* `remember`: while the environments step, the memory is updated, and what the step produced goes into the segment.

Each half is captured once and then repeated. What a graph reads or writes stays where it is: see `fixed`. The number of the step
in its segment is a number on the device, which `remember` increments. Uploads and the copy of the actions stay outside.

A run must not depend on graphs. `GraphedGroup.capture` plays some steps with the graphs and without, from the same state, and
compares all that they compute. If capturing fails or results differ, `RolloutCollector` goes on without graphs.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import torch
from torch import Tensor

from endless_gym_agents.agent import Agent, AgentMemory, Decision
from endless_gym_agents.encoders import FRAME, Observation
from endless_gym_agents.fixed import fixed_memory
from endless_gym_agents.settings import Settings

#: Steps of the comparison with the operations without graphs. After the first step the ring of the Transformer-XL's cache goes on
#: at its first slot.
COMPARED_STEPS = 3
#: Largest difference that is taken for rounding, relative to the largest absolute value of a tensor. The graphs call the same
#: kernels, so that no difference is expected.
TOLERANCE = 1e-4
#: Runs of the operations before they are captured, in which libraries choose kernels and allocate workspaces.
WARM_UPS = 3


class Graphs(Protocol):
    """How functions are captured."""

    def warm_up(self, function: Callable[[], None]) -> None:
        """Run a function some times, as it has to be before it is captured."""

    def capture(self, function: Callable[[], None]) -> Callable[[], None]:
        """Record the operations of a function, which need not be executed, and return what repeats them."""


class CudaGraphs(Graphs):
    """CUDA graphs, each with a memory pool of its own."""

    def __init__(self, device: torch.device) -> None:
        """Make graphs for the device."""
        self._device = device

    def warm_up(self, function: Callable[[], None]) -> None:
        stream = torch.cuda.Stream(self._device)
        stream.wait_stream(torch.cuda.current_stream(self._device))
        try:
            with torch.cuda.stream(stream):
                for _ in range(WARM_UPS):
                    function()
                # A capture that fails leaves more behind than an operation that is refused.
                with refused_waits():
                    function()
        finally:
            torch.cuda.current_stream(self._device).wait_stream(stream)

    def capture(self, function: Callable[[], None]) -> Callable[[], None]:
        graph = torch.cuda.CUDAGraph()
        # Other threads, such as those of NCCL, may use CUDA in the meantime.
        with torch.cuda.device(self._device), torch.cuda.graph(graph, capture_error_mode="thread_local"):
            function()
        replay: Callable[[], None] = graph.replay
        return replay


@contextmanager
def refused_waits() -> Iterator[None]:
    """Context in which an operation that waits for the device is an error."""
    before = torch.cuda.get_sync_debug_mode()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # PyTorch warns that this is a prototype.
        torch.cuda.set_sync_debug_mode("error")
        try:
            yield
        finally:
            torch.cuda.set_sync_debug_mode(before)


def graphs_for(settings: Settings, device: torch.device) -> Graphs | None:
    """What captures the steps of a rollout on a device; None if they are not captured."""
    # `torch.compile` has graphs of its own, and compiles again where it finds other shapes.
    if device.type != "cuda" or not settings.cuda_graphs or settings.compile:
        return None
    return CudaGraphs(device)


class GraphedGroup:
    """The steps of one group of n environments.

    Attributes:
        observation: The environments' observation by key, (n, ...); to be uploaded before `decide`.
        captured: Whether the graphs exist.
    """

    def __init__(
        self,
        agent: Agent,
        memory: AgentMemory,
        segment: Observation,
        action: Tensor,
        outputs: Tensor,
        outcome: Tensor,
    ) -> None:
        """Allocate the tensors.

        Args:
            agent: The agent that acts.
            memory: Its memory of the environments, after `Memory.begin_segment`.
            segment: The transformed observations of the segment by key, (T, n, ...); written by `remember`.
            action: The actions of the segment, int64 (T, n, branches); written by `remember`.
            outputs: Logits and values of the segment, float32 (T, n, outputs); written by `remember`.
            outcome: Rewards and ends of episodes before each step of the segment, and after the last, float32 (T + 1, 2, n).
        """
        self._agent, self._memory = agent, memory
        self._segment, self._action, self._outputs, self._outcome = segment, action, outputs, outcome
        self._steps, envs, device = len(action), action.shape[1], agent.device
        self.observation = {
            key: torch.zeros((envs, *shape), dtype=torch.uint8 if key == FRAME else torch.float32, device=device)
            for key, shape in agent.observation_shapes.items()
        }
        self._step = torch.zeros(1, dtype=torch.long, device=device)
        self._noise = torch.zeros((self._steps, envs, len(agent.branches), max(agent.branches)), device=device)
        self._transform = {name: torch.empty_like(part) for name, part in memory.transform_state.tensors.items()}
        self._weights = agent.acting_weights()
        self._fixed = fixed_memory(agent.memory, memory.state, self._steps)
        self._parameters = self._addresses()
        self._observed: Observation = {}
        self._update: dict[str, Tensor] = {}
        self._decision: Decision | None = None
        self._replays: tuple[Callable[[], None], Callable[[], None]] | None = None

    @property
    def captured(self) -> bool:
        """Whether the graphs exist."""
        return self._replays is not None

    def is_valid(self) -> bool:
        """Whether the agent's parameters are where they were."""
        return self._addresses() == self._parameters

    @torch.no_grad()
    def begin_segment(self, noise: Tensor) -> None:
        """Begin a segment, after `Memory.begin_segment`.

        Args:
            noise: What `Agent.noise` returned for its steps, float32 (T, n, branches, choices).
        """
        self._noise.copy_(noise)
        self._load()

    @torch.no_grad()
    def capture(self, graphs: Graphs) -> None:
        """Capture the graphs for the uploaded observation, and compare their results; `memory` is unchanged afterwards.

        Raises:
            ValueError: The results differ from those without graphs.
            RuntimeError: The operations cannot be captured.
        """
        before = copy.deepcopy(self._memory.state_dict())
        try:
            graphs.warm_up(self._whole)
            self._load()
            self._replays = graphs.capture(self._decide), graphs.capture(self._remember)
            self._reset(before)
            self._load()
            self._compare(before)
        except BaseException:
            self._replays = None
            raise
        finally:
            self._reset(before)
        self._load()

    def decide(self) -> Tensor:
        """Compute the actions, int64 (n, branches), of the uploaded observation; overwritten by the next step."""
        assert self._replays is not None and self._decision is not None
        self._replays[0]()
        return self._decision.action

    def remember(self) -> None:
        """Update memory and segment after `decide`."""
        assert self._replays is not None
        self._fixed.advance()
        self._replays[1]()
        self._memory.reset_mask = self._memory.no_reset

    def _decide(self) -> None:
        """The operations of `decide`."""
        agent, step = self._agent, self._step
        reset_mask = self._outcome.index_select(0, step)[0, 1].bool()
        noise = self._noise.index_select(0, step).squeeze(0)
        state = self._memory.transform_state
        self._observed, self._update = agent.transform.apply(self.observation, state, reset_mask)
        self._decision = agent.decide_with(
            self._weights, lambda x: self._fixed.step(x, reset_mask, step), self._observed, noise
        )

    def _remember(self) -> None:
        """The operations of `remember`."""
        decision, step = self._decision, self._step
        assert decision is not None
        with self._agent.autocast():
            self._fixed.update(decision.memory_update, step)
        for name, tensor in self._update.items():
            self._transform[name].copy_(tensor)
        for key, part in self._observed.items():
            self._segment[key].index_copy_(0, step, part.unsqueeze(0))
        self._action.index_copy_(0, step, decision.action.unsqueeze(0))
        self._outputs.index_copy_(0, step, decision.outputs.unsqueeze(0))
        step.add_(1)

    def _whole(self) -> None:
        """The operations of a step 0."""
        self._step.zero_()
        self._decide()
        self._remember()

    def _load(self) -> None:
        """Refill the fixed tensors for a segment."""
        self._step.zero_()
        self._weights.copy_(self._agent.acting_weights())
        with self._agent.autocast():
            self._fixed.load()
        state = self._memory.transform_state
        for name, tensor in state.tensors.items():
            if tensor is not self._transform[name]:
                self._transform[name].copy_(tensor)
        state.tensors = self._transform

    def _reset(self, before: dict[str, Any]) -> None:
        """Begin the segment again, with an earlier state of the memory."""
        self._memory.load_state_dict(before)
        self._agent.memory.begin_segment(self._memory.state, self._steps)

    def _compare(self, before: dict[str, Any]) -> None:
        """Play some steps with the graphs and without; the observation is the same in all of them.

        Raises:
            ValueError: The results differ.
        """
        agent = self._agent
        eager = agent.initial_memory(self._action.shape[1])
        eager.load_state_dict(copy.deepcopy(before))
        agent.memory.begin_segment(eager.state, self._steps)
        for step in range(min(COMPARED_STEPS, self._steps)):
            eager.reset_mask = self._outcome[step, 1].bool()
            observed, update = agent.observe(self.observation, eager)
            decision = agent.decide(observed, eager, self._noise[step])
            agent.remember(eager, decision, update)
            self.decide()
            self.remember()
            expected = {
                "actions": decision.action,
                "outputs": decision.outputs,
                "observation": observed,
                "memory": eager.state_dict(),
            }
            segment = {key: part[step] for key, part in self._segment.items()}
            found = {
                "actions": self._action[step],
                "outputs": self._outputs[step],
                "observation": segment,
                "memory": self._memory.state_dict(),
            }
            for name, one, other in paired(expected, found):
                difference = relative_difference(one, other)
                if difference > TOLERANCE:
                    raise ValueError(f"in step {step}, {name} differs by {difference:.1e}")

    def _addresses(self) -> list[int]:
        return [parameter.data_ptr() for parameter in self._agent.parameters()]


def paired(one: Any, other: Any, name: str = "") -> Iterator[tuple[str, Any, Any]]:
    """The entries of two nested dicts with the same keys, with their names."""
    if isinstance(one, dict):
        for key, value in one.items():
            yield from paired(value, other[key], f"{name} {key}".lstrip())
    else:
        yield name, one, other


def relative_difference(one: Any, other: Any) -> float:
    """The largest difference of two tensors, relative to the largest value of the first.

    Infinite for different integers, and where one of them is NaN or infinite.
    """
    if not torch.is_tensor(one):
        return 0.0 if one == other else math.inf
    if not one.is_floating_point():
        return 0.0 if torch.equal(one, other) else math.inf
    difference = float((one - other).abs().max() / one.abs().max().clamp(min=1e-6))
    return difference if math.isfinite(difference) else math.inf
