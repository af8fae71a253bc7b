"""The memories: outputs equal plain references, and every weight gets a gradient. `conformance` checks that nothing leaks."""

import math
from dataclasses import replace

import pytest
import torch
from agents_helpers import BRANCHES, ends, loss_of, make, observations, play, segment_of, settings, transformer

from endless_gym_agents.agent.agent import Agent, AgentMemory
from endless_gym_agents.agent.encoders import FRAME
from endless_gym_agents.memories.transformer import TransformerMemory
from endless_gym_agents.memories.transformer_block import Block
from endless_gym_agents.settings import PRESETS, Recurrence
from endless_gym_agents.training.rollout import Segment

STEPS, ENVS = 24, 3

KINDS = {
    "none": ("none", {}),
    "position": ("position", {}),
    "stack": ("stack", {}),
    "gru": ("gru", {}),
    "gru, two layers, residual": ("gru", {"recurrence": Recurrence(16, layers=2, residual=True, sequence_length=6)}),
    "gru, PyTorch's operations": ("gru", {"recurrence": Recurrence(16, sequence_length=8, kernels="torch")}),
    "lstm": ("lstm", {}),
    "lstm, two layers": ("lstm", {"recurrence": Recurrence(16, layers=2, sequence_length=8)}),
    "lstm without embedding": ("lstm", {"recurrence": Recurrence(16, embedding=False, sequence_length=24)}),
    "mingru": ("mingru", {}),
    "mingru, two layers": ("mingru", {"recurrence": Recurrence(16, layers=2, sequence_length=8)}),
    "mingru, positive": ("mingru", {"agent_option": ("positive=true",)}),
    "mingru, PyTorch's operations": ("mingru", {"recurrence": Recurrence(16, sequence_length=8, kernels="torch")}),
    "trxl": ("trxl", {}),
    "trxl, full heads": ("trxl", transformer(shared_heads=False)),
    "trxl, learned": ("trxl", transformer(positional_encoding="learned", query_encoding=True)),
    "trxl, relative": ("trxl", transformer(positional_encoding="relative")),
    "trxl, no positions": ("trxl", transformer(positional_encoding="none")),
    "trxl, query encoding": ("trxl", transformer(query_encoding=True)),
    "trxl, previous": ("trxl", transformer(query_previous=True)),
    "trxl, single steps, previous": ("trxl", transformer(sequence_length=1, query_previous=True, query_encoding=True)),
    "trxl, one block, relative, previous": (
        "trxl",
        transformer(layers=1, positional_encoding="relative", query_previous=True),
    ),
    "gtrxl, learned, previous": ("gtrxl", transformer(positional_encoding="learned", query_previous=True)),
    "trxl, short sequences": ("trxl", transformer(sequence_length=4)),
    "trxl, one sequence": ("trxl", transformer(sequence_length=64)),
    "trxl, single steps": ("trxl", transformer(sequence_length=1)),
    "trxl, single steps, separate heads": ("trxl", transformer(sequence_length=1, shared_heads=False)),
    "trxl, single steps, relative": ("trxl", transformer(sequence_length=1, positional_encoding="relative")),
    "trxl, single steps, learned": ("trxl", transformer(sequence_length=1, positional_encoding="learned")),
    "gtrxl": ("gtrxl", transformer(gate_bias=2.0)),
}
TRANSFORMERS = [name for name in KINDS if "trxl" in name]


