"""CUDA graphs of the steps of a rollout, on the CPU with graphs that behave as CUDA's."""

import copy
import math
import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from agents_helpers import settings
from recorded_graphs import RecordedGraphs
from torch.utils._pytree import tree_leaves

from endless_gym_agents import acting, fixed, graphs, transformer, transformer_cache
from endless_gym_agents.agent import make_agent
from endless_gym_agents.clock import Clock
from endless_gym_agents.environments import Environments
from endless_gym_agents.ppo import learn, make_optimizer
from endless_gym_agents.rollout import RolloutCollector, Segment
from endless_gym_agents.settings import PRESETS, Settings
from endless_gym_agents.train import parse
from endless_gym_agents.transformer import TransformerMemory

STEPS, GROUPS, SEGMENTS = 16, 2, 4

FRAMES = {"environment": {"observation": "rgb"}, "ppo": {"ground_truth_coefficient": 0.1}}
#: Agents with changed settings.
KINDS: dict[str, tuple[str, dict[str, Any]]] = {
    "none": ("none", {}),
    "stack": ("stack", {"model": {"stack": 3}}),
    "position": ("position", {}),
    "gru": ("gru", {}),
    "gru, two layers": ("gru", {"recurrence": {"layers": 2, "residual": True}}),
    "lstm": ("lstm", {"recurrence": {"layers": 2, "sequence_length": 5}}),
    "trxl": ("trxl", {}),
    "trxl, single steps": ("trxl", {"transformer": {"sequence_length": 1, "window": 40}}),
    "trxl, relative": ("trxl", {"transformer": {"positional_encoding": "relative"}}),
    "trxl, learned": ("trxl", {"transformer": {"positional_encoding": "learned", "query_encoding": True}}),
    "trxl, previous": ("trxl", {"transformer": {"query_previous": True}}),
    "trxl, previous, bfloat16": ("trxl", {"transformer": {"query_previous": True}, "bf16": True}),
    "trxl, separate heads": ("trxl", {"transformer": {"positional_encoding": "none", "shared_heads": False}}),
    "gtrxl": ("gtrxl", {}),
    "gru, bfloat16": ("gru", {"bf16": True}),
    "trxl, bfloat16": ("trxl", {"bf16": True}),
    "gru, frames": ("gru", FRAMES),
    "stack, frames": ("stack", FRAMES),
}


def small(kind: str, **changes: Any) -> Settings:
    agent, parts = KINDS[kind]
    frames = parts is FRAMES
    given = settings(agent, env="Endless-MortarMayhem-v0" if frames else "MortarMayhem-Grid-v0", threads=1, **changes)
    # Episodes of about 8 to 16 steps, which end at different steps.
    option = () if frames else ("command_count=[1,2,3]", "command_show_duration=[1,2]")
    given = replace(
        given,
        environment=replace(given.environment, option=option, num_envs=8, groups=GROUPS, num_threads=1),
        ppo=replace(given.ppo, steps=STEPS, epochs=2, minibatches=2),
    )
    for name, fields in parts.items():
        changed = replace(getattr(given, name), **fields) if isinstance(fields, dict) else fields
        given = replace(given, **{name: changed})
    return given


class Run:
    """A run of rollouts and updates."""

    def __init__(self, given: Settings, environments: Environments, recorded: graphs.Graphs | None) -> None:
        torch.manual_seed(1)
        self.settings, self.agent = given, make_agent(given, environments.spec)
        if isinstance(self.agent.memory, TransformerMemory):
            # As on CUDA: the whole ring in each step.
            self.agent.memory.spans = False
        generator = torch.Generator().manual_seed(1)
        self.collector = RolloutCollector(self.agent, environments, given.ppo.steps, generator, graphs=recorded)
        # Equal frames are encoded once only without graphs.
        self.collector._frames = None
        self.optimizer = make_optimizer(self.agent, 1e-2)

    def collect(self) -> tuple[Segment, list[Any]]:
        """A segment; and its contents with those of the memories after it, as tensors and numbers."""
        segment, episodes = self.collector.collect(Clock())
        memories = self.collector.memories
        kept = [episodes, [memory.state_dict() for memory in memories], vars(segment)]
        kept += [getattr(memory.state, "stored", None) for memory in memories]
        # Cloned, since the next segment overwrites the tensors.
        return segment, [leaf.clone() if isinstance(leaf, torch.Tensor) else leaf for leaf in tree_leaves(kept)]

    def segment(self, update: int) -> tuple[Segment, list[Any]]:
        """As `collect`, with an update and its metrics."""
        segment, leaves = self.collect()
        shuffle, states = torch.Generator().manual_seed(update), [memory.state for memory in self.collector.memories]
        learnt = learn(self.agent, self.optimizer, segment, states, update, self.settings.ppo, shuffle)
        return segment, [*leaves, *learnt.values()]


