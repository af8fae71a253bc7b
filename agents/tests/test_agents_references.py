"""Memories equal their authors' layers with the same weights, recorded in float64: see `references/README.md`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from endless_gym_agents.memories import attention
from endless_gym_agents.memories.ffm import FFM
from endless_gym_agents.memories.gated import LSTM
from endless_gym_agents.memories.gated_deltanet import GatedDeltaNet
from endless_gym_agents.memories.lru import LRU
from endless_gym_agents.memories.mamba2 import Mamba2
from endless_gym_agents.memories.mingru import MinGRU
from endless_gym_agents.memories.mlstm import MLSTM
from endless_gym_agents.memories.recurrent import RecurrentMemory
from endless_gym_agents.memories.retnet import RetNet
from endless_gym_agents.memories.scans import steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, Stack, State
from endless_gym_agents.memories.shm import SHM
from endless_gym_agents.memories.transformer_block import MASKED, Attention, Gate, normalised
from endless_gym_agents.settings import Recurrence, Transformer

FOLDER = Path(__file__).parent / "references"
WIDTH, HEADS = 16, 2

Arrays = dict[str, Tensor]


@pytest.fixture(autouse=True)
def float64() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


def lru() -> SequenceModel:
    block = Stack(LRU, WIDTH, WIDTH, 1, {"state_size": 12})
    # The record ends with the block.
    block.norms[1] = nn.Identity()
    return block


def lru_weights(w: Arrays) -> Arrays:
    return {
        "norms.0.weight": w["normalization/scale"],
        "norms.0.bias": w["normalization/bias"],
        "layers.0.nu": w["seq/nu_log"],
        "layers.0.theta": w["seq/theta_log"],
        "layers.0.log_gamma": w["seq/gamma_log"],
        "layers.0.b": torch.cat([w["seq/B_re"], w["seq/B_im"]]),
        "layers.0.c": torch.cat([w["seq/C_re"], -w["seq/C_im"]], 1),
        "layers.0.d": w["seq/D"],
        "layers.0.gate.weight": torch.cat([w["out1/kernel"].T, w["out2/kernel"].T]),
        "layers.0.gate.bias": torch.cat([w["out1/bias"], w["out2/bias"]]),
    }


def taps(weight: Tensor) -> Tensor:
    """The weights of a convolution (channels, 1, 4), whose last column meets the current step."""
    return weight[:, 0].flip(1).T


def mamba2_weights(w: Arrays) -> Arrays:
    return {
        "enter.weight": w["in_proj.weight"],
        "convolution.weight": taps(w["conv1d.weight"]),
        "convolution.bias": w["conv1d.bias"],
        "dt_bias": w["dt_bias"],
        "a_log": w["A_log"],
        "d": w["D"],
        "norm.weight": w["norm.weight"],
        "leave.weight": w["out_proj.weight"],
    }


def mamba2_states(final: Arrays) -> State:
    return {"s": final["ssm"].mT, "convolution": final["conv"][..., 1:].mT}


def gated_deltanet_weights(w: Arrays) -> Arrays:
    # Queries, keys, values and gates of each head; rates and decays of each head.
    parts = [part.flatten(0, 1) for part in w["in_proj_qkvz.weight"].unflatten(0, (HEADS, -1)).split([8, 8, 16, 16], 1)]
    b, a = w["in_proj_ba.weight"].unflatten(0, (HEADS, 2)).unbind(1)
    return {
        "enter.weight": torch.cat([*parts, a, b]),
        "convolution.weight": taps(w["conv1d.weight"]),
        "dt_bias": w["dt_bias"],
        "a_log": w["A_log"],
        "norm.weight": w["norm.weight"],
        "leave.weight": w["out_proj.weight"],
    }


def gated_deltanet_states(final: Arrays) -> State:
    return {"s": final["recurrent"], "convolution": final["conv"][..., 1:].mT}


def halves(x: Tensor, dim: int) -> Tensor:
    """The 8 entries of a head in the order in which the layer rotates them: i and i + 4 instead of 2 i and 2 i + 1."""
    return x.unflatten(dim, (4, 2)).transpose(dim, dim + 1).flatten(dim, dim + 1)


class Parallel(RetNet):
    """RetNet in the authors' parallel form, which also divides by a sum of all scores, as by a constant."""

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        time = steps_of_episode(state["steps"], resets)
        with torch.no_grad():
            q, k, _, _ = self.split(x, time)
            lag = torch.arange(len(x)).unsqueeze(1) - torch.arange(len(x))
            decay = torch.where(lag < 0, 0, self.gamma[:, None, None] ** lag.clamp_min(0))
            scores = torch.einsum("tbhk,sbhk->bhts", q, k) * decay / decay.sum(-1, keepdim=True).sqrt()
            self.constant = scores.abs().sum(-1).clamp(1, 5e4).permute(2, 0, 1)
        return super().sequence(x, state, resets)

    def scale(self, time: Tensor) -> Tensor:
        return super().scale(time) * self.constant**2


