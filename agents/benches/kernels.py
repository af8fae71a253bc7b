"""Time of forward and backward passes of recurrent layers on the CPU: PyTorch's, those of `recurrence`, and the native kernels.

    python kernels.py --hidden-size 128 --sequences 8 --steps 256

The network is a linear layer, the recurrent layer, and heads for two branches and a value. All variants run in turn, and the
ratio of each to PyTorch's GRU is the median over the rounds.
"""

import argparse
import os
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils.rnn import PackedSequence

from endless_gym_agents.kernels import KernelGRU, KernelLSTM, KernelMinGRU
from endless_gym_agents.recurrence import PackedGRU, PackedLSTM


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden-size", type=int, default=128, help="units (default: %(default)s)")
    parser.add_argument("--sequences", type=int, default=8, help="sequences (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=256, help="steps of a sequence (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch (default: %(default)s)")
    parser.add_argument("--rounds", type=int, default=20, help="runs of each variant (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    width, sizes = args.hidden_size, [args.sequences] * args.steps
    x = torch.randn(sum(sizes), width)
    first, last = nn.Linear(width, width), nn.Linear(width, 3 + 3 + 1)
    gru, lstm, projection = nn.GRU(width, width), nn.LSTM(width, width), nn.Linear(width, 2 * width)
    zeros = torch.zeros(args.sequences, width)
    w_ih, w_hh, b_ih, b_hh = gru.all_weights[0]
    v_ih, v_hh, c_ih, c_hh = lstm.all_weights[0]

    def packed(x: Tensor) -> PackedSequence:
        return PackedSequence(x, torch.tensor(sizes))

    variants: dict[str, Callable[[Tensor], Tensor]] = {
        "nn.GRU": lambda x: gru(x.view(args.steps, args.sequences, width))[0].flatten(0, 1),
        "nn.GRU, packed": lambda x: gru(packed(x))[0].data,
        "PackedGRU": lambda x: PackedGRU.apply(functional.linear(x, w_ih, b_ih), w_hh, b_hh, zeros, sizes),
        "KernelGRU": lambda x: KernelGRU.apply(functional.linear(x, w_ih, b_ih), w_hh, b_hh, zeros, sizes),
        "nn.LSTM": lambda x: lstm(x.view(args.steps, args.sequences, width))[0].flatten(0, 1),
        "PackedLSTM": lambda x: PackedLSTM.apply(functional.linear(x, v_ih, c_ih + c_hh), v_hh, zeros, zeros, sizes),
        "KernelLSTM": lambda x: KernelLSTM.apply(functional.linear(x, v_ih, c_ih + c_hh), v_hh, zeros, zeros, sizes),
        "KernelMinGRU": lambda x: KernelMinGRU.apply(projection(x), zeros, sizes),
        "no memory": lambda x: x,
    }
    times: dict[str, list[float]] = {name: [] for name in variants}
    for number in range(args.rounds + 2):
        for name, layer in variants.items():
            start = time.perf_counter()
            last(layer(first(x).relu())).square().mean().backward()
            if number >= 2:
                times[name].append(time.perf_counter() - start)
    print(
        f"{args.sequences} sequences, {args.steps} steps, {width} units, {args.threads} threads; load {os.getloadavg()[0]:.1f}"
    )
    for name, seconds in times.items():
        ratio = statistics.median(torch_ / own for torch_, own in zip(times["nn.GRU"], seconds, strict=True))
        print(f"{name:16} {1e3 * statistics.median(seconds):7.2f} ms   nn.GRU takes {ratio:5.2f} times as long")


if __name__ == "__main__":
    main()