@pytest.fixture
def make() -> Iterator[Callable[..., Run]]:
    """Makes runs, whose environments are closed after the test."""
    opened: list[Environments] = []

    def run(given: Settings, recorded: graphs.Graphs | None = None) -> Run:
        opened.append(Environments(given))
        return Run(given, opened[-1], recorded)

    yield run
    for environments in opened:
        environments.close()


def equal(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor):
        return torch.equal(one, other)
    return bool(one == other)


def compared(make: Callable[..., Run], given: Settings, recorded: RecordedGraphs | None = None) -> RecordedGraphs:
    """Compare runs with graphs and without bit by bit."""
    recorded = recorded or RecordedGraphs()
    eager, graphed = make(given), make(given, recorded)
    done = []
    for update in range(SEGMENTS):
        (segment, expected), (_, found) = eager.segment(update), graphed.segment(update)
        assert len(expected) == len(found)
        different = [index for index, pair in enumerate(zip(expected, found, strict=True)) if not equal(*pair)]
        assert not different, f"update {update}: {len(different)} of {len(expected)}"
        done.append(segment.done)
    if given.environment.observation != "rgb":
        # Episodes end in some of the environments; those of the GRU in the last step of a segment, too.
        ends = torch.stack(done)
        assert (ends.any(-1) & ~ends.all(-1)).any()
        assert ends[:-1, -1].any() or given.agent != "gru"
    return recorded


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.filterwarnings("error")
def test_rollouts_are_those_without_graphs_bit_by_bit(make: Callable[..., Run], kind: str) -> None:
    """Segments with updates in between, in which weights change, episodes end and the ring is filled several times."""
    recorded = compared(make, small(kind))
    # Two graphs for each group, captured once, and the steps that are compared with those without graphs.
    assert len(recorded.captures) == 2 * GROUPS
    assert recorded.replays == 2 * GROUPS * (SEGMENTS * STEPS + graphs.COMPARED_STEPS)


@pytest.mark.slow
@pytest.mark.parametrize(("agent", "operations"), [("gru", [34, 5]), ("trxl", [59, 19])])
def test_the_networks_of_the_paper(make: Callable[..., Run], agent: str, operations: list[int]) -> None:
    """With fewer environments, and a segment that is longer than the window of 256 steps."""
    paper = replace(PRESETS["paper"], env="Endless-MortarMayhem-v0", agent=agent)
    paper = replace(
        paper,
        environment=replace(paper.environment, num_envs=2, num_threads=1),
        ppo=replace(paper.ppo, steps=280),
    )
    recorded = RecordedGraphs()
    runs = make(paper), make(paper, recorded)
    for _ in range(2):
        (_, expected), (_, found) = (run.collect() for run in runs)
        assert len(expected) == len(found) and all(map(equal, expected, found))
        for run in runs:
            for parameter in run.agent.parameters():
                parameter.data *= 0.9
    assert recorded.captures == operations


def one_slot(self: fixed.FixedTransformer, step: torch.Tensor) -> torch.Tensor:
    return torch.full_like(step, self._cache.slot)


def one_step(self: graphs.GraphedGroup) -> None:
    self._step = torch.full_like(self._step, int(self._step))
    decide(self)


def copied_outcome(self: graphs.GraphedGroup, recorded: graphs.Graphs) -> None:
    self._outcome = self._outcome.clone()
    capture(self, recorded)


def weights_of_the_agent(self: graphs.GraphedGroup) -> None:
    load(self)
    self._weights = self._agent.acting_weights()


def hidden_is_replaced(self: fixed.FixedRecurrent, update: torch.Tensor, step: torch.Tensor) -> None:
    self.state.hidden = update


def update_is_freed(self: graphs.GraphedGroup, before: dict[str, Any]) -> None:
    self._decision = replace(self._decision, memory_update=None)
    compare(self, before)


def nothing(*args: Any) -> None:
    pass


def not_a_copy(self: fixed.FixedRecurrent) -> None:
    self.memory.store(self.state, copy=False)