def retnet_weights(w: Arrays) -> Arrays:
    q, k = (halves(w[f"{name}_proj.weight"].unflatten(0, (HEADS, 8)), 1).flatten(0, 1) for name in "qk")
    return {
        "enter.weight": torch.cat([q, k, w["v_proj.weight"], w["g_proj.weight"]]),
        "leave.weight": w["out_proj.weight"],
    }


def retnet_states(final: Arrays) -> State:
    return {"s": halves(final["prev_key_value"].mT * final["scale"].view(HEADS, 1, 1).sqrt(), 2)}


def mlstm_weights(w: Arrays) -> Arrays:
    gates = {
        part: torch.cat([w[f"mlstm_cell.{gate}.{part}"] for gate in ("igate", "fgate")]) for part in ("weight", "bias")
    }
    return {
        "enter.weight": w["proj_up.weight"],
        "convolution.weight": taps(w["conv1d.conv.weight"]),
        "convolution.bias": w["conv1d.conv.bias"],
        "of_convolved": torch.cat([w["q_proj.weight"], w["k_proj.weight"]], 1),
        "of_inputs": w["v_proj.weight"],
        "gates.weight": gates["weight"],
        "gates.bias": gates["bias"],
        "norm": w["mlstm_cell.outnorm.weight"],
        "skip": w["learnable_skip"],
        "leave.weight": w["proj_down.weight"],
    }


def mlstm_states(final: Arrays) -> State:
    c = torch.cat([final["c"], final["n"].reshape(*final["c"].shape[:-1], 1)], -1)
    return {"c": c, "m": final["m"].reshape(c.shape[:2]), "convolution": final["conv"][:, 1:]}


def ffm_weights(w: Arrays) -> Arrays:
    """Their rates have the other sign, the parts of the first layer another order, and real and imaginary parts alternate."""

    def parts(layer: Tensor) -> Tensor:
        entry, through, entry_gate, gate = layer.split([6, 16, 6, 16])
        return torch.cat([entry, entry_gate, through, gate])

    return {
        "enter.weight": parts(w["pre.weight"]),
        "enter.bias": parts(w["pre.bias"]),
        "a": -w["ffa.a"].flatten(),
        "b": w["ffa.b"].flatten(),
        "mix.weight": w["mix.weight"].unflatten(1, (-1, 2)).mT.flatten(1),
        "mix.bias": w["mix.bias"],
    }


def ffm_states(final: Arrays) -> State:
    return {"real": final["step_state"].real, "imaginary": final["step_state"].imag}


