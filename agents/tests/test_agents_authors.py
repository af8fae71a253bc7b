"""The memories against recorded results of the code of the paper's authors, with the same weights; see `references/README.md`."""

import gzip
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from endless_gym_agents.memories.memory import AnyMemory
from endless_gym_agents.memories.recurrent import RecurrentMemory, RecurrentMinibatch, RecurrentState
from endless_gym_agents.memories.transformer import TransformerMemory
from endless_gym_agents.memories.transformer_block import MASKED, Attention
from endless_gym_agents.settings import Recurrence, Transformer

RECORDED = json.loads(gzip.decompress((Path(__file__).parent / "authors.json.gz").read_bytes()))["cases"]
CPU = torch.device("cpu")
WINDOW, LONGEST = 5, 12

#: Replacements, by regular expression, that turn the authors' names of weights into ours.
NAMES = {
    "^pos_embedding$": "table",
    "^linear_(embedding|transform)": "embedding.0",
    "^fusion": "fusion.0",
    "^recurrent_layer": "recurrent",
    "^transformer_blocks": "layers",
    ".norm1.": ".norm_query.",
    ".norm_kv.": ".norm_tokens.",
    ".norm2.": ".norm_fc.",
    ".fc.0.": ".fc.",
    ".gate1.": ".gate_attention.",
    ".gate2.": ".gate_fc.",
    ".bg$": ".bias",
}
#: The authors' matrices that each matrix of our gates stacks.
GATES = {"from_y": ("Wr", "Wz", "Wg"), "from_x": ("Ur", "Uz"), "from_reset": ("Ug",)}