capture, compare = graphs.GraphedGroup.capture, graphs.GraphedGroup._compare
decide, load = graphs.GraphedGroup._decide, graphs.GraphedGroup._load

#: Mistakes: an agent, a class, one of its methods, and what is in the place of the method.
MISTAKES = {
    "the slot is a number of the host": ("trxl", fixed.FixedTransformer, "_slot", one_slot),
    "the step is a number of the host": ("none", graphs.GraphedGroup, "_decide", one_step),
    "the ends of episodes are a copy": ("gru", graphs.GraphedGroup, "capture", copied_outcome),
    "what one graph hands to the other is freed": ("gru", graphs.GraphedGroup, "_compare", update_is_freed),
    "the weights are replaced": ("gru", graphs.GraphedGroup, "_load", weights_of_the_agent),
    "the weights are not made again": ("none", acting.ActingWeights, "copy_", nothing),
    "the blocks are not made again": ("trxl", transformer.ActingBlock, "copy_", nothing),
    "the layer before the blocks is not made again": ("trxl, previous", fixed, "refill", nothing),
    "the cache is not made again": ("trxl", transformer_cache.RingCache, "copy_", nothing),
    "the projection is not made again": ("trxl", transformer_cache.Projection, "copy_", nothing),
    "the hidden state is replaced": ("gru", fixed.FixedRecurrent, "update", hidden_is_replaced),
    "the stored hidden state is not a copy": ("lstm", fixed.FixedRecurrent, "advance", not_a_copy),
    "the host does not count columns": ("trxl", fixed.FixedTransformer, "advance", nothing),
    "the state is not moved": ("gtrxl", fixed.FixedTransformer, "load", nothing),
}


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_mistakes_are_found(make: Callable[..., Run], monkeypatch: pytest.MonkeyPatch, mistake: str) -> None:
    kind, owner, name, wrong = MISTAKES[mistake]
    monkeypatch.setattr(owner, name, wrong)
    with pytest.raises((AssertionError, RuntimeError, RuntimeWarning)):
        compared(make, small(kind))


class Faulty(RecordedGraphs):
    """Graphs with a fault in the capture with a given number."""

    def __init__(self, fault: str, number: int) -> None:
        super().__init__()
        self.fault, self.number = fault, number

    def capture(self, function: Callable[[], None]) -> Callable[[], None]:
        replay = super().capture(function)
        if len(self.captures) != self.number:
            return replay
        if self.fault == "refused":
            raise torch.cuda.OutOfMemoryError("there is no memory for the graph")
        # `remember` is the second graph of a group.
        return {"missing": lambda: None, "twice": lambda: (replay(), replay())}[self.fault]


@pytest.mark.parametrize("kind", ["none", "lstm", "stack", "trxl"])
@pytest.mark.parametrize(
    ("fault", "number", "message"),
    [
        ("refused", 1, "OutOfMemoryError: there is no memory for the graph"),
        # The first group has already acted by its graphs.
        ("refused", 4, "OutOfMemoryError: there is no memory for the graph"),
        ("missing", 1, "in step 0, (actions|outputs|observation)"),
        ("twice", 2, "in step [01], .* differs"),
        ("missing", 4, "in step [01], .* differs"),
    ],
)
def test_without_usable_graphs_a_run_goes_on(
    make: Callable[..., Run], kind: str, fault: str, number: int, message: str
) -> None:
    faulty = Faulty(fault, number)
    with pytest.warns(RuntimeWarning) as warned:
        compared(make, small(kind), faulty)
    assert len(warned) == 1
    assert re.search(message, str(warned[0].message))
    assert "training goes on without them" in str(warned[0].message)


def test_a_resumed_run_continues_as_without_graphs(make: Callable[..., Run]) -> None:
    for kind in ("lstm", "stack", "trxl"):
        given = small(kind)
        first = make(given, RecordedGraphs())
        first.segment(0)
        kept = copy.deepcopy((first.agent.state_dict(), first.collector.state_dict()))
        noise = first.collector.generator.get_state()
        _, expected = first.collect()
        for resumed in (make(given), make(given, RecordedGraphs()), first):
            resumed.agent.load_state_dict(kept[0])
            resumed.collector.load_state_dict(copy.deepcopy(kept[1]))
            resumed.collector.generator.set_state(noise)
            _, found = resumed.collect()
            assert len(found) == len(expected) and all(map(equal, expected, found)), kind