class MinGRUWithoutBiases(MinGRU):
    """The layer of minGRU-pytorch, which has an output layer if its width is not that of the inputs."""

    def __init__(self, width: int) -> None:
        super().__init__(WIDTH, width, positive=True)
        self.projection = nn.Linear(WIDTH, 2 * width, bias=False)
        self.leave = nn.Identity() if width == WIDTH else nn.Linear(width, WIDTH, bias=False)

    def step(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        h, after = super().step(x, state)
        return self.leave(h), after

    def sequence(self, x: Tensor, state: State, resets: Tensor) -> tuple[Tensor, State]:
        h, after = super().sequence(x, state, resets)
        return self.leave(h), after


def mingru_weights(w: Arrays) -> Arrays:
    candidate, gate = w["to_hidden_and_gate.weight"].chunk(2)
    leave = {"leave.weight": w["to_out.weight"]} if "to_out.weight" in w else {}
    return {"projection.weight": torch.cat([gate, candidate])} | leave


def mingru_states(final: Arrays) -> State:
    return {"h": final["hidden"].squeeze(1)}


class DrawnRows(SHM):
    """Takes the rows of theta that the authors' code drew for each sequence of a file."""

    def __init__(self, name: str, limit: float | None = None) -> None:
        super().__init__(WIDTH, WIDTH, 24, limit=limit)
        self.drawn = recorded(name)[""]["rows"]

    def rows(self, time: Tensor) -> Tensor:
        return self.drawn[torch.arange(len(self.drawn)), time.squeeze(-1).long()]


def shm_weights(w: Arrays) -> Arrays:
    order = ("query", "key", "value", "vc_net", "eta")
    ours = {"theta": w["theta_matrix"], "enter.weight": torch.cat([w[f"{each}.weight"] for each in order])}
    kept = {"norm": "norm", "out": "leave", "shortcut": "shortcut"}
    names = [(name, name.split(".")) for name in w if name.split(".")[0] in kept]
    return ours | {f"{kept[layer]}.{part}": w[name] for name, (layer, part) in names}


def shm_states(final: Arrays) -> State:
    return {"m": final["state"].flatten(0, -3)}


@dataclass(frozen=True)
class Reference:
    """A recorded layer.

    Attributes:
        make: Makes the layer, or one with the authors' form of whole sequences if given True.
        weights: Our weights, or their gradients, from the authors'.
        states: Our states from the authors'; None if they are not recorded.
        added: What is added to the authors' weights.
    """

    make: Callable[[bool], SequenceModel]
    weights: Callable[[Arrays], Arrays]
    states: Callable[[Arrays], State] | None = None
    added: dict[str, float] = field(default_factory=dict)


REFERENCES = {
    "lru_layer": Reference(lambda _: lru(), lru_weights),
    "mamba2": Reference(lambda _: Mamba2(WIDTH, WIDTH, HEADS, state_size=8), mamba2_weights, mamba2_states),
    "gated_deltanet_wide": Reference(
        lambda _: GatedDeltaNet(WIDTH, WIDTH, HEADS, key_factor=1, feed_forward=0),
        gated_deltanet_weights,
        gated_deltanet_states,
    ),
    "retnet_wide": Reference(
        lambda parallel: (Parallel if parallel else RetNet)(WIDTH, WIDTH, HEADS, feed_forward=0),
        retnet_weights,
        retnet_states,
    ),
    # The authors' gain is 1 + weight.
    "mlstm_layer": Reference(lambda _: MLSTM(WIDTH, WIDTH, HEADS), mlstm_weights, mlstm_states, {"norm": 1.0}),
    "ffm": Reference(lambda _: FFM(WIDTH, WIDTH, 6, 3), ffm_weights, ffm_states),
    "mingru": Reference(lambda _: MinGRUWithoutBiases(WIDTH), mingru_weights, mingru_states),
    "mingru_expanded": Reference(lambda _: MinGRUWithoutBiases(24), mingru_weights, mingru_states),
    "shm": Reference(lambda _: SHM(WIDTH, WIDTH, 8, stride=0, shortcut=False), shm_weights, shm_states),
    "shm_stride37": Reference(lambda _: SHM(WIDTH, WIDTH, 8, stride=37, shortcut=False), shm_weights, shm_states),
    "shm_pomdp": Reference(lambda _: DrawnRows("shm_pomdp"), shm_weights, shm_states),
    "shm_pomdp_clamped": Reference(lambda _: DrawnRows("shm_pomdp_clamped", 100.0), shm_weights, shm_states),
}


def recorded(name: str) -> dict[str, Arrays]:
    """The arrays of a file by the part of their name before the first point; `output`, `probe` and `input` under an empty one.

    Sequences are (B, T, width), also of files that are time-major.
    """
    parts: dict[str, Arrays] = {}
    for key, array in np.load(FOLDER / f"{name}.npz").items():
        part, _, rest = key.rpartition(".") if key.count(".") == 0 else key.partition(".")
        batch_first = array.swapaxes(0, 1) if array.shape == (48, 3, WIDTH) else array
        parts.setdefault(part, {})[rest] = torch.from_numpy(batch_first)
    return parts


def layer_of(name: str, parallel: bool = False) -> SequenceModel:
    reference = REFERENCES[name]
    layer = reference.make(parallel)
    weights = reference.weights(recorded(name)["weight"])
    # RetNet's decays are in its state, but no weights.
    layer.load_state_dict({key: part + reference.added.get(key, 0.0) for key, part in weights.items()}, strict=False)
    assert weights.keys() == dict(layer.named_parameters()).keys()
    return layer


def initial(layer: SequenceModel, batch: int) -> State:
    return {name: torch.zeros(batch, *shape) for name, shape in layer.state_shapes.items()}


def first_state(layer: SequenceModel, arrays: dict[str, Arrays]) -> State:
    """The state before the first step, which only a file of minGRU has."""
    return {"h": arrays["initial"]["hidden"].squeeze(1)} if "initial" in arrays else initial(layer, 3)


def difference(found: Tensor, expected: Tensor) -> float:
    """The largest difference, relative to the largest number."""
    assert found.shape == expected.shape
    return float((found - expected).detach().abs().max() / expected.abs().max())


def run(layer: SequenceModel, name: str) -> tuple[Tensor, State, Tensor]:
    """Outputs (B, T, width), the state after the last step, and the inputs."""
    arrays = recorded(name)
    x = arrays[""]["input"].requires_grad_()
    resets = torch.zeros(x.shape[1], len(x), dtype=torch.bool)
    y, state = layer.sequence(x.transpose(0, 1), first_state(layer, arrays), resets)
    return y.transpose(0, 1), state, x


def assert_gradients(name: str, layer: SequenceModel, x: Tensor, y: Tensor) -> None:
    """Check the gradients of the recorded loss of outputs y (B, T, width)."""
    arrays = recorded(name)
    (y * arrays[""]["probe"]).sum().backward()
    gradients = {key: part.grad for key, part in layer.named_parameters()}
    expected = REFERENCES[name].weights(arrays["grad"])
    assert all(difference(gradients[key], expected[key]) < 1e-10 for key in expected)
    assert difference(x.grad, arrays["grad"]["input"]) < 1e-10


@pytest.mark.parametrize("chunk", [16, 64])
@pytest.mark.parametrize("name", REFERENCES)
def test_outputs_and_gradients_are_those_of_the_authors(name: str, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attention, "CHUNK", chunk)
    layer = layer_of(name, parallel=True)
    y, _, x = run(layer, name)
    assert difference(y, recorded(name)[""]["output"]) < 1e-12
    assert_gradients(name, layer, x, y)


@pytest.mark.parametrize("name", REFERENCES)
def test_single_steps_and_states_are_those_of_the_authors(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The authors' steps where recorded; our sequences, which start with the same state, equal them too."""
    monkeypatch.setattr(attention, "CHUNK", 16)
    layer, reference, arrays = layer_of(name), REFERENCES[name], recorded(name)
    y, after, x = run(layer, name)
    state, outputs = first_state(layer, arrays), []
    for inputs in x.unbind(1):
        output, state = layer.step(inputs, state)
        outputs.append(output)
    expected = arrays["step"]["output"] if "step" in arrays else arrays[""]["output"]
    assert difference(y, expected) < 1e-12
    y = torch.stack(outputs, 1)
    assert difference(y, expected) < 1e-12
    # The recorded gradients of RetNet are those of its parallel form.
    if name != "retnet_wide":
        assert_gradients(name, layer, x, y)
    for key, part in reference.states(arrays["final"]).items() if reference.states else ():
        assert difference(state[key], part) < 1e-12
        assert difference(after[key], part) < 1e-12


@pytest.mark.parametrize(
    ("name", "part", "wrong", "least"),
    [
        # The angles of other rotary encodings, and the smallest number of another code.
        ("retnet_wide", "theta", 10_000.0 ** -(torch.arange(4) / 4), 0.1),
        ("gated_deltanet_wide", "norm.eps", 1e-6, 0.05),
        ("lru_layer", "norms.0.eps", 1e-5, 1e-6),
    ],
)
def test_the_references_tell_variants_apart(name: str, part: str, wrong: Any, least: float) -> None:
    layer = layer_of(name, parallel=True)
    *path, last = part.split(".")
    setattr(layer.get_submodule(".".join(path)), last, wrong)
    assert difference(run(layer, name)[0], recorded(name)[""]["output"]) > least


def described(values: Tensor, numbers: dict[str, float], label: str) -> None:
    """Check that the quantiles of initial values are those of the authors', up to three errors of the smaller sample."""
    levels = {"q05": 0.05, "q25": 0.25, "median": 0.5, "q75": 0.75, "q95": 0.95}
    values = values.detach().double().flatten()
    allowed = 3 * (numbers["q95"] - numbers["q05"]) / min(numbers["count"], len(values)) ** 0.5
    for name, level in levels.items():
        error = abs(float(torch.quantile(values, level)) - numbers[name])
        assert error <= allowed + 1e-6, (label, name, error, allowed)


def of(name: str, start: str) -> dict[str, Any]:
    """The numbers of a case by the start of its description."""
    (found,) = [
        numbers
        for key, numbers in json.loads((FOLDER / f"{name}.init.json").read_text()).items()
        if key.startswith(start)
    ]
    return found


def test_initial_values_are_those_of_the_authors() -> None:
    torch.manual_seed(0)
    for start, options in (("defaults", {}), ("r_min 0.9", {"r_min": 0.9, "r_max": 0.999, "max_phase": 0.314})):
        layer, numbers = LRU(4, 4, state_size=20_000, **options), of("lru", start)
        described(layer.eigenvalues().abs(), numbers["|lambda|"], start)
        described(layer.theta.exp(), numbers["phase"], start)
        described(layer.log_gamma.exp(), numbers["gamma"], start)
    layer, numbers = LRU(64, 64), of("lru", "SequenceLayer")
    for part, name in zip(layer.b.chunk(2), ("B_re", "B_im"), strict=True):
        described(part, numbers[f"seq/{name}"], name)
    for part, name in zip(layer.c.chunk(2, 1), ("C_re", "C_im"), strict=True):
        described(part, numbers[f"seq/{name}"], name)
    for part, name in zip(layer.gate.weight.chunk(2), ("out1", "out2"), strict=True):
        described(part, numbers[f"{name}/kernel"], name)
    assert not layer.gate.bias.any()

    layer, numbers = Mamba2(64, 64, 8, state_size=32), of("mamba2", "transformers Mamba2Mixer")
    theirs = {key: numbers[name] for key, name in (
        ("enter.weight", "in_proj.weight"), ("convolution.weight", "conv1d.weight"), ("convolution.bias", "conv1d.bias"),
        ("d", "D"), ("norm.weight", "norm.weight"), ("leave.weight", "out_proj.weight"),
    )}  # fmt: skip
    for key, expected in theirs.items():
        described(layer.get_parameter(key), expected, key)
    for name, smallest in (("mamba2", 1.0), ("gated_deltanet", 0.0)):
        a_log, dt_bias = attention.decays(100_000, smallest)
        decay = torch.exp(-a_log.exp() * nn.functional.softplus(dt_bias))
        described(decay, of(name, "authors' formulas: A uniform"), name)

    layer, numbers = RetNet(64, 64, value_factor=1), of("retnet", "MultiScaleRetention")
    for part, name in zip(layer.enter.weight.split(layer.parts), "qkvg", strict=True):
        described(part, numbers[f"{name}_proj.weight"], name)
    described(layer.leave.weight, numbers["out_proj.weight"], "out_proj")
    assert layer.gamma.tolist() == of("retnet", "decay per head")
    assert layer.theta.tolist() == pytest.approx(of("retnet", "angle per pair"), rel=1e-6)

    layer, numbers = MLSTM(64, 64), of("mlstm", "xlstm mLSTMLayer")
    described(layer.enter.weight, numbers["proj_up.weight"], "proj_up")
    for part, name in zip((*layer.of_convolved.chunk(2, 1), layer.of_inputs), "qkv", strict=True):
        described(part, numbers[f"{name}_proj.weight"], name)
    described(layer.convolution.weight, numbers["conv1d.conv.weight"], "conv1d")
    described(layer.leave.weight, numbers["proj_down.weight"], "proj_down")
    assert not layer.gates.weight.any() and layer.gates.bias[4:].tolist() == of("mlstm", "xlstm: fgate.bias")
    described(MLSTM(8, 1000, heads=500).gates.bias[:500], of("mlstm", "xlstm: igate.bias"), "igate")
    assert (layer.norm == 1).all() and (layer.skip == 1).all()

    # Standard deviations of 0.02 for the authors' width.
    layer = GatedDeltaNet(64, 64)
    weights = [layer.enter.weight, layer.leave.weight, layer.feed_forward.enter.weight, layer.feed_forward.leave.weight]
    assert [float(weight.detach().std()) * 64**0.5 for weight in weights] == pytest.approx(
        [0.02 * 2048**0.5] * 4, rel=0.05
    )
    assert layer.convolution.bias is None and float(layer.convolution.weight.detach().abs().max()) == pytest.approx(
        0.5, rel=0.02
    )


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (LRU, {"state_size": 5}),
        (Mamba2, {"state_size": 5, "expand": 1}),
        (GatedDeltaNet, {"key_factor": 1.25, "value_factor": 1.5}),
        # Keys with an odd number of entries.
        (RetNet, {"heads": 4, "value_factor": 1}),
        (MLSTM, {}),
        (MLSTM, {"conv": False, "expand": 1}),
    ],
    ids=str,
)
def test_sequences_with_resets_are_their_steps(
    make: type[SequenceModel], options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attention, "CHUNK", 7)
    torch.manual_seed(1)
    block, steps = Stack(make, 12, 12, 2, {"heads": 2} | options if make is not LRU else options), 20
    for parameter in block.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    x, resets = torch.randn(steps, 3, 12), torch.rand(steps, 3) < 0.2
    before = {name: 0.1 * part.normal_().abs() for name, part in initial(block, 3).items()}
    before = {name: part.ceil() if name.endswith("steps") else part for name, part in before.items()}
    y, after = block.sequence(x, before, resets)
    expected, last = SequenceModel.sequence(block, x, before, resets)
    torch.testing.assert_close((y, after), (expected, last), rtol=1e-10, atol=1e-12)