@pytest.fixture(autouse=True)
def short_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Groups of single steps from several parts of a segment; with the short window, the last part is longer than the segment."""
    monkeypatch.setattr("endless_gym_agents.memories.transformer.SHORTEST_PART", 5)


def agent_of(name: str) -> Agent:
    kind, changes = KINDS[name]
    return make(kind, **changes)


@pytest.fixture(params=KINDS)
def agent(request: pytest.FixtureRequest) -> Agent:
    return agent_of(request.param)


@pytest.mark.parametrize("minibatches", [1, 3])
def test_forward_equals_act(agent: Agent, minibatches: int) -> None:
    """Equal log-probabilities and values for each step of the second of two segments; each step is in one minibatch."""
    memory, done = agent.initial_memory(ENVS), ends(2 * STEPS, ENVS)
    observed = observations(2 * STEPS, ENVS)
    play(agent, memory, observed[:STEPS], done[:STEPS])
    observations_seen = []
    agent.transform.apply, apply = _recording(agent.transform.apply, observations_seen), agent.transform.apply
    reset_mask, action, log_prob, value = play(agent, memory, observed[STEPS:], done[STEPS:])
    agent.transform.apply = apply
    seen = {key: torch.stack([step[key] for step in observations_seen]).flatten(0, 1) for key in observations_seen[0]}
    batches = agent.memory.minibatches([memory.state], reset_mask, minibatches, torch.Generator().manual_seed(0))
    indices = torch.cat([minibatch.indices for minibatch in batches])
    assert sorted(indices.tolist()) == list(range(STEPS * ENVS))
    assert len(batches) == minibatches
    for minibatch in batches:
        output = agent({key: part[minibatch.indices] for key, part in seen.items()}, minibatch)
        assert_close(output.value, value.flatten()[minibatch.indices])
        assert_close(
            output.log_prob(action.flatten(0, 1)[minibatch.indices]), log_prob.flatten(0, 1)[minibatch.indices]
        )


def test_epochs_follow_one_another(agent: Agent) -> None:
    """Two epochs have the same minibatches as two single epochs with the same generator."""
    memory = agent.initial_memory(ENVS)
    reset_mask, *_ = play(agent, memory, observations(STEPS, ENVS), ends(STEPS, ENVS))

    def divided(generator: torch.Generator, epochs: int) -> list[list[int]]:
        batches = agent.memory.minibatches([memory.state], reset_mask, 2, generator, epochs=epochs)
        return [minibatch.indices.tolist() for minibatch in batches]

    generator = torch.Generator().manual_seed(0)
    apart = [divided(generator, 1), divided(generator, 1)]
    assert divided(torch.Generator().manual_seed(0), 2) == apart[0] + apart[1]


@pytest.mark.parametrize("name", [name for name in KINDS if KINDS[name][0] != "stack"])
def test_rank_may_have_no_steps_in_a_minibatch(name: str) -> None:
    """A rank with one of three environments has steps in only some of the minibatches; the others are empty."""
    agent = agent_of(name)
    memory, done = agent.initial_memory(1), ends(STEPS, 1)
    reset_mask, *_ = play(agent, memory, observations(STEPS, 1), done)
    everywhere = reset_mask.expand(STEPS, ENVS)
    many = STEPS * ENVS
    batches = agent.memory.minibatches(
        [memory.state], everywhere, many, torch.Generator().manual_seed(0), own=range(1, 2)
    )
    indices = [minibatch.indices for minibatch in batches]
    assert not all(len(part) for part in indices)
    assert sorted(torch.cat(indices).tolist()) == list(range(STEPS))


# The observation of the agents `stack` and `position` is transformed in `act`, before the network.
@pytest.mark.parametrize("name", [name for name in KINDS if name not in ("stack", "position")])
def test_every_weight_gets_a_gradient(name: str) -> None:
    """That weights change is not enough, since AdamW also decays weights without a gradient."""
    agent = agent_of(name)
    memory, observed = agent.initial_memory(ENVS), observations(STEPS, ENVS)
    # In the second segment, the hidden states of recurrent layers are no longer zero.
    play(agent, memory, observed, ends(STEPS, ENVS))
    segment = segment_of(agent, memory, {"features": observed}, STEPS, ENVS)
    assert without_gradient(agent, segment, memory) == []


@pytest.mark.parametrize("kind", ["gru", "trxl"])
def test_every_weight_of_an_agent_with_all_heads_gets_a_gradient(kind: str) -> None:
    ppo = {"reconstruction_coefficient": 0.1, "ground_truth_coefficient": 1.0}
    given = settings(kind, ppo=ppo, environment={"observation": "rgb"})
    torch.manual_seed(3)
    agent = Agent(given, {FRAME: (84, 84, 3), "vector_observation": (5,)}, BRANCHES, ground_truth=2)
    memory, draws = agent.initial_memory(ENVS), torch.Generator().manual_seed(4)
    frames = torch.randint(0, 256, (STEPS, ENVS, 84, 84, 3), dtype=torch.uint8, generator=draws)
    observation = {FRAME: frames, "vector_observation": torch.randn(STEPS, ENVS, 5, generator=draws)}
    segment = segment_of(agent, memory, observation, STEPS, ENVS)
    assert without_gradient(agent, segment, memory) == []


def without_gradient(agent: Agent, segment: Segment, memory: AgentMemory) -> list[str]:
    """Names of the weights whose gradient of the total loss is missing or entirely 0."""
    loss_of(agent, segment, memory.state, agent.settings.ppo, 0.01).backward()
    return [name for name, weight in agent.named_parameters() if weight.grad is None or not weight.grad.any()]


@pytest.mark.parametrize("name", TRANSFORMERS)
def test_gradients_are_the_same_for_each_sequence_length(name: str) -> None:
    """Sequences of one step are computed by a different algorithm than longer ones."""
    agent = agent_of(name)
    memory, observed = agent.initial_memory(ENVS), observations(STEPS, ENVS)
    play(agent, memory, observed, ends(STEPS, ENVS))
    reset_mask, *_ = play(agent, memory, observed, ends(STEPS, ENVS))
    factor, gradients = torch.randn(STEPS * ENVS), []
    for length in (1, 4, STEPS):
        agent.memory.settings = replace(agent.memory.settings, sequence_length=length)
        (minibatch,) = agent.memory.minibatches([memory.state], reset_mask, 1, torch.Generator().manual_seed(0))
        agent.zero_grad()
        value = agent({"features": observed.flatten(0, 1)[minibatch.indices]}, minibatch).value
        (value * factor[minibatch.indices]).sum().backward()
        gradients.append({key: weight.grad for key, weight in agent.named_parameters() if weight.grad is not None})
    for other in gradients[1:]:
        torch.testing.assert_close(other, gradients[0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", TRANSFORMERS)
@pytest.mark.parametrize("recording", [True, False])
def test_kv_cache_equals_a_loop_over_windows(name: str, recording: bool) -> None:
    """Transformer-XL against a plain loop that projects the window of each step and environment separately."""
    agent = agent_of(name)
    memory, steps = agent.initial_memory(ENVS), 5 * STEPS
    observed, done = observations(steps, ENVS), ends(steps, ENVS)
    outputs = []
    for step in range(steps):
        # Without segments, the state is compacted whenever it is full.
        if recording and step % STEPS == 0:
            agent.memory.begin_segment(memory.state, STEPS)
        outputs.append(agent.act({"features": observed[step]}, memory).value)
        memory.reset(done[step])
    expected = _plain_transformer(agent, observed, done)
    assert_close(torch.stack(outputs), expected)


def _plain_transformer(agent: Agent, observed: torch.Tensor, done: torch.Tensor) -> torch.Tensor:
    module: TransformerMemory = agent.memory
    values = torch.zeros(observed.shape[:2])
    for env in range(observed.shape[1]):
        episode: list[list[torch.Tensor]] = []  # the inputs of all blocks for each step of the episode
        for step in range(observed.shape[0]):
            with torch.no_grad():
                x = module.embedding(agent.encoder({"features": observed[step, env : env + 1]}))[0]
                inputs, now = [], len(episode)
                if module.fusion is not None:
                    previous = episode[-1][-1] if episode else torch.zeros(module.width)
                    linear = module.fusion[0]
                    x = torch.relu(linear.weight @ torch.cat([x, previous]) + linear.bias)
                window = range(max(0, now - module.settings.window + 1), now)
                for layer, block in enumerate(module.blocks):
                    inputs.append(x)
                    if module.settings.query_encoding:
                        x = x + _encoding(module, now)
                    tokens = [episode[t][layer] + _encoding(module, t) for t in window]
                    x = _plain_block(block, x, tokens, [now - t for t in window])
                episode.append(inputs)
                values[step, env] = agent.value(agent.body(x))
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

    def projected(layer: torch.nn.Linear, vectors: torch.Tensor) -> torch.Tensor:
        if layer.in_features == attention.size:
            return layer(vectors.unflatten(-1, (attention.heads, -1)))
        return layer(vectors).unflatten(-1, (attention.heads, -1))

    attended = torch.zeros_like(x)
    if tokens:
        normal, query = block.norm_tokens(torch.stack(tokens)), projected(attention.queries, block.norm_query(x))
        scores = torch.einsum("hf,thf->th", query, projected(attention.keys, normal))
        if attention.relative:
            distances = torch.stack([_sinusoid(age, len(x)) for age in ages])
            scores += torch.einsum("hf,thf->th", attention.content_bias[:, 0], projected(attention.keys, normal))
            biased = query + attention.distance_bias[:, 0]
            scores += torch.einsum("hf,thf->th", biased, projected(attention.distances, distances))
        weights = torch.softmax(scores / math.sqrt(len(x)), dim=0)
        attended = torch.einsum("th,thf->hf", weights, projected(attention.values, normal)).flatten()
    attended = attention.fc_out(attended)
    # `test_agents_authors.py` tests the gates.
    x = x + attended if block.gate_attention is None else block.gate_attention(x, attended)
    added = torch.relu(block.fc(block.norm_fc(x)))
    return x + added if block.gate_fc is None else block.gate_fc(x, added)


def test_kv_cache_is_recomputed_when_a_segment_begins() -> None:
    """After an update of the weights, the outputs use the new weights."""
    agent, observed, done = make("trxl"), observations(2 * STEPS, ENVS), ends(2 * STEPS, ENVS)
    memory = agent.initial_memory(ENVS)
    play(agent, memory, observed[:STEPS], done[:STEPS])
    for block in agent.memory.blocks:
        block.attention.keys.weight.data.mul_(-1)
    reset_mask, _, _, value = play(agent, memory, observed[STEPS:], done[STEPS:])
    (minibatch,) = agent.memory.minibatches([memory.state], reset_mask, 1, torch.Generator().manual_seed(0))
    output = agent({"features": observed[STEPS:].flatten(0, 1)[minibatch.indices]}, minibatch)
    assert_close(output.value, value.flatten()[minibatch.indices])


def test_stack_holds_the_last_grey_frames_of_an_episode() -> None:
    agent = Agent(PRESETS["paper"].__class__(agent="stack"), {"visual_observation": (84, 84, 3)}, BRANCHES)
    memory = agent.initial_memory(2)
    colours = torch.tensor([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [10, 20, 30]], dtype=torch.uint8)
    stacks = []
    for colour in colours:
        frames = colour.expand(2, 84, 84, 3)
        stacks.append(agent.act({"visual_observation": frames}, memory).observation["visual_observation"])
        memory.reset(torch.tensor([False, len(stacks) == 3]))
    assert stacks[0].shape == (2, 84, 84, 4)
    assert stacks[0][0, 5, 7].tolist() == [76] * 4  # 0.299 * 255
    assert stacks[2][0, 5, 7].tolist() == [76, 76, 150, 29]
    assert stacks[4][0, 0, 0].tolist() == [150, 29, 255, 18]
    assert stacks[4][1, 0, 0].tolist() == [255, 255, 255, 18]  # its episode starts with the fourth frame


def test_position_encoding_alternates_sine_and_cosine() -> None:
    agent, observed = make("position"), observations(3, 2)
    memory = agent.initial_memory(2)
    for step in range(3):
        seen = agent.act({"features": observed[step]}, memory).observation["position"]
        memory.reset(torch.tensor([False, step == 0]))
    expected = [f(2 / 10_000 ** (2 * i / 16)) for i in range(8) for f in (math.sin, math.cos)]
    assert_close(seen[0], torch.tensor(expected))
    assert_close(seen[1, :2], torch.tensor([math.sin(1), math.cos(1)]))


def assert_close(one: torch.Tensor, two: torch.Tensor) -> None:
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


def _recording(apply, seen):
    def recorded(observation, state, reset_mask):
        result = apply(observation, state, reset_mask)
        seen.append(result[0])
        return result

    return recorded
