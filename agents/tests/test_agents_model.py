"""The network: number of parameters, heads, settings and presets."""

import math
from dataclasses import replace

import pytest
import torch
from agents_helpers import BRANCHES, changed, documented_settings, make, settings
from operations import Products

from endless_gym import make_vec, spec
from endless_gym_agents.agent.agent import Agent, make_agent
from endless_gym_agents.agent.encoders import FRAME, FRAMES_PER_CHUNK, AtariEncoder
from endless_gym_agents.agent.heads import PolicyHead, ReconstructionHead
from endless_gym_agents.evaluation import curves
from endless_gym_agents.memories.transformer import TransformerMemory
from endless_gym_agents.memories.transformer_block import Block
from endless_gym_agents.settings import PRESETS, Recurrence, Transformer, from_dict, to_dict
from endless_gym_agents.training.train import parse

PAPER = PRESETS["paper"]


@pytest.mark.parametrize(
    ("agent", "changes", "count"),
    [
        ("gru", {}, 4_049_575),
        ("gru", {"recurrence": Recurrence(hidden_size=384)}, 2_713_255),
        ("trxl", {}, 2_803_111),
        # Full heads: three matrices of 384 x 384 for three of 96 x 96, in three blocks.
        ("trxl", {"transformer": Transformer(shared_heads=False)}, 2_803_111 + 9 * (384**2 - 96**2)),
        ("trxl", {"transformer": Transformer(positional_encoding="learned")}, 2_803_111 + 2048 * 384),
        # One more matrix of a head's size and two biases in each block.
        ("trxl", {"transformer": Transformer(positional_encoding="relative")}, 2_803_111 + 3 * (96**2 + 2 * 384)),
        # Two gates of six matrices and a bias in each block.
        ("gtrxl", {}, 2_803_111 + 3 * 2 * (6 * 384**2 + 384)),
        # An LSTM has four gates, a GRU three.
        ("lstm", {}, 4_049_575 + 2 * 512 * 512 + 2 * 512),
        # Like the GRU agent, but without embedding and GRU: the body takes the 3136 outputs of the convolutions.
        ("none", {}, 4_049_575 - 1_606_144 - 1_575_936 + (3136 - 512) * 512),
    ],
)
def test_number_of_parameters_is_as_computed_by_hand(agent: str, changes: dict, count: int) -> None:
    made = Agent(replace(PAPER, agent=agent, **changes), {"visual_observation": (84, 84, 3)}, (3, 3))
    assert made.num_parameters == count


@pytest.mark.parametrize(
    ("env", "option", "window", "positions"),
    [
        ("Endless-MortarMayhem-v0", (), 256, 2048),
        ("Endless-MysteryPath-v0", (), 256, 2048),
        ("Endless-SearingSpotlights-v0", (), 256, 2048),
        # The longest episode: 274 steps and the one that ends it.
        ("MortarMayhem-v0", (), 275, 275),
        ("MortarMayhem-v0", ("command_count=[2, 1]",), 51, 51),
        ("MysteryPath-v0", (), 512, 512),
        ("MysteryPath-Grid-v0", (), 128, 128),
        ("SearingSpotlights-v0", ("max_steps=100",), 100, 100),
        ("SearingSpotlights-v0", ("max_steps=-1",), 256, 2048),
        ("Endless-MysteryPath-v0", ("max_steps=5000",), 256, 2048),
    ],
)
def test_window_and_positions_follow_the_longest_episode(
    env: str, option: tuple[str, ...], window: int, positions: int
) -> None:
    given = changed(PAPER, env=env, agent="trxl", environment={"option": option}).validated()
    assert (given.window(), given.positions()) == (window, positions)
    memory = make_agent(given, spec(env)).memory
    assert isinstance(memory, TransformerMemory)
    assert (memory.past, memory.positions) == (window - 1, positions)
    fixed = changed(given, transformer={"window": 9, "positions": 11})
    assert (fixed.window(), fixed.positions()) == (9, 11)


