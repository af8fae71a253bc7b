"""The memories: what they compute, against plain references, and that nothing leaks from the future or another episode."""

import math

import pytest
import torch
from agents_helpers import BRANCHES, ends, make, observations, play, settings, transformer

from endless_gym.agents.agent import Agent
from endless_gym.agents.memory import shares
from endless_gym.agents.settings import PRESETS, Recurrence
from endless_gym.agents.transformer import Block, Gate, TransformerMemory

STEPS, ENVS = 24, 3

KINDS = {
    "none": ("none", {}),
    "position": ("position", {}),
    "stack": ("stack", {}),
    "gru": ("gru", {}),
    "gru, two layers, residual": ("gru", {"recurrence": Recurrence(16, layers=2, residual=True, sequence_length=5)}),
    "lstm": ("lstm", {}),
    "lstm without embedding": ("lstm", {"recurrence": Recurrence(16, embedding=False, sequence_length=24)}),
    "trxl": ("trxl", {}),
    "trxl, full heads": ("trxl", transformer(shared_heads=False)),
    "trxl, learned": ("trxl", transformer(positional_encoding="learned", query_encoding=True)),
    "trxl, relative": ("trxl", transformer(positional_encoding="relative")),
    "trxl, no positions": ("trxl", transformer(positional_encoding="none")),
    "trxl, query encoding": ("trxl", transformer(query_encoding=True)),
    "trxl, short sequences": ("trxl", transformer(sequence_length=4)),
    "trxl, one sequence": ("trxl", transformer(sequence_length=64)),
    "gtrxl": ("gtrxl", transformer(gate_bias=2.0)),
}
REMEMBERING = [name for name in KINDS if name not in ("none", "position")]


@pytest.fixture(params=KINDS)
def agent(request: pytest.FixtureRequest) -> Agent:
    kind, changes = KINDS[request.param]
    return make(kind, **changes)


@pytest.mark.parametrize("minibatches", [1, 3])
def test_learning_sees_what_acting_saw(agent: Agent, minibatches: int) -> None:
    """The same log-probabilities and values, for each step of the second of two segments, once."""
    memory, done = agent.initial_memory(ENVS), ends(2 * STEPS, ENVS)
    observed = observations(2 * STEPS, ENVS)
    play(agent, memory, observed[:STEPS], done[:STEPS])
    acted_on = []
    agent.observer.observe, observe = _recording(agent.observer.observe, acted_on), agent.observer.observe
    first, action, log_prob, value = play(agent, memory, observed[STEPS:], done[STEPS:])
    agent.observer.observe = observe
    seen = {key: torch.stack([step[key] for step in acted_on]).flatten(0, 1) for key in acted_on[0]}
    plans = agent.memory.plan([memory.state], first, minibatches, torch.Generator().manual_seed(0))
    steps = torch.cat([plan.steps for plan in plans])
    assert sorted(steps.tolist()) == list(range(STEPS * ENVS))
    assert len(plans) == minibatches
    for plan in plans:
        evaluated = agent.evaluate({key: part[plan.steps] for key, part in seen.items()}, plan)
        assert_close(evaluated.value, value.flatten()[plan.steps])
        assert_close(evaluated.log_prob(action.flatten(0, 1)[plan.steps]), log_prob.flatten(0, 1)[plan.steps])


def test_groups_are_put_side_by_side() -> None:
    for kind in ("gru", "lstm", "trxl"):
        agent, observed, done = make(kind), observations(STEPS, 4), ends(STEPS, 4)
        memories = [agent.initial_memory(2) for _ in range(2)]
        parts = [play(agent, memories[g], observed[:, 2 * g : 2 * g + 2], done[:, 2 * g : 2 * g + 2]) for g in range(2)]
        first, value = (torch.cat([part[i] for part in parts], dim=1) for i in (0, 3))
        for plan in agent.memory.plan([m.state for m in memories], first, 2, torch.Generator().manual_seed(0)):
            evaluated = agent.evaluate({"features": observed.flatten(0, 1)[plan.steps]}, plan)
            assert_close(evaluated.value, value.flatten()[plan.steps])


@pytest.mark.parametrize("name", REMEMBERING)
def test_no_leak_while_acting(name: str) -> None:
    """An input reaches what comes after it in its own episode, in its own environment, and nothing else."""
    kind, changes = KINDS[name]
    agent = make(kind, **changes)
    done = torch.zeros(STEPS, ENVS, dtype=torch.bool)
    done[9, 1] = True  # the episode that the changed step belongs to has steps 0 to 9
    observed = observations(STEPS, ENVS)
    changed = observed.clone()
    changed[6, 1] += 1.0
    _, _, _, before = play(agent, agent.initial_memory(ENVS), observed, done)
    _, _, _, after = play(agent, agent.initial_memory(ENVS), changed, done)
    differs = before != after
    may = torch.zeros_like(differs)
    may[6:10, 1] = True
    assert not differs[~may].any()
    # The stack is four steps long: with it as with the others, all steps up to 9 are reached.
    assert differs[6:10, 1].all()