@pytest.mark.parametrize("kind", ["gru", "stack", "trxl"])
def test_acting_without_graphs_can_follow(make: Callable[..., Run], kind: str) -> None:
    """`Agent.act` with the memories of a rollout, and another rollout."""
    given = small(kind)
    runs = make(given), make(given, RecordedGraphs())
    for update in range(2):
        (_, expected), (_, found) = (run.segment(update) for run in runs)
        assert all(map(equal, expected, found))
        for group in range(GROUPS):
            for _ in range(3):
                one, other = (
                    run.agent.act(run.collector.current[group].observation, run.collector.memories[group], greedy=True)
                    for run in runs
                )
                assert all(map(equal, tree_leaves(vars(one)), tree_leaves(vars(other))))


def test_parameters_that_move_are_captured_again(make: Callable[..., Run]) -> None:
    given, recorded = small("gru"), RecordedGraphs()
    eager, graphed = make(given), make(given, recorded)
    for update in range(2):
        (_, expected), (_, found) = eager.segment(update), graphed.segment(update)
        assert all(map(equal, expected, found))
        for parameter in graphed.agent.parameters():
            parameter.data = parameter.data.clone()
    assert len(recorded.captures) == 2 * 2 * GROUPS


def test_differences_are_relative_and_no_number_differs() -> None:
    values = torch.tensor([1.0, -4.0])
    assert graphs.relative_difference(values, torch.tensor([1.0, -5.0])) == 0.25
    assert graphs.relative_difference(values.long(), values.long()) == graphs.relative_difference(2, 2) == 0.0
    nan, infinite = torch.tensor([1.0, math.nan]), torch.tensor([1.0, math.inf])
    for one, other in ((values, nan), (nan, values), (nan, nan), (values, infinite), (values.long(), -values.long())):
        assert graphs.relative_difference(one, other) == math.inf


def test_graphs_are_used_on_cuda_only() -> None:
    given, cuda = small("gru"), torch.device("cuda")
    assert isinstance(graphs.graphs_for(given, cuda), graphs.CudaGraphs)
    assert graphs.graphs_for(given, torch.device("cpu")) is None
    assert graphs.graphs_for(parse(["--no-cuda-graphs"]), cuda) is None
    assert graphs.graphs_for(replace(given, compile=True), cuda) is None


def test_cuda_graphs_are_captured_after_a_warm_up_on_another_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    """The calls of PyTorch, in order; nothing is captured."""
    calls: list[str] = []

    class Stream:
        def __init__(self, name: object) -> None:
            self.name = "side" if isinstance(name, torch.device) else name

        def wait_stream(self, other: "Stream") -> None:
            calls.append(f"{self.name} waits for {other.name}")

    @contextmanager
    def entered(name: str) -> Iterator[None]:
        calls.append(f"enter {name}")
        yield
        calls.append(f"leave {name}")

    class CUDAGraph:
        def replay(self) -> None:
            calls.append("replay")

    def graph(made: CUDAGraph, capture_error_mode: str) -> AbstractContextManager[None]:
        assert isinstance(made, CUDAGraph) and capture_error_mode == "thread_local"
        return entered("capture")

    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: Stream("main"))
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: entered(stream.name))
    monkeypatch.setattr(torch.cuda, "device", lambda device: entered(str(device)))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", CUDAGraph)
    monkeypatch.setattr(torch.cuda, "graph", graph)
    monkeypatch.setattr(torch.cuda, "get_sync_debug_mode", lambda: 0)
    monkeypatch.setattr(torch.cuda, "set_sync_debug_mode", lambda mode: calls.append(f"waits: {mode}"))
    made = graphs.CudaGraphs(torch.device("cuda", 0))
    made.warm_up(lambda: calls.append("run"))
    run = ["run"] * graphs.WARM_UPS
    assert calls == [
        *("side waits for main", "enter side", *run, "waits: error", "run", "waits: 0", "leave side"),
        "main waits for side",
    ]
    calls.clear()

    def failing() -> None:
        raise RuntimeError("in the warm-up")

    with pytest.raises(RuntimeError, match="in the warm-up"):
        made.warm_up(failing)
    assert calls[-1] == "main waits for side"
    calls.clear()
    made.capture(lambda: calls.append("run"))()
    assert calls == ["enter cuda:0", "enter capture", "run", "leave capture", "leave cuda:0", "replay"]
