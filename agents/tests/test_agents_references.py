"""The memories of linear recurrences equal their authors' layers, recorded in float64: see references/README.md."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from endless_gym_agents.memories import attention
from endless_gym_agents.memories.gated_deltanet import GatedDeltaNet
from endless_gym_agents.memories.lru import LRU
from endless_gym_agents.memories.mamba2 import Mamba2
from endless_gym_agents.memories.mlstm import MLSTM
from endless_gym_agents.memories.retnet import RetNet
from endless_gym_agents.memories.scans import steps_of_episode
from endless_gym_agents.memories.sequence_model import SequenceModel, Stack, State

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
}


def recorded(name: str) -> dict[str, Arrays]:
    """The arrays of a file by the part of their name before the first point; `output`, `probe` and `input` under an empty one."""
    parts: dict[str, Arrays] = {}
    for key, array in np.load(FOLDER / f"{name}.npz").items():
        part, _, rest = key.rpartition(".") if key.count(".") == 0 else key.partition(".")
        parts.setdefault(part, {})[rest] = torch.from_numpy(array)
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


def difference(found: Tensor, expected: Tensor) -> float:
    """The largest difference, relative to the largest number."""
    assert found.shape == expected.shape
    return float((found - expected).detach().abs().max() / expected.abs().max())


def run(layer: SequenceModel, name: str) -> tuple[Tensor, State, Tensor]:
    """Outputs (B, T, width), the state after the last step, and the inputs."""
    x = recorded(name)[""]["input"].requires_grad_()
    resets = torch.zeros(x.shape[1], len(x), dtype=torch.bool)
    y, state = layer.sequence(x.transpose(0, 1), initial(layer, len(x)), resets)
    return y.transpose(0, 1), state, x


@pytest.mark.parametrize("chunk", [16, 64])
@pytest.mark.parametrize("name", REFERENCES)
def test_outputs_and_gradients_are_those_of_the_authors(name: str, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attention, "CHUNK", chunk)
    layer, reference, arrays = layer_of(name, parallel=True), REFERENCES[name], recorded(name)
    y, _, x = run(layer, name)
    assert difference(y, arrays[""]["output"]) < 1e-12
    (y * arrays[""]["probe"]).sum().backward()
    gradients = {key: part.grad for key, part in layer.named_parameters()}
    expected = reference.weights(arrays["grad"])
    assert max(difference(gradients[key], expected[key]) for key in expected) < 1e-10
    assert difference(x.grad, arrays["grad"]["input"]) < 1e-10


@pytest.mark.parametrize("name", REFERENCES)
def test_single_steps_and_states_are_those_of_the_authors(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The authors' steps where recorded; our sequences, which start with the same state, equal them too."""
    monkeypatch.setattr(attention, "CHUNK", 16)
    layer, reference, arrays = layer_of(name), REFERENCES[name], recorded(name)
    y, after, x = run(layer, name)
    state, outputs = initial(layer, len(x)), []
    for inputs in x.unbind(1):
        output, state = layer.step(inputs, state)
        outputs.append(output)
    expected = arrays["step"]["output"] if "step" in arrays else arrays[""]["output"]
    assert difference(y, expected) < 1e-12
    assert difference(torch.stack(outputs, 1), expected) < 1e-12
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
