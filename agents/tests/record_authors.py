"""Records results of the memories in the code of the paper's authors (MarcoMeter/neroRL), for `test_agents_authors.py`.

    python record_authors.py --repository https://github.com/MarcoMeter/neroRL

Needs git, torch, numpy and einops. The authors' code is fetched to a temporary folder; only numbers are kept, in
`authors.json.gz`: the weights by the authors' names, the inputs, the outputs while acting and while learning, and the gradients
of `sum(output * factor)`. The main branch has absolute, learned and no positional encoding. From the branch with relative
encoding, only the attention is recorded, since its blocks put the query itself into the memory in place of the newest token.
The branch with the previous output in the first query is recorded with gates, since its blocks without gates have a ReLU that
the main branch does not have.
"""

import argparse
import gzip
import importlib.util
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor, nn

#: The main branch, and the branches `test/relative_pe` and `test/query_2`.
COMMIT, RELATIVE = "8dd62bdee66c2825d6fcea6fffefcdeb4f010609", "5419b0c80599179f5708e32ba3b0f66172817cf0"
PREVIOUS = "638502a8c33110a6d3b22432c686dd54deabd79c"
DATA = Path(__file__).parent / "authors.json.gz"
INPUT, WIDTH, SEQUENCES, LENGTH = 5, 8, 3, 4
#: Window and longest episode of the Transformer-XL, and the step in the episode of each row of the batch. Step 0 is left out:
#: there, the authors' code attends uniformly to an empty window, while ours attends to nothing.
WINDOW, LONGEST, STEPS = 5, 12, (1, 2, 4, 6, 9)


def fetched(repository: str, folder: Path) -> None:
    """Put the authors' modules into a folder: `neroRL` of `COMMIT`, the others in `relative` and `previous`."""
    git = folder / "git"
    if Path(repository).exists():
        git = Path(repository)
    else:
        subprocess.run(["git", "clone", "--quiet", "--bare", "--filter=blob:none", repository, git], check=True)
    for commit, into in ((COMMIT, folder), (RELATIVE, folder / "relative"), (PREVIOUS, folder / "previous")):
        into.mkdir(exist_ok=True)
        command = ["git", f"--git-dir={git}", "archive", commit, "neroRL/__init__.py", "neroRL/nn"]
        archive = subprocess.run(command, check=True, capture_output=True).stdout
        subprocess.run(["tar", "x", "-C", into], input=archive, check=True)


def randomised(module: nn.Module) -> nn.Module:
    """The module with weights as after some training: no bias is zero."""
    for parameter in module.parameters():
        parameter.data += 0.3 * torch.randn_like(parameter)
    return module


def recurrent(kind: type[nn.Module], layers: int, residual: bool) -> dict[str, Any]:
    """Sequences from given hidden states, and one acting step."""
    module = randomised(kind(INPUT, WIDTH, layers, nn.ReLU(), residual))
    parts = 2 if kind.__name__ == "LSTM" else 1
    x, hidden = torch.randn(SEQUENCES * LENGTH, INPUT), torch.randn(parts, SEQUENCES, layers, WIDTH)
    cell = hidden[0] if parts == 1 else (hidden[0], hidden[1])
    output, _ = module(x, cell, LENGTH)
    acted, after = module(x[::LENGTH], cell, 1)
    return {
        "layers": layers,
        "residual": residual,
        "x": x,
        "hidden": hidden,
        "acted": acted,
        "after": after.unsqueeze(0) if parts == 1 else torch.stack(after),
    } | gradients(module, output)


def loaded(file: Path) -> Any:
    """The module in a file."""
    spec = importlib.util.spec_from_file_location(file.parents[2].name, file)
    assert spec is not None and spec.loader is not None
    theirs = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(theirs)
    return theirs


