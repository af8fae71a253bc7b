"""Memories against recorded results of their authors' code with the same weights, in float64; see `references`."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn import functional

from endless_gym_agents.memories.ffm import FFM
from endless_gym_agents.memories.gated import LSTM
from endless_gym_agents.memories.mingru import MinGRU
from endless_gym_agents.memories.recurrent import RecurrentMemory
from endless_gym_agents.memories.sequence_model import SequenceModel, State
from endless_gym_agents.memories.shm import SHM
from endless_gym_agents.memories.transformer import MASKED, Attention, Gate, normalised
from endless_gym_agents.settings import Recurrence, Transformer


class Record:
    """A file's arrays as tensors; sequences are time-major."""

    def __init__(self, name: str) -> None:
        with np.load(Path(__file__).parent / "references" / f"{name}.npz") as arrays:
            self.arrays = {key: torch.from_numpy(array) for key, array in arrays.items()}
        self.batch_first = len(self.arrays["input"]) == 3

    def sequence(self, key: str) -> Tensor:
        array = self.arrays[key]
        return array.transpose(0, 1).contiguous() if self.batch_first else array

    def by_name(self, kind: str) -> dict[str, Tensor]:
        return {key.removeprefix(f"{kind}."): part for key, part in self.arrays.items() if key.startswith(f"{kind}.")}