def test_run_lengths_are_those_of_the_published_curves() -> None:
    """A published curve has a point every 500 updates, the first one before training."""
    agents = {"16stack": "stack", "4stack": "stack", "ppo": "none", "pos_enc": "position"}
    for env, runs in curves._published()["curves"].items():
        for run, scores in runs.items():
            run = run.removesuffix("_cues")
            agent = agents.get(run, run.split("_")[0])
            given = replace(PAPER, env=env, agent=agent).validated()
            assert given.ppo.updates == 500 * (len(scores[0]) - 1), (env, run)
            assert given.ppo.decay_updates == 10_000
    fewer = changed(PAPER, environment={"num_envs": 8}).validated()
    assert fewer.ppo.updates == 4 * PAPER.validated().ppo.updates
    assert changed(PAPER, ppo={"updates": 7}).validated().ppo.updates == 7


@pytest.mark.parametrize("name", PRESETS)
def test_settings_round_trip_through_dicts(name: str) -> None:
    given = replace(PRESETS[name], environment=replace(PAPER.environment, option=("max_steps=2",)))
    assert from_dict(to_dict(given)) == given
    assert from_dict(to_dict(given.validated())) == given.validated()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"environment": {"num_envs": 31, "groups": 2}}, "got 31 environments and 2 groups"),
        ({"environment": {"option": ("a",)}}, "must be NAME=VALUE .* got `a`"),
        ({"environment": {"option": ("a=x",)}}, "must be NAME=VALUE .* got `a=x`"),
        ({"transformer": {"window": 1}}, "window must be 0 .* or 2 or more, got 1"),
        (
            {"transformer": {"width": 100, "heads": 3}},
            "multiple of twice --transformer.heads, got width 100 and 3 heads",
        ),
        ({"transformer": {"query_encoding": True, "positional_encoding": "relative"}}, "got relative"),
        ({"view": True}, r"add --environment\.engine process"),
        (
            {"env": "MortarMayhem-v0", "environment": {"option": ("command_count=3",)}},
            "reset parameter `command_count` must be a list of 1 to 4096 integers, 1 to 1000, got 3",
        ),
    ],
)
def test_invalid_settings_are_rejected(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        changed(PAPER, **changes).validated()


def test_options_are_json() -> None:
    given = changed(PAPER, environment={"option": ("a=[1, 2]", "b=true", "c=False", "d=0.5")})
    assert given.options() == {"a": [1, 2], "b": True, "c": False, "d": 0.5}


def test_heads_without_their_targets_are_rejected() -> None:
    with pytest.raises(ValueError, match=r"needs a ground truth, and .* has none"):
        make("gru", ppo={"ground_truth_coefficient": 0.1})
    with pytest.raises(ValueError, match="needs frames, and the observation has only features"):
        make("gru", ppo={"reconstruction_coefficient": 0.1})


@pytest.mark.parametrize(
    ("observation", "given", "message"),
    [
        (
            "features",
            "rgb",
            r"`features` float32 \(n, 17\), since the agent was trained on features; got `.*` uint8 \(2, 84, 84, 3\)",
        ),
        (
            "rgb",
            "features",
            r"`visual_observation` uint8 \(n, 84, 84, 3\), since the agent was trained on frames; got `.*` float32",
        ),
    ],
)
def test_an_observation_of_another_kind_is_an_error(observation: str, given: str, message: str) -> None:
    small = settings("gru", env="MortarMayhem-Grid-v0")
    agent = make_agent(changed(small, environment={"observation": observation}), spec(small.env))
    with make_vec(small.env, 2, observation=given) as envs, make_vec(small.env, 2, observation="rgb+features") as both:
        frames, _ = envs.reset(seed=1)
        for call in (agent.act, agent.bootstrap_value):
            with pytest.raises(ValueError, match=message):
                call(frames, agent.initial_memory(2))
            with pytest.raises(ValueError, match="make the environments with observation="):
                call({given: frames}, agent.initial_memory(2))
        # Entries that the agent does not use are ignored.
        agent.act(both.reset(seed=1)[0], agent.initial_memory(2))


def test_an_agent_of_two_observations_needs_both() -> None:
    small = settings("gru", env="MortarMayhemB-Grid-v0")
    agent = make_agent(changed(small, environment={"observation": "rgb"}), spec(small.env))
    with make_vec(small.env, 2) as envs:
        observation, _ = envs.reset(seed=1)
        agent.act(observation, agent.initial_memory(2))
        with pytest.raises(ValueError, match=r"`vector_observation` float32 .*got one array"):
            agent.act(observation["visual_observation"], agent.initial_memory(2))
        with pytest.raises(ValueError, match=r"got `visual_observation` uint8 \(2, 84, 84, 3\)"):
            agent.act({"visual_observation": observation["visual_observation"]}, agent.initial_memory(2))


def test_atari_encoder_scales_and_permutes_frames() -> None:
    """Against the same convolutions of frames that are converted and transposed by hand."""
    encoder, frames = AtariEncoder(3), torch.randint(0, 256, (FRAMES_PER_CHUNK + 2, 84, 84, 3), dtype=torch.uint8)
    x = torch.zeros(len(frames), 3, 84, 84)
    for channel in range(3):
        x[:, channel] = frames[:, :, :, channel].float() / 255
    for layer in encoder.convolutions:
        x = layer(x)
    assert x.shape == (FRAMES_PER_CHUNK + 2, 3136)
    torch.testing.assert_close(encoder(frames), x, rtol=1e-4, atol=1e-5)


def test_initial_policy_is_nearly_uniform_and_sampling_follows_it() -> None:
    agent = make("none")
    memory, rows = agent.initial_memory(20_000), torch.randn(1, 6).expand(20_000, 6)
    output = agent.act({"features": rows}, memory, torch.Generator().manual_seed(0))
    for branch, choices in enumerate(BRANCHES):
        for choice in range(choices):
            drawn = output.action[:, branch] == choice
            expected = float(output.log_prob[drawn][0, branch].exp())
            # Five standard deviations.
            assert abs(float(drawn.float().mean()) - expected) < 5 * math.sqrt(expected * (1 - expected) / 20_000)
    greedy = agent.act({"features": rows}, agent.initial_memory(20_000), greedy=True)
    assert (greedy.log_prob >= output.log_prob).all()
    fresh = PolicyHead(64, 64, (3, 3))(torch.randn(100, 64))
    assert all((logits.softmax(-1) - 1 / 3).abs().max() < 0.15 for logits in fresh)


def test_reconstruction_head_takes_the_output_of_the_memory() -> None:
    """The gradient of the head reaches the memory, not the body; the frame has the shape of the observation."""
    given = settings("gru", ppo={"reconstruction_coefficient": 0.1}, environment={"observation": "rgb"})
    agent = Agent(given, {"visual_observation": (84, 84, 3)}, BRANCHES)
    memory, frames = agent.initial_memory(2), torch.randint(0, 256, (2, 84, 84, 3), dtype=torch.uint8)
    agent.memory.begin_segment(memory.state, 1)
    agent.act({"visual_observation": frames}, memory)
    (minibatch,) = agent.memory.minibatches([memory.state], torch.ones(1, 2, dtype=torch.bool), 1, torch.Generator())
    output = agent({"visual_observation": frames[minibatch.indices]}, minibatch)
    assert output.frame.shape == (2, 3, 84, 84)
    output.frame.sum().backward()
    assert agent.memory.recurrent.weight_ih_l0.grad.abs().sum() > 0
    assert agent.body[0].weight.grad is None


def test_reconstruction_head_mirrors_the_encoder() -> None:
    """The shapes of the layers are those of the Atari encoder in reverse order; all layers but the last have a ReLU."""
    x, shapes, head = torch.randn(1, 32), [], ReconstructionHead(32, 4)
    for layer in head.layers:
        x = layer(x)
        shapes.append(tuple(x.shape[1:]))
    assert shapes[2] == (64, 7, 7)
    assert [shapes[i] for i in (3, 5, 7)] == [(64, 9, 9), (32, 20, 20), (4, 84, 84)]
    assert [number for number, layer in enumerate(head.layers) if isinstance(layer, torch.nn.ReLU)] == [1, 4, 6]


@pytest.mark.parametrize(
    ("kind", "bound"), [("xavier", math.sqrt(6 / 128)), ("kaiming", math.sqrt(6 / 64)), ("tfixup", math.sqrt(6 / 128))]
)
def test_uniform_weights_are_within_their_bound_and_close_to_it(kind: str, bound: float) -> None:
    """The weights of a block are within the bound and close to it; T-Fixup scales the output projection."""
    block = Block(Transformer(layers=3, width=64, heads=4, shared_heads=False, initialisation=kind))
    for name, weight in block.named_parameters():
        if weight.dim() < 2:
            continue
        factor = 0.67 * 3**-0.25 if kind == "tfixup" and "fc_out" in name else 1.0
        assert 0.98 * bound * factor < float(weight.abs().max()) <= bound * factor, name


def test_blocks_start_orthogonal_and_relative_biases_at_0() -> None:
    """Each matrix of the gates is orthogonal on its own; the biases of the encoding are 0."""
    changes = {"shared_heads": False, "gating": True, "positional_encoding": "relative"}
    block = Block(Transformer(width=64, heads=4, initialisation="orthogonal", gate_bias=2.0, **changes))
    matrices = [block.fc.weight, block.attention.queries.weight]
    for gate in (block.gate_attention, block.gate_fc):
        matrices += [*gate.from_y.weight.chunk(3), *gate.from_x.weight.chunk(2), gate.from_reset.weight]
        assert torch.equal(gate.bias, torch.full((64,), 2.0))
    for matrix in matrices:
        torch.testing.assert_close(matrix @ matrix.T, 2 * torch.eye(64), rtol=1e-4, atol=1e-4)
    assert not block.attention.content_bias.any() and not block.attention.distance_bias.any()


def test_every_setting_is_documented(capsys: pytest.CaptureFixture[str]) -> None:
    """tyro takes the help text of a field from the docstring below it."""
    texts = documented_settings()
    assert len(texts) > 60
    assert [name for name, text in texts.items() if not text] == []
    with pytest.raises(SystemExit):
        parse(["--help"])
    assert "(default: 0.000275)" in " ".join(capsys.readouterr().out.replace("│", " ").split())


def test_flags_override_the_preset() -> None:
    assert parse(["--preset", "old"]) == PRESETS["old"]
    given = parse(["--preset", "old", "--agent", "lstm", "--ppo.gamma", "0.9"])
    assert given == changed(PRESETS["old"], agent="lstm", ppo={"gamma": 0.9})


@pytest.mark.parametrize("agent", ["gru", "lstm", "mingru", "trxl", "none"])
def test_on_the_cpu_bfloat16_ends_before_a_recurrent_memory(agent: str) -> None:
    shapes = {FRAME: (84, 84, 3)}
    model = {"body_width": 20, "head_width": 11}
    made = make(agent, shapes, bf16=True, model=model, recurrence={"kernels": "torch"})
    observed = {FRAME: torch.randint(256, (6, 84, 84, 3), dtype=torch.uint8)}
    memory, is_recurrent = made.initial_memory(6), agent not in ("trxl", "none")
    late = {torch.float32 if is_recurrent else torch.bfloat16}
    # The first convolution, and the layer after the convolutions.
    early = {32 * 3 * 8 * 8: {torch.bfloat16}, 3136 * (20 if agent == "none" else 16): {torch.bfloat16}}
    gates = {"gru": 3, "lstm": 4, "mingru": 2}.get(agent)
    expected = early | ({16 * 20: late} if agent != "none" else {}) | ({gates * 16 * 16: late} if gates else {})
    with Products() as acting:
        made.act(observed, memory)
    assert acting.types.items() >= (expected | {20 * 22: late}).items()
    done = torch.zeros((6, 1), dtype=torch.bool)
    memory = made.initial_memory(1)
    made.memory.begin_segment(memory.state, 6)
    for step in range(6):
        made.act({FRAME: observed[FRAME][step : step + 1]}, memory)
    (minibatch,) = made.memory.minibatches([memory.state], done, 1, torch.Generator())
    with Products() as learning:
        made({FRAME: observed[FRAME][minibatch.indices]}, minibatch)
    assert learning.types.items() >= (expected | {20 * 11: late, 11: late}).items()
    assert all(parameter.dtype == torch.float32 for parameter in made.parameters())