# Stacks are made while acting: learning takes them as they are.
@pytest.mark.parametrize("name", [name for name in REMEMBERING if KINDS[name][0] != "stack"])
def test_no_leak_while_learning(name: str) -> None:
    """The gradient of one step's value with regard to all observations: in its own episode, not after it, and its own."""
    kind, changes = KINDS[name]
    agent = make(kind, **changes)
    memory, done = agent.initial_memory(ENVS), torch.zeros(STEPS, ENVS, dtype=torch.bool)
    done[9, 1] = True
    observed = observations(STEPS, ENVS)
    first, *_ = play(agent, memory, observed, done)
    (plan,) = agent.memory.plan([memory.state], first, 1, torch.Generator().manual_seed(0))
    flat = observed.flatten(0, 1)[plan.steps].requires_grad_()
    value = agent.evaluate({"features": flat}, plan).value
    (gradient,) = torch.autograd.grad(value[(plan.steps == 15 * ENVS + 1).nonzero().item()], flat)
    reached = {(int(step) // ENVS, int(step) % ENVS) for step in plan.steps[gradient.abs().sum(-1) > 0]}
    assert (15, 1) in reached
    assert reached <= {(t, 1) for t in range(10, 16)}
    if kind in ("trxl", "gtrxl"):
        # The episodic memory has no gradient.
        assert reached == {(15, 1)}
    else:
        # Back to the start of the episode or of the sequence.
        length = changes.get("recurrence", settings(kind).recurrence).sequence_length
        assert reached == {(t, 1) for t in range(max(10, 15 - 15 % length), 16)}


@pytest.mark.parametrize("name", [name for name in KINDS if "trxl" in name])
def test_cached_tokens_leak_nothing_while_learning(name: str) -> None:
    """What a cached token may change: the next `window - 1` steps of its own episode."""
    kind, changes = KINDS[name]
    agent = make(kind, **changes)
    window = agent.memory.settings.window
    memory, done = agent.initial_memory(ENVS), torch.zeros(STEPS, ENVS, dtype=torch.bool)
    done[13, 1] = True
    observed = observations(STEPS, ENVS)
    first, *_ = play(agent, memory, observed, done)

    def values() -> torch.Tensor:
        (plan,) = agent.memory.plan([memory.state], first, 1, torch.Generator().manual_seed(0))
        value = agent.evaluate({"features": observed.flatten(0, 1)[plan.steps]}, plan).value
        return torch.zeros(STEPS * ENVS).index_copy(0, plan.steps, value.detach()).view(STEPS, ENVS)

    for step, last in ((6, 6 + window - 1), (11, 13)):
        before = values()
        token = memory.state.inputs[:, 1, window - 1 + step]
        kept = token.clone()
        token += torch.randn(token.shape)
        differs = values() != before
        token.copy_(kept)
        expected = torch.zeros_like(differs)
        expected[step + 1 : last + 1, 1] = True
        assert torch.equal(differs, expected)


@pytest.mark.parametrize("name", [name for name in KINDS if "trxl" in name])
@pytest.mark.parametrize("room", ["segments", "free"])
def test_window_free_attention_is_the_windows(name: str, room: str) -> None:
    """Transformer-XL against a plain loop: for each step and environment its own window, projected anew."""
    kind, changes = KINDS[name]
    agent = make(kind, **changes)
    memory, steps = agent.initial_memory(ENVS), 5 * STEPS
    observed, done = observations(steps, ENVS), ends(steps, ENVS)
    outputs = []
    for step in range(steps):
        # Without segments, the memory is moved to the front whenever it is full.
        if room == "segments" and step % STEPS == 0:
            agent.memory.begin_segment(memory.state, STEPS)
        outputs.append(agent.act({"features": observed[step]}, memory).value)
        memory.forget(done[step])
    expected = _plain_transformer(agent, observed, done)
    assert_close(torch.stack(outputs), expected)


def _plain_transformer(agent: Agent, observed: torch.Tensor, done: torch.Tensor) -> torch.Tensor:
    module: TransformerMemory = agent.memory
    values = torch.zeros(observed.shape[:2])
    for env in range(observed.shape[1]):
        episode: list[list[torch.Tensor]] = []  # for each step of the episode the inputs of all blocks
        for step in range(observed.shape[0]):
            with torch.no_grad():
                x = module.embedding(agent.encoder({"features": observed[step, env : env + 1]}))[0]
                inputs, now = [], len(episode)
                window = range(max(0, now - module.settings.window + 1), now)
                for layer, block in enumerate(module.blocks):
                    inputs.append(x)
                    if module.settings.query_encoding:
                        x = x + _encoding(module, now)
                    tokens = [episode[t][layer] + _encoding(module, t) for t in window]
                    x = _plain_block(block, x, tokens, [now - t for t in window])
                episode.append(inputs)
                values[step, env] = agent.value(agent.body(x.unsqueeze(0)))[0]
            if done[step, env]:
                episode = []
    return values


def _encoding(module: TransformerMemory, position: int) -> torch.Tensor:
    kind, width = module.settings.positional_encoding, module.width
    if kind == "learned":
        return module.table[min(position, module.positions - 1)]
    if kind != "absolute":
        return torch.zeros(width)
    return _sinusoid(module.positions - 1 - min(position, module.positions - 1), width)


def _sinusoid(angle: float, width: int) -> torch.Tensor:
    scaled = [angle / 10_000 ** (2 * i / width) for i in range(width // 2)]
    return torch.tensor([math.sin(a) for a in scaled] + [math.cos(a) for a in scaled])


def _plain_block(block: Block, x: torch.Tensor, tokens: list[torch.Tensor], ages: list[int]) -> torch.Tensor:
    attention = block.attention
    heads, size, width = attention.heads, attention.size, x.shape[-1]

    def projected(layer: torch.nn.Linear, vector: torch.Tensor, head: int) -> torch.Tensor:
        part = slice(head * size, (head + 1) * size)
        return layer.weight @ vector[part] if layer.in_features == size else (layer.weight @ vector)[part]

    normal = [block.norm_tokens(token) for token in tokens]
    query = block.norm_query(x)
    summed = torch.zeros(width)
    for head in range(heads if tokens else 0):
        q = projected(attention.queries, query, head)
        scores = []
        for token, age in zip(normal, ages, strict=True):
            k = projected(attention.keys, token, head)
            if attention.relative:
                r = projected(attention.distances, _sinusoid(age, width), head)
                scores.append((q + attention.content_bias[head, 0]) @ k + (q + attention.distance_bias[head, 0]) @ r)
            else:
                scores.append(q @ k)
        weights = torch.softmax(torch.stack(scores) / math.sqrt(width), dim=0)
        mixed = sum(w * projected(attention.values, token, head) for w, token in zip(weights, normal, strict=True))
        summed[head * size : (head + 1) * size] = mixed
    attended = attention.fc_out(summed)
    x = x + attended if block.gate_attention is None else _plain_gate(block.gate_attention, x, attended)
    added = torch.relu(block.fc(block.norm_fc(x)))
    return x + added if block.gate_fc is None else _plain_gate(block.gate_fc, x, added)


def _plain_gate(gate: Gate, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    width = x.shape[-1]
    w_r, w_z, w_g = gate.from_y.weight.split(width)
    u_r, u_z = gate.from_x.weight.split(width)
    r, z = torch.sigmoid(w_r @ y + u_r @ x), torch.sigmoid(w_z @ y + u_z @ x - gate.bias)
    return (1 - z) * x + z * torch.tanh(w_g @ y + gate.from_reset.weight @ (r * x))


def test_gru_cell_by_hand() -> None:
    """One step of the GRU agent from the equations, with its weights."""
    agent = make("gru")
    x = agent.memory.embedding(agent.encoder({"features": observations(1, 1)[0]}))[0]
    parts = agent.memory.recurrent
    hidden = torch.randn(16)
    memory = agent.initial_memory(1)
    memory.state.hidden[0, 0, 0] = hidden
    memory.first[:] = False
    i_r, i_z, i_n = (parts.weight_ih_l0 @ x + parts.bias_ih_l0).split(16)
    h_r, h_z, h_n = (parts.weight_hh_l0 @ hidden + parts.bias_hh_l0).split(16)
    r, z = torch.sigmoid(i_r + h_r), torch.sigmoid(i_z + h_z)
    expected = (1 - z) * torch.tanh(i_n + r * h_n) + z * hidden
    agent.act({"features": observations(1, 1)[0]}, memory)
    assert_close(memory.state.hidden[0, 0, 0], expected.detach())


def test_estimate_remembers_nothing() -> None:
    for kind in ("none", "position", "stack", "gru", "lstm", "trxl"):
        agent, observed = make(kind), observations(4, ENVS)
        memory = agent.initial_memory(ENVS)
        for step in range(3):
            agent.act({"features": observed[step]}, memory)
        once = agent.estimate({"features": observed[3]}, memory)
        assert torch.equal(agent.estimate({"features": observed[3]}, memory), once)
        assert_close(agent.act({"features": observed[3]}, memory).value, once)


def test_memory_travels_through_a_checkpoint() -> None:
    for kind, changes in KINDS.values():
        agent, observed, done = make(kind, **changes), observations(2 * STEPS, ENVS), ends(2 * STEPS, ENVS)
        memory, other = agent.initial_memory(ENVS), agent.initial_memory(ENVS)
        play(agent, memory, observed[:STEPS], done[:STEPS])
        other.load(memory.tensors())
        one, two = (play(agent, m, observed[STEPS:], done[STEPS:])[3] for m in (memory, other))
        assert torch.equal(one, two)


def test_weights_that_change_reach_the_cached_tokens() -> None:
    """Keys and values are made anew at each segment."""
    agent, observed, done = make("trxl"), observations(2 * STEPS, ENVS), ends(2 * STEPS, ENVS)
    memory = agent.initial_memory(ENVS)
    play(agent, memory, observed[:STEPS], done[:STEPS])
    for block in agent.memory.blocks:
        block.attention.keys.weight.data.mul_(-1)
    first, _, _, value = play(agent, memory, observed[STEPS:], done[STEPS:])
    (plan,) = agent.memory.plan([memory.state], first, 1, torch.Generator().manual_seed(0))
    evaluated = agent.evaluate({"features": observed[STEPS:].flatten(0, 1)[plan.steps]}, plan)
    assert_close(evaluated.value, value.flatten()[plan.steps])


def test_a_compiled_agent_says_the_same() -> None:
    agent, observed, done = make("trxl"), observations(STEPS, ENVS), ends(STEPS, ENVS)
    _, action, _, value = play(agent, agent.initial_memory(ENVS), observed, done)
    parameters = agent.state_dict().keys()
    agent.compile_parts()
    _, again, _, compiled = play(agent, agent.initial_memory(ENVS), observed, done)
    assert torch.equal(action, again)
    assert_close(compiled, value)
    assert agent.state_dict().keys() == parameters


def test_shares_are_of_about_the_same_size() -> None:
    sizes = [1, 30, 5, 5, 9, 2, 2, 2, 8, 8, 8, 20]
    parts = shares(sizes, 4, torch.Generator().manual_seed(1))
    assert sorted(torch.cat(parts).tolist()) == list(range(len(sizes)))
    assert all(10 <= sum(sizes[i] for i in part) <= 40 for part in parts)
    assert len(shares([1], 4, torch.Generator())) == 1


def test_stack_of_grey_frames() -> None:
    agent = Agent(PRESETS["paper"].__class__(agent="stack"), {"visual_observation": (84, 84, 3)}, BRANCHES)
    memory = agent.initial_memory(2)
    colours = torch.tensor([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [10, 20, 30]], dtype=torch.uint8)
    stacks = []
    for colour in colours:
        frames = colour.expand(2, 84, 84, 3)
        stacks.append(agent.act({"visual_observation": frames}, memory).observation["visual_observation"])
        memory.forget(torch.tensor([False, len(stacks) == 3]))
    assert stacks[0].shape == (2, 84, 84, 4)
    assert stacks[0][0, 5, 7].tolist() == [76] * 4  # 0.299 * 255
    assert stacks[2][0, 5, 7].tolist() == [76, 76, 150, 29]
    assert stacks[4][0, 0, 0].tolist() == [150, 29, 255, 18]
    assert stacks[4][1, 0, 0].tolist() == [255, 255, 255, 18]  # its episode began with the fourth frame


def test_positions_are_told_in_turns_of_sine_and_cosine() -> None:
    agent, observed = make("position"), observations(3, 2)
    memory = agent.initial_memory(2)
    for step in range(3):
        seen = agent.act({"features": observed[step]}, memory).observation["position"]
        memory.forget(torch.tensor([False, step == 0]))
    expected = [f(2 / 10_000 ** (2 * i / 16)) for i in range(8) for f in (math.sin, math.cos)]
    assert_close(seen[0], torch.tensor(expected))
    assert_close(seen[1, :2], torch.tensor([math.sin(1), math.cos(1)]))


def assert_close(one: torch.Tensor, two: torch.Tensor) -> None:
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


def _recording(observe, seen):
    def recorded(observation, state, first):
        result = observe(observation, state, first)
        seen.append(result[0])
        return result

    return recorded