def transformer(
    module: type[nn.Module], encoding: str, gate_bias: float | None, previous: bool = False
) -> dict[str, Any]:
    """One step of several environments with given memories; the authors' code is the same for acting and learning.

    With `previous`, the module is that of `PREVIOUS`, and gets the last block's input at the previous step, as its sampler
    provides it.
    """
    config = {
        "num_blocks": 2,
        "embed_dim": WIDTH,
        "num_heads": 2,
        "share_heads": True,  # of `PREVIOUS` only; the main branch has separate heads
        "max_episode_steps": LONGEST,
        "positional_encoding": encoding,
        "add_positional_encoding_to_query": False,
        "layer_norm": "pre",
        "gtrxl": gate_bias is not None,
        "gtrxl_bias": gate_bias or 0.0,
        "gtrxl_swap": False,
    }
    made = randomised(module(config, INPUT, nn.ReLU()))
    x, memories = torch.randn(len(STEPS), INPUT), torch.randn(len(STEPS), WINDOW, 2, WIDTH)
    # As in the authors' trainer: until the window is full it begins with the episode, then it ends with the current step.
    starts = torch.tensor([max(0, step - WINDOW + 1) for step in STEPS]).unsqueeze(1)
    indices = starts + torch.arange(WINDOW)
    mask = torch.tril(torch.ones(WINDOW, WINDOW), diagonal=-1)[torch.tensor(STEPS).clamp(max=WINDOW - 1)]
    newest = torch.tensor(STEPS).clamp(max=WINDOW - 1) - 1
    given = (memories[torch.arange(len(STEPS)), newest, -1],) if previous else ()
    output, inputs = made(x, memories, mask, indices, *given)
    return {"gate_bias": gate_bias, "x": x, "memories": memories, "steps": list(STEPS), "inputs": inputs} | gradients(
        made, output
    )


def relative(file: Path) -> dict[str, Any]:
    """The attention with relative encoding of one query to the last tokens of a window; the newest one is at distance 1."""
    theirs = loaded(file)
    heads, past = 2, WINDOW - 1
    module = randomised(theirs.RelPartialLearnableMultiHeadAttn(WIDTH, heads))
    module.r_w_bias, module.r_r_bias = (nn.Parameter(torch.randn(heads, WIDTH // heads)) for _ in range(2))
    query, tokens = torch.randn(len(STEPS), 1, WIDTH), torch.randn(len(STEPS), past, WIDTH)
    mask = torch.arange(past) >= past - torch.tensor(STEPS).unsqueeze(1)
    encodings = theirs.SinusoidalPosition(WIDTH)(past + 1)[:past]
    output, _ = module(tokens, tokens, query, mask, encodings, module.r_w_bias, module.r_r_bias)
    return {"query": query, "tokens": tokens, "mask": mask} | gradients(module, output)


def gradients(module: nn.Module, output: Tensor) -> dict[str, Any]:
    """The output, and the gradients of its sum weighted with a drawn factor."""
    factor = torch.randn_like(output)
    (output * factor).sum().backward()
    return {
        "output": output,
        "factor": factor,
        "weights": dict(module.named_parameters()),
        "gradients": {name: parameter.grad for name, parameter in module.named_parameters()},
    }


def numbers(value: Any) -> Any:
    """Tensors as lists of numbers, rounded to nine digits: exact for float32."""
    if isinstance(value, Tensor):
        return numbers(value.tolist())
    if isinstance(value, dict):
        return {key: numbers(each) for key, each in value.items()}
    if isinstance(value, list):
        return [numbers(each) for each in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


def main() -> None:
    """Record all cases."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repository", default="https://github.com/MarcoMeter/neroRL", help="URL or a git directory")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        fetched(args.repository, Path(folder))
        sys.path.insert(0, folder)
        from neroRL.nn.recurrent import GRU, LSTM
        from neroRL.nn.transformer import Transformer

        # The branch imports a function that it does not call from a module that needs the authors' environments.
        unused = ModuleType("neroRL.utils.utils")
        vars(unused)["batched_index_select"] = None
        sys.modules |= {"neroRL.utils": ModuleType("neroRL.utils"), "neroRL.utils.utils": unused}
        previous = loaded(Path(folder) / "previous/neroRL/nn/transformer.py").Transformer

        torch.manual_seed(1)
        cases = {
            "gru": recurrent(GRU, 1, False),
            "gru, two layers, residual": recurrent(GRU, 2, True),
            "lstm": recurrent(LSTM, 1, False),
            "trxl, absolute": transformer(Transformer, "absolute", None),
            "trxl, learned": transformer(Transformer, "learned", None),
            "trxl, none": transformer(Transformer, "", None),
            "gtrxl, bias 0": transformer(Transformer, "absolute", 0.0),
            "gtrxl, bias 2": transformer(Transformer, "absolute", 2.0),
            "attention, relative": relative(Path(folder) / "relative/neroRL/nn/transformer.py"),
            # That branch calls the absolute encoding `relative`.
            "gtrxl, previous": transformer(previous, "relative", 0.0, previous=True),
        }
    commits = {"commit": COMMIT, "relative_commit": RELATIVE, "previous_commit": PREVIOUS}
    data = json.dumps({"source": "MarcoMeter/neroRL", **commits, "cases": numbers(cases)})
    DATA.write_bytes(gzip.compress(data.encode(), mtime=0))


if __name__ == "__main__":
    main()