def as_shm(theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    order = ("query", "key", "value", "vc_net", "eta")
    ours = {"theta": theirs["theta_matrix"], "enter.weight": torch.cat([theirs[f"{each}.weight"] for each in order])}
    kept = {"norm": "norm", "out": "leave", "shortcut": "shortcut"}
    names = [(name, name.split(".")) for name in theirs if name.split(".")[0] in kept]
    return ours | {f"{kept[layer]}.{part}": theirs[name] for name, (layer, part) in names}


def as_ffm(theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Their rates have the other sign, the parts of the first layer another order, and real and imaginary parts alternate."""

    def parts(layer: Tensor) -> Tensor:
        entry, through, entry_gate, gate = layer.split([6, 16, 6, 16])
        return torch.cat([entry, entry_gate, through, gate])

    return {
        "enter.weight": parts(theirs["pre.weight"]),
        "enter.bias": parts(theirs["pre.bias"]),
        "a": -theirs["ffa.a"].flatten(),
        "b": theirs["ffa.b"].flatten(),
        "mix.weight": theirs["mix.weight"].unflatten(1, (-1, 2)).mT.flatten(1),
        "mix.bias": theirs["mix.bias"],
    }


def as_mingru(theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    candidate, gate = theirs["to_hidden_and_gate.weight"].chunk(2)
    return {"projection.weight": torch.cat([gate, candidate])}


class Given(SHM):
    """Takes the rows of theta that a file has, by the step of the episode."""

    drawn: Tensor

    def rows(self, time: Tensor) -> Tensor:
        return self.drawn[:, int(time[..., 0].max())]


def shm(record: Record, **options: float | bool | None) -> SHM:
    layer = Given(16, 16, record.arrays["weight.key.weight"].shape[0], **options)  # type: ignore[arg-type]
    layer.drawn = record.arrays["rows"]
    return layer


def plain_shm(stride: int) -> SHM:
    return SHM(16, 16, 8, stride=stride, shortcut=False)


#: Our layer, its weights from theirs, and the part of the state after the last step that the file has, from our state.
CASES = {
    "ffm": (
        lambda record: FFM(16, 16, 6, 3),
        as_ffm,
        ("step_state", lambda s: torch.complex(s["real"], s["imaginary"])),
    ),
    "mingru": (lambda record: MinGRU(16, 16, positive=True), as_mingru, ("hidden", lambda s: s["h"].unsqueeze(1))),
    "mingru_expanded": (
        lambda record: nn.Sequential(MinGRU(16, 24, positive=True), nn.Linear(24, 16, bias=False)),
        lambda w: {f"0.{key}": part for key, part in as_mingru(w).items()} | {"1.weight": w["to_out.weight"]},
        ("hidden", lambda s: s["h"].unsqueeze(1)),
    ),
    "shm": (lambda record: plain_shm(0), as_shm, ("state", lambda s: s["m"])),
    "shm_stride37": (lambda record: plain_shm(37), as_shm, ("state", lambda s: s["m"])),
    "shm_pomdp": (lambda record: shm(record), as_shm, ("state", lambda s: s["m"].unsqueeze(1))),
    "shm_pomdp_clamped": (lambda record: shm(record, limit=100.0), as_shm, ("state", lambda s: s["m"].unsqueeze(1))),
}


def assert_close(found: Tensor, expected: Tensor, what: str) -> None:
    scale = float(expected.abs().max())
    assert scale > 0, what
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10 * scale, msg=lambda message: f"{what}: {message}")


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("by_steps", [False, True])
def test_outputs_states_and_gradients_are_those_of_the_authors(name: str, by_steps: bool) -> None:
    record, (make, mapped, (final, part)) = Record(name), CASES[name]
    module = make(record).double()
    found = module.load_state_dict(mapped(record.by_name("weight")), strict=False)
    assert found.unexpected_keys == [] and set(found.missing_keys) <= {"projection.bias", "0.projection.bias"}
    layer: SequenceModel = module[0] if isinstance(module, nn.Sequential) else module
    if found.missing_keys:
        layer.projection.bias.data.zero_()
    x, batch = record.sequence("input").requires_grad_(), 3
    state: State = {key: torch.zeros(batch, *shape, dtype=torch.float64) for key, shape in layer.state_shapes.items()}
    if "initial.hidden" in record.arrays:
        state = {"h": record.arrays["initial.hidden"].squeeze(1)}
    resets = torch.zeros(x.shape[:2], dtype=torch.bool)
    run = (
        (lambda *given: SequenceModel.sequence(layer, *given))
        if by_steps or isinstance(layer, Given)
        else layer.sequence
    )
    output, after = run(x, state, resets)
    if module is not layer:
        output = module[1](output)
    assert_close(output, record.sequence("output"), "output")
    if "step.output" in record.arrays:
        assert_close(output, record.sequence("step.output"), "steps")
    assert_close(part(after), record.arrays[f"final.{final}"], "state")
    (output * record.sequence("probe")).sum().backward()
    assert x.grad is not None
    assert_close(x.grad, record.sequence("grad.input"), "gradient of the input")
    gradients = dict(module.named_parameters())
    for key, expected in mapped(record.by_name("grad")).items():
        gradient = gradients[key].grad
        assert gradient is not None, key
        assert_close(gradient, expected, key)


@pytest.fixture
def float64() -> Iterator[None]:
    """Encodings of distances in double precision, too."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.usefixtures("float64")
def test_relative_attention_and_gates_are_those_of_the_gtrxl_of_di_engine() -> None:
    """Its network, made of our attention and gates.

    Its projections have biases. Those of keys and positions add a constant to all scores of a query; those of queries and values
    are a part of the other biases. It takes queries from inputs that are not normalised, divides scores by the root of a head's
    size, and has a ReLU after the attention and two layers after that.
    """
    record = Record("gtrxl")
    theirs = {name: part.requires_grad_() for name, part in record.by_name("weight").items()}
    attention = Attention(Transformer(width=16, heads=2, shared_heads=False, positional_encoding="relative"))
    attention.scale, gate = 8**-0.5, Gate(16, 2.0)
    x, memory = record.sequence("input").requires_grad_(), record.arrays["initial.memory"].transpose(1, 2)
    distance = 16 + torch.arange(48).unsqueeze(1) - torch.arange(64)
    mask = torch.zeros(48, 64).masked_fill(distance < 0, MASKED).expand(3, 1, -1, -1)

    def gated(layer: str, x: Tensor, y: Tensor) -> Tensor:
        parts = {"from_y": "Wr Wz Wg", "from_x": "Ur Uz", "from_reset": "Ug"}
        weights = {
            f"{ours}.weight": torch.cat([theirs[f"{layer}.{each}.weight"] for each in names.split()])
            for ours, names in parts.items()
        }
        return functional_call(gate, weights | {"bias": theirs[f"{layer}.bg"]}, (x, y))  # type: ignore[no-any-return]

    h, inputs = x.transpose(0, 1), []
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
        h = gated(f"{layer}.gate1", h, functional_call(attention, weights, given).relu())
        y = functional.layer_norm(h, (16,), *of("layernorm2"))
        for part in ("mlp.0.0", "mlp.2.0"):
            y = functional.linear(y, *of(part)).relu()
        h = gated(f"{layer}.gate2", h, y)
    assert_close(h.transpose(0, 1), record.sequence("output"), "output")
    inputs.append(h)
    assert_close(
        torch.stack([part[:, -16:].transpose(0, 1) for part in inputs]), record.arrays["final.memory"], "memory"
    )
    (h.transpose(0, 1) * record.sequence("probe")).sum().backward()
    assert x.grad is not None
    assert_close(x.grad, record.sequence("grad.input"), "gradient of the input")
    for name, weight in theirs.items():
        found, expected = weight.grad, record.arrays[f"grad.{name}"]
        if "project_pos.0.bias" in name:
            assert found is None and float(expected.abs().max()) < 1e-10
            continue
        assert found is not None, name
        if "attention_kv.0.bias" in name:
            assert float(expected[:16].abs().max()) < 1e-10
            found, expected = found[16:], expected[16:]
        assert_close(found, expected, name)


def test_ffm_starts_with_the_rates_of_the_authors_and_keeps_their_limits() -> None:
    layer = FFM(64, 64)
    recorded = torch.tensor([0.6731472, 0.0044972366])
    torch.testing.assert_close(layer.a[[0, -1]], recorded, rtol=1e-6, atol=0)
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