def ours(theirs: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights or gradients by the authors' names, by our names."""
    found: dict[str, Tensor] = {}
    for name, tensor in theirs.items():
        for pattern, new in NAMES.items():
            name = re.sub(pattern.replace(".", r"\."), new, name)
        found[name] = tensor
    for gate in [name.removesuffix(".bias") for name in found if re.search(r"gate_\w+\.bias$", name)]:
        for stacked, parts in GATES.items():
            found[f"{gate}.{stacked}.weight"] = torch.cat([found.pop(f"{gate}.{part}.weight") for part in parts])
    return found


def tensors(value: Any) -> Any:
    return {key: tensors(each) for key, each in value.items()} if isinstance(value, dict) else torch.tensor(value)


def transplanted(memory: AnyMemory, recorded: dict[str, Any]) -> None:
    memory.load_state_dict(ours(tensors(recorded["weights"])), strict=True)
    memory.refresh(torch.float32)


def assert_close(one: Tensor, two: Tensor) -> None:
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


def assert_gradients(memory: AnyMemory, output: Tensor, factor: Tensor, recorded: dict[str, Any]) -> None:
    (output * factor).sum().backward()
    expected = ours(tensors(recorded["gradients"]))
    assert expected.keys() == dict(memory.named_parameters()).keys()
    for name, parameter in memory.named_parameters():
        assert parameter.grad is not None and parameter.grad.any(), name
        assert_close(parameter.grad, expected[name])


@pytest.mark.parametrize("name", [name for name in RECORDED if "gru" in name or "lstm" in name])
def test_recurrent_layers_equal_those_of_the_authors(name: str) -> None:
    recorded = RECORDED[name]
    x, hidden, factor = (tensors(recorded[key]) for key in ("x", "hidden", "factor"))
    hidden = hidden.transpose(1, 2)  # (parts, layers, sequences, hidden size)
    sequences, width = hidden.shape[2:]
    length = len(x) // sequences
    layers, residual = recorded["layers"], recorded["residual"]
    given = Recurrence(hidden_size=width, layers=layers, residual=residual, sequence_length=length)
    memory = RecurrentMemory("lstm" if name == "lstm" else "gru", x.shape[1], given, CPU)
    transplanted(memory, recorded)
    tree = {f"{part}{layer}": hidden[i, layer] for i, part in enumerate(memory.model.parts) for layer in range(layers)}
    with torch.no_grad():
        acted, after = memory.step(memory.embed(x[::length]), RecurrentState(tree), None)
    assert_close(acted, tensors(recorded["acted"]))
    expected = tensors(recorded["after"]).transpose(1, 2)
    assert_close(torch.stack([after[name] for name in tree]), expected.flatten(0, 1))
    # Step by step.
    order = torch.arange(len(x)).view(sequences, length).t()
    output = memory(memory.embed(x[order.flatten()]), RecurrentMinibatch(order, order, tree, order < 0))
    order = order.flatten()
    assert_close(output, tensors(recorded["output"])[order])
    assert_gradients(memory, output, factor[order], recorded)


@pytest.mark.parametrize("name", [name for name in RECORDED if "trxl" in name])
def test_transformer_equals_that_of_the_authors(name: str) -> None:
    recorded = RECORDED[name]
    x, memories, steps, factor = (tensors(recorded[key]) for key in ("x", "memories", "steps", "factor"))
    kind = name.split(", ")[1]
    given = Transformer(
        layers=2,
        width=memories.shape[-1],
        heads=2,
        window=WINDOW,
        shared_heads=kind == "previous",
        positional_encoding=kind if kind in ("learned", "none") else "absolute",  # type: ignore[arg-type]
        query_previous=kind == "previous",
        gating=recorded["gate_bias"] is not None,
    )
    memory = TransformerMemory(x.shape[1], given, LONGEST, CPU)
    transplanted(memory, recorded)
    state = memory.initial_state(len(x))
    for row, step in enumerate(steps.tolist()):
        past = min(step, WINDOW - 1)
        columns = slice(state.fill - past, state.fill)
        state.inputs[:, row, columns] = memories[row, :past].transpose(0, 1)
        state.position[row, columns] = torch.arange(step - past, step)
    state.next_position = steps
    # The authors act and learn with the same function; we have two.
    memory.begin_segment(state, 1)
    no_reset = torch.zeros(len(x), dtype=torch.bool)
    with torch.no_grad():
        acted, update = memory.step(memory.embed(x), state, no_reset)
        memory.update_state(state, update)
    assert_close(acted, tensors(recorded["output"]))
    assert_close(state.inputs[:, :, state.fill - 1].transpose(0, 1), tensors(recorded["inputs"]))
    (minibatch,) = memory.minibatches([state], no_reset.unsqueeze(0), 1, torch.Generator().manual_seed(0))
    output = memory(memory.embed(x[minibatch.indices]), minibatch)
    assert_close(output, tensors(recorded["output"])[minibatch.indices])
    assert_gradients(memory, output, factor[minibatch.indices], recorded)


def test_relative_attention_equals_that_of_the_authors() -> None:
    """The authors divide scores by the root of a head's size, and project distances with one matrix for all heads."""
    recorded = RECORDED["attention, relative"]
    query, tokens, mask, factor = (tensors(recorded[key]) for key in ("query", "tokens", "mask", "factor"))
    weights, gradients = tensors(recorded["weights"]), tensors(recorded["gradients"])
    heads, size = weights["r_w_bias"].shape
    past, width = tokens.shape[1:]
    given = Transformer(width=width, heads=heads, shared_heads=False, positional_encoding="relative")
    attention, norm = Attention(given), nn.LayerNorm(width)
    scale = heads**0.5
    blocks = {name: torch.block_diag(*heads * [weights[f"{name}.weight"]]) for name in ("queries", "keys", "values")}
    theirs = {
        "content_bias": scale * weights["r_w_bias"].unsqueeze(1),
        "distance_bias": scale * weights["r_r_bias"].unsqueeze(1),
        "distances.weight": weights["r_net.weight"],
        "fc_out.weight": weights["fc_out.weight"],
        "fc_out.bias": torch.zeros(width),
        "queries.weight": scale * blocks["queries"],
        "keys.weight": blocks["keys"],
        "values.weight": blocks["values"],
    }
    attention.load_state_dict(theirs, strict=True)
    bias = torch.zeros(mask.shape).masked_fill(~mask, MASKED)[:, None, None]
    first = torch.zeros(len(query), 1, 1, dtype=torch.bool)
    output = attention(query, tokens, norm, bias, first, past - torch.arange(past).unsqueeze(0), None)
    assert_close(output, tensors(recorded["output"]))
    (output * factor).sum().backward()
    found = {name: parameter.grad for name, parameter in attention.named_parameters()}

    def of_shared_heads(gradient: Tensor) -> Tensor:
        return torch.stack([gradient[each : each + size, each : each + size] for each in range(0, width, size)]).sum(0)

    assert_close(found["content_bias"].squeeze(1) * scale, gradients["r_w_bias"])
    assert_close(found["distance_bias"].squeeze(1) * scale, gradients["r_r_bias"])
    assert_close(found["distances.weight"], gradients["r_net.weight"])
    assert_close(found["fc_out.weight"], gradients["fc_out.weight"])
    assert_close(of_shared_heads(found["queries.weight"]) * scale, gradients["queries.weight"])
    assert_close(of_shared_heads(found["keys.weight"]), gradients["keys.weight"])
    assert_close(of_shared_heads(found["values.weight"]), gradients["values.weight"])
    assert all(gradient.any() for gradient in gradients.values())


def test_all_kinds_are_recorded() -> None:
    encodings = ["trxl, absolute", "trxl, learned", "trxl, none"]
    recurrent, gated = ["gru", "gru, two layers, residual", "lstm"], ["gtrxl, bias 0", "gtrxl, bias 2"]
    assert list(RECORDED) == [*recurrent, *encodings, *gated, "attention, relative", "gtrxl, previous"]