def test_what_follows_in_the_block_is_gated_and_residual() -> None:
    for make, activation in ((RetNet, nn.functional.gelu), (GatedDeltaNet, nn.functional.silu)):
        block, x = Stack(make, 8, 8, 1, {}), torch.randn(1, 2, 8)
        layer, state, resets = block.layers[0], initial(block, 2), torch.zeros(1, 2, dtype=torch.bool)
        y, _ = block.sequence(x, state, resets)
        mixed = x + layer.sequence(block.norms[0](x), initial(layer, 2), resets)[0]
        normal = mixed / (mixed.square().mean(-1, keepdim=True) + layer.input_norm().eps).sqrt()
        u, v = (normal @ weight.T for weight in layer.feed_forward.enter.weight.chunk(2))
        torch.testing.assert_close(
            y, block.norms[1](mixed + (activation(u) * v) @ layer.feed_forward.leave.weight.T), rtol=1e-12, atol=1e-12
        )


def test_relative_attention_and_gates_are_those_of_the_gtrxl_of_di_engine() -> None:
    """Its network, made of our attention and gates.

    Its projections have biases. Those of keys and positions add a constant to all scores of a query; those of queries and values
    are a part of the other biases. It takes queries from inputs that are not normalised, divides scores by the root of a head's
    size, and has a ReLU after the attention and two layers after that.
    """
    record = recorded("gtrxl")
    theirs = {name: part.requires_grad_() for name, part in record["weight"].items()}
    attend = Attention(Transformer(width=16, heads=2, shared_heads=False, positional_encoding="relative"))
    attend.scale, gate = 8**-0.5, Gate(16, 2.0)
    x, memory = record[""]["input"].requires_grad_(), record["initial"]["memory"].transpose(1, 2)
    distance = 16 + torch.arange(48).unsqueeze(1) - torch.arange(64)
    mask = torch.zeros(48, 64).masked_fill(distance < 0, MASKED).expand(3, 1, -1, -1)

    def gated(layer: str, x: Tensor, y: Tensor) -> Tensor:
        parts = {"from_y": "Wr Wz Wg", "from_x": "Ur Uz", "from_reset": "Ug"}
        weights = {
            f"{ours}.weight": torch.cat([theirs[f"{layer}.{each}.weight"] for each in names.split()])
            for ours, names in parts.items()
        }
        return functional_call(gate, weights | {"bias": theirs[f"{layer}.bg"]}, (x, y))  # type: ignore[no-any-return]

    h, inputs = x, []
    for number in range(2):
        layer = f"layers.{number}"
        inputs.append(h)

        def of(name: str, layer: str = layer) -> tuple[Tensor, Tensor]:
            return theirs[f"{layer}.{name}.weight"], theirs[f"{layer}.{name}.bias"]

        (kv, kv_bias), (q, q_bias), (out, out_bias) = (
            of(f"attention.{name}.0") for name in ("attention_kv", "attention_q", "project")
        )
        keys, values = kv.chunk(2)
        weights = {
            "queries.weight": q,
            "keys.weight": keys,
            "values.weight": values,
            "fc_out.weight": out,
            "fc_out.bias": out_bias + out @ kv_bias.chunk(2)[1],
            "distances.weight": of("attention.project_pos.0")[0],
            "content_bias": (theirs["u"] + q_bias.view(2, 8)).unsqueeze(1),
            "distance_bias": (theirs["v"] + q_bias.view(2, 8)).unsqueeze(1),
        }
        gain, bias = of("layernorm1")
        tokens = normalised(torch.cat([memory[number], h], dim=1))
        given = (h, tokens, SimpleNamespace(weight=gain, bias=bias), mask, torch.zeros(3, 48, 1).bool(), distance, None)
        h = gated(f"{layer}.gate1", h, functional_call(attend, weights, given).relu())
        y = functional.layer_norm(h, (16,), *of("layernorm2"))
        for part in ("mlp.0.0", "mlp.2.0"):
            y = functional.linear(y, *of(part)).relu()
        h = gated(f"{layer}.gate2", h, y)
    assert difference(h, record[""]["output"]) < 1e-10
    inputs.append(h)
    after = torch.stack([part[:, -16:].transpose(0, 1) for part in inputs])
    assert difference(after, record["final"]["memory"]) < 1e-10
    (h * record[""]["probe"]).sum().backward()
    assert x.grad is not None and difference(x.grad, record["grad"]["input"]) < 1e-10
    for name, weight in theirs.items():
        found, expected = weight.grad, record["grad"][name]
        if "project_pos.0.bias" in name:
            assert found is None and float(expected.abs().max()) < 1e-10
            continue
        assert found is not None, name
        if "attention_kv.0.bias" in name:
            assert float(expected[:16].abs().max()) < 1e-10
            found, expected = found[16:], expected[16:]
        assert difference(found, expected) < 1e-10, name


def test_ffm_starts_with_the_rates_of_the_authors_and_keeps_their_limits() -> None:
    layer = FFM(64, 64)
    rates = torch.tensor([0.6731472, 0.0044972366])
    torch.testing.assert_close(layer.a[[0, -1]], rates, rtol=1e-6, atol=0)
    torch.testing.assert_close(layer.a.diff(), torch.full((31,), (0.0044972366 - 0.6731472) / 31), rtol=1e-4, atol=0)
    torch.testing.assert_close(2 * torch.pi / layer.b, torch.tensor([1.0, 342, 683, 1024]), rtol=1e-5, atol=0)
    layer.a.data[:2] = torch.tensor([3.0, -1.0])
    magnitudes = layer.gamma().abs()[:2, 0]
    torch.testing.assert_close(magnitudes, torch.tensor([-0.6831472, -1e-8]).exp())
    assert layer.a[0].item() == pytest.approx(0.6831472) and layer.a[1].item() == pytest.approx(1e-8)


def test_shm_starts_as_that_of_the_authors() -> None:
    torch.manual_seed(1)
    layer, spread = SHM(64, 64), lambda part: float(part.detach().abs().max())
    assert 0.19 < spread(layer.theta) <= (6 / (128 + 32)) ** 0.5
    assert all(0.12 < spread(part) <= 0.125 for part in layer.enter.weight.split([32] * 4 + [1]))
    assert 0.17 < spread(layer.leave.weight) <= 32**-0.5


def test_mingru_with_a_positive_candidate_starts_as_that_of_the_authors() -> None:
    torch.manual_seed(1)
    layer = MinGRU(64, 64, positive=True)
    assert 0.12 < float(layer.projection.weight.detach().abs().max()) <= 0.125
    z, candidate = layer.projected(torch.randn(2000, 64)).detach().chunk(2, -1)
    decays = (1 - z.sigmoid()).quantile(torch.tensor([0.05, 0.5, 0.95]))
    torch.testing.assert_close(decays, torch.tensor([0.28, 0.5, 0.72]), rtol=0, atol=0.03)
    assert bool((candidate > 0).all()) and float(candidate.mean()) == pytest.approx(0.68, abs=0.03)


@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_the_forget_gates_of_lstms_start_with_the_given_bias(bias: float) -> None:
    memory = RecurrentMemory("lstm", 5, Recurrence(4, layers=2, forget_bias=bias), torch.device("cpu"))
    assert isinstance(memory.model, LSTM)
    for _, _, of_inputs, of_states in memory.model.all_weights:
        gates = (of_inputs + of_states).unflatten(0, (4, 4))
        assert gates[1].tolist() == [bias] * 4 and not gates[[0, 2, 3]].any()
