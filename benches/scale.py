"""How training by `torchrun` scales: measures the costs of one rank on this machine and predicts the speed of up to 1,024 ranks.

    python benches/scale.py                                  # the GRU agent of the preset quick; less than two minutes
    python benches/scale.py --check --json scale.json        # also trains with 1, 2 and 4 ranks, beside the prediction
    python benches/scale.py --agent trxl -- --ppo.steps 128  # arguments after `--` are those of `endless-train`

Measured, on the CPU: what an update of one rank spends on environments, inference and learning, on `--cores` cores of its own,
and an all-reduce of the gradients by gloo among 1, 2 and 4 processes. Ranks that have fewer cores than they need share them, in
the measurement and in the model. `scale_model.py` is the model, and says what it leaves out.

The first table is of machines like this one. The second is of machines with GPUs, whose times are assumptions that the options
change: nothing was measured on a GPU. In both, each rank has the same number of environments, the network between machines is an
assumption (`--bandwidth`, `--latency`), and `limit` is what takes most of an update.

`--check` also compares two ranks, each bound to one core, with one rank on one core; the goal is 1.7 times the steps. The bound
is what two runs at once reach that are not connected, each bound to its core: cores share memory bandwidth, and virtual cores
perhaps a physical one. What two ranks fall short of that is communication and waiting. It is meaningful on an idle machine only.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import signal
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from endless_gym_agents.agent import Agent, make_agent
from endless_gym_agents.clock import Clock
from endless_gym_agents.environments import Environments
from endless_gym_agents.logs import PROGRESS, read_progress
from endless_gym_agents.ppo import learn, make_optimizer
from endless_gym_agents.ranks import Ranks
from endless_gym_agents.rollout import RolloutCollector, Segment
from endless_gym_agents.settings import Settings
from endless_gym_agents.train import parse

# Also where Python does not look beside the program for modules.
sys.path.insert(0, str(Path(__file__).parent))

from scale_model import (
    Cluster,
    Link,
    Prediction,
    RankCosts,
    fitted_learning,
    fitted_link,
    predict,
    scaling,
)

RANKS = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
#: Ranks of the measured all-reduce and of `--check`.
MEASURED = (1, 2, 4)
#: The weak scaling that two ranks with a core each should reach.
GOAL = 1.7


@contextmanager
def bound(cores: list[int]) -> Iterator[None]:
    """Bind this process, and what it starts, to cores."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, cores)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def sequences(settings: Settings, segment: Segment) -> int:
    """What is divided among the minibatches: sequences, or steps for an agent without memory."""
    steps, envs = segment.reset_mask.shape
    if settings.agent in ("gru", "lstm"):
        starts = segment.reset_mask.clone()
        starts[:: settings.recurrence.sequence_length] = True
        return int(starts.sum())
    if settings.agent in ("trxl", "gtrxl"):
        return envs * (steps // min(settings.transformer.sequence_length, steps))
    return steps * envs


def seconds_of(call: Any, repeats: int = 1) -> float:
    """Median seconds of a call."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def other_rank(agent: Agent, collector: RolloutCollector, segment: Segment, settings: Settings) -> float:
    """Seconds per update that each further rank costs: noise of its actions, and the division of its steps."""
    ppo, generator = settings.ppo, torch.Generator().manual_seed(0)
    states, mask, more = [memory.state for memory in collector.memories], segment.reset_mask.cpu(), 8
    own = range(mask.shape[1])

    def work(ranks: int) -> None:
        agent.noise((mask.shape[0], ranks * mask.shape[1]), None)
        everywhere = mask.repeat(1, ranks)
        for _ in range(ppo.epochs):
            for _ in agent.memory.minibatches(states, everywhere, ppo.minibatches, generator, own):
                pass

    alone, together = (seconds_of(lambda ranks=ranks: work(ranks), 5) for ranks in (1, 1 + more))
    return max(0.0, together - alone) / more


def measure_rank(settings: Settings, cores: list[int], updates: int) -> tuple[RankCosts, dict[str, float]]:
    """The costs of one rank on these cores, and the seconds of one environment step without an agent."""
    settings = settings.validated()
    ppo = settings.ppo
    torch.manual_seed(settings.seed)
    torch.set_num_threads(len(cores))
    with bound(cores), Environments(settings) as environments:
        actions = np.zeros((environments.per_group, len(environments.spec.branches)), dtype=np.int64)
        for group in range(environments.groups):
            environments.reset(group)

        def step() -> None:
            for group in range(environments.groups):
                environments.send(actions, group)
                environments.receive(group)

        step_alone = seconds_of(step, 200) / settings.environment.num_envs
        agent = make_agent(settings, environments.spec, torch.device("cpu"))
        optimizer = make_optimizer(agent, ppo.learning_rate)
        collector = RolloutCollector(agent, environments, ppo.steps, torch.Generator().manual_seed(1))
        clock, shuffle = Clock(), torch.Generator()
        rollouts, few, many, counts, totals = [], [], [], [], []
        for update in range(updates + 1):
            segment, _ = collector.collect(clock)
            spent, states = clock.take(), [memory.state for memory in collector.memories]
            count = sequences(settings, segment)
            # With too few sequences for twice the minibatches, half of them.
            fewer = ppo.minibatches if count >= 2 * ppo.minibatches else max(1, ppo.minibatches // 2)

            def learning(minibatches: int, update: int = update, segment: Any = segment, states: Any = states) -> float:
                changed = replace(ppo, minibatches=minibatches)
                return (
                    seconds_of(lambda: learn(agent, optimizer, segment, states, update, changed, shuffle)) / ppo.epochs
                )

            one, two = learning(fewer), learning(2 * fewer)
            if update:  # the first is the warm-up
                rollouts.append(spent)
                few.append(one)
                many.append(two)
                counts.append(count)
                totals.append(sum(spent.values()) + one * ppo.epochs)
        further = other_rank(agent, collector, segment, settings)
    epoch, minibatch = fitted_learning(statistics.mean(few), statistics.mean(many), fewer, 2)
    gradient_bytes = sum(weight.numel() * weight.element_size() for weight in agent.parameters())
    spread = statistics.stdev(totals) / statistics.mean(totals) if len(totals) > 1 else 0.0
    costs = RankCosts(
        steps=settings.environment.num_envs * ppo.steps,
        environment=statistics.mean(spent["stepping"] for spent in rollouts),
        inference=statistics.mean(spent["inference"] for spent in rollouts),
        epoch=epoch,
        minibatch=minibatch,
        other_rank=further,
        epochs=ppo.epochs,
        minibatches=min(ppo.minibatches, min(counts)),
        sequences=round(statistics.mean(counts)),
        gradient_bytes=gradient_bytes,
        cores=len(cores),
        spread=spread,
    )
    return costs, {"environment_step": step_alone}


def reduce_rank(rank: int, size: int, port: int, gradient_bytes: int, cores: list[int], file: str) -> None:
    """One of the processes of `measure_all_reduce`."""
    os.sched_setaffinity(0, [cores[rank % len(cores)]])
    torch.set_num_threads(1)
    os.environ |= {"RANK": str(rank), "WORLD_SIZE": str(size), "LOCAL_RANK": str(rank), "LOCAL_WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    ranks = Ranks()
    with ranks.connected():
        times = {}
        for name, numbers in (("small", 1), ("large", gradient_bytes // 4)):
            gradients = [torch.ones(numbers)]
            for _ in range(5):
                ranks.add(gradients)
            times[name] = seconds_of(lambda gradients=gradients: ranks.add(gradients), 50)
        # As slow as the slowest.
        every = ranks.everywhere(times)
    if ranks.is_first:
        Path(file).write_text(json.dumps({name: max(each[name] for each in every) for name in times}))


def measure_all_reduce(size: int, gradient_bytes: int, cores: list[int]) -> dict[str, float]:
    """Median seconds of an all-reduce of one number (`small`) and of the gradients (`large`) among processes of this machine."""
    with socket.socket() as free, tempfile.TemporaryDirectory() as folder:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
        free.close()
        file = f"{folder}/times.json"
        torch.multiprocessing.spawn(reduce_rank, (size, port, gradient_bytes, cores, file), nprocs=size)
        times: dict[str, float] = json.loads(Path(file).read_text())
    return times


def train_ranks(ranks: int, arguments: list[str], settings: Settings, cores: list[int], updates: int) -> float:
    """Environment steps per second of a real run of `torchrun`, without its first update.

    Args:
        ranks: Number of ranks.
        arguments: Arguments of `endless-train` for one rank.
        settings: What they mean.
        cores: The cores of all ranks; those of a rank are its own if there are enough.
        updates: Timed updates.
    """
    each = settings.threads
    with tempfile.TemporaryDirectory() as folder, bound(cores[: ranks * each]):
        launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={ranks}"]
        run = ["--run", f"{folder}/run", "--ppo.updates", str(updates + 1), "--no-stop-when-learnt"]
        run += ["--environment.num-envs", str(ranks * settings.environment.num_envs)]
        run += ["--bind-cores"] if ranks * each <= len(cores) else []
        done = subprocess.run(
            [*launch, "-m", "endless_gym_agents.train", "--", *arguments, *run],
            env=os.environ | {"OMP_NUM_THREADS": str(each), "CUDA_VISIBLE_DEVICES": ""},
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise SystemExit(f"training with {ranks} ranks ended with status {done.returncode}:\n{done.stderr[-3000:]}")
        rows = read_progress(Path(folder) / "run")[1:]
    return len(rows) / sum(1.0 / row["steps_per_second"] for row in rows)


def unconnected_runs(number: int, arguments: list[str], settings: Settings, cores: list[int], updates: int) -> float:
    """Environment steps per second of several runs at once that know nothing of each other.

    Only updates during which all of them train are counted.

    Args:
        number: Number of runs, each of one rank.
        arguments: Arguments of `endless-train` for one rank.
        settings: What they mean.
        cores: The cores of all runs, as many for each as its agent has threads.
        updates: Timed updates of each run.
    """
    each = settings.threads
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, runs = Path(name), []
        for run in range(number):
            program = [sys.executable, "-m", "endless_gym_agents.train", *arguments, "--run", str(folder / f"{run}")]
            log = stack.enter_context((folder / f"{run}.log").open("w"))
            with bound(cores[run * each :][:each]):
                process = subprocess.Popen(
                    [*program, "--ppo.updates", "1000000", "--no-stop-when-learnt"],
                    env=os.environ | {"OMP_NUM_THREADS": str(each), "CUDA_VISIBLE_DEVICES": ""},
                    stdout=log,
                    stderr=subprocess.STDOUT,
                )
            stack.callback(_end, process)
            runs.append((folder / f"{run}", process))

        def rows_when_all_have(least: list[int]) -> list[list[dict[str, Any]]]:
            while True:
                ended = [(run, process.returncode) for run, process in runs if process.poll() is not None]
                if ended:
                    run, status = ended[0]
                    text = run.with_suffix(".log").read_text()[-3000:]
                    raise SystemExit(f"an unconnected run ended with status {status}:\n{text}")
                rows = [read_progress(run) if (run / PROGRESS).exists() else [] for run, _ in runs]
                if all(len(found) >= wanted for found, wanted in zip(rows, least, strict=True)):
                    return rows
                time.sleep(0.05)

        # The update after these began while another run may still have started.
        begun = [len(rows) + 1 for rows in rows_when_all_have([1] * number)]
        rows = rows_when_all_have([first + updates for first in begun])
        timed = [found[first:][:updates] for found, first in zip(rows, begun, strict=True)]
    return sum(updates / sum(1.0 / row["steps_per_second"] for row in found) for found in timed)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a run after its update, as Ctrl-C does."""
    process.send_signal(signal.SIGINT)
    process.wait()


def gpu_rank(rank: RankCosts, settings: Settings, step: float, given: argparse.Namespace) -> RankCosts:
    """The costs of a rank with a GPU, from the given times; environments, sequences and gradients are those measured."""
    groups, ppo = settings.environment.groups, settings.ppo
    inference = ppo.steps * groups * given.gpu_act_ms / 1e3
    environments = rank.steps * (step if given.env_us is None else given.env_us / 1e6) / given.gpu_cores
    # While actions of one group are computed, the other groups step.
    waiting = environments if groups == 1 else max(0.0, environments - inference)
    return replace(
        rank,
        environment=waiting,
        inference=inference,
        epoch=rank.minibatches * given.gpu_learn_ms / 1e3,
        minibatch=0.0,
        cores=given.gpu_cores,
    )


def table(title: str, predictions: list[Prediction]) -> Table:
    """Predictions as a table of shares of an update's time."""
    shown = Table(title=title, title_justify="left")
    phases = list(predictions[0].seconds)
    for name in ("ranks", "steps/s", "efficiency", *phases):
        shown.add_column(name, justify="right")
    shown.add_column("limit")
    for row in predictions:
        shares = [f"{row.seconds[name] / row.total:.0%}" for name in phases]
        shown.add_row(f"{row.ranks:,}", f"{row.steps_per_second:,.0f}", f"{row.efficiency:.0%}", *shares, row.limit)
    return shown


def rows_of(predictions: list[Prediction]) -> list[dict[str, Any]]:
    """The predictions as JSON."""
    return [asdict(row) | {"steps_per_second": row.steps_per_second, "limit": row.limit} for row in predictions]


def parser() -> argparse.ArgumentParser:
    """The options, with their defaults."""
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)

    def add(name: str, default: Any, text: str, group: Any = made) -> None:
        kind = float if default is None else type(default)
        shown = "as measured" if default is None else "%(default)s"
        group.add_argument(name, type=kind, default=default, help=f"{text} (default: {shown})")

    add("--env", "MortarMayhem-Grid-v0", "environment id")
    add("--agent", "gru", "agent")
    add("--preset", "quick", "preset; its number of environments is that of each rank")
    add("--cores", 1, "cores of each rank")
    add("--updates", 5, "timed updates")
    add("--seed", 0, "seed of the simulation")
    add("--spread", None, "standard deviation of a rank's time of an update, as a share of its mean")
    made.add_argument("--check", action="store_true", help="train with 1, 2 and 4 ranks, beside the prediction")
    made.add_argument("--json", type=Path, help="write all numbers to this JSON file")
    network = made.add_argument_group("network between machines, assumed")
    add("--bandwidth", 1.25, "GB/s, such as 1.25 for 10 Gbit/s", network)
    add("--latency", 50.0, "microseconds of a message", network)
    gpus = made.add_argument_group("machines with GPUs, assumed; each rank has one GPU")
    add("--gpu-learn-ms", 20.0, "milliseconds of a minibatch's forward and backward pass", gpus)
    add("--gpu-act-ms", 0.5, "milliseconds of computing the actions of one group", gpus)
    add("--gpu-cores", 8, "cores of each rank, for its environments", gpus)
    add("--gpus", 8, "GPUs of a machine", gpus)
    add("--gpu-bandwidth", 50.0, "GB/s between GPUs of a machine", gpus)
    add("--gpu-latency", 10.0, "microseconds of a message between GPUs of a machine", gpus)
    add("--env-us", None, "microseconds of an environment's step on one core", gpus)
    made.add_argument("train", nargs="*", metavar="-- ARGUMENTS", help="further arguments of `endless-train`")
    return made


def check(
    rank: RankCosts, link: Link, cores: list[int], arguments: list[str], settings: Settings, given: argparse.Namespace
) -> dict[str, Any]:
    """Real runs beside their predictions, and the weak scaling of two ranks beside that of two unconnected runs.

    Returns:
        `rows`, one for each number of ranks; `goal`; and `None` where two ranks have no cores of their own:

        - `weak_scaling`: steps per second of two ranks, as a multiple of those of one.
        - `unconnected`: the same of two runs at once that are not connected.
        - `connected_share`: the first divided by the second. What is missing to 1 is communication and waiting.
    """
    rows = []
    for ranks in MEASURED:
        measured = train_ranks(ranks, arguments, settings, cores, given.updates)
        cluster = Cluster(within=link, ranks_per_machine=ranks, cores=len(cores))
        predicted = predict(rank, cluster, ranks, given.seed).steps_per_second
        used = min(len(cores), ranks * rank.cores)
        rows.append({"ranks": ranks, "cores": used, "measured": measured, "predicted": predicted})
    scaled = unconnected = None
    if len(cores) >= 2 * rank.cores:
        alone, together = (row["measured"] for row in rows[:2])
        scaled = together / alone
        unconnected = unconnected_runs(2, arguments, settings, cores, given.updates) / alone
    return {
        "rows": rows,
        "weak_scaling": scaled,
        "unconnected": unconnected,
        "connected_share": scaled / unconnected if scaled and unconnected else None,
        "goal": GOAL,
    }


def print_check(console: Console, found: dict[str, Any], cores: int, each: int) -> None:
    """Print what `check` returned.

    Args:
        console: Where to.
        found: What `check` returned.
        cores: Cores of this machine.
        each: Cores of each rank.
    """
    shown = Table(title="Training by torchrun on this machine", title_justify="left")
    for name in ("ranks", "cores", "measured steps/s", "predicted steps/s", "measured / predicted"):
        shown.add_column(name, justify="right")
    for row in found["rows"]:
        measured, predicted = row["measured"], row["predicted"]
        numbers = (f"{measured:,.0f}", f"{predicted:,.0f}", f"{measured / predicted:.2f}")
        shown.add_row(str(row["ranks"]), str(row["cores"]), *numbers)
    console.print(shown)
    if found["weak_scaling"] is None:
        console.print(f"weak scaling: not measured, since two ranks need {2 * each} cores, and there are {cores}")
        return
    owned = "one core" if each == 1 else f"{each} cores"
    share, ratio = found["connected_share"], found["weak_scaling"]
    console.print(
        f"weak scaling: two ranks with {owned} each make {ratio:.2f} times the steps of one (goal: {found['goal']})"
    )
    lost = f"communication and waiting cost {1 - share:.0%}" if share < 1 else "no cost of communication was found"
    console.print(f"two unconnected runs: {found['unconnected']:.2f} times; two ranks make {share:.0%} of that: {lost}")


def as_json(value: Any) -> Any:
    """A value with `None` for numbers that JSON does not have, such as the bandwidth of a link that costs nothing measurable."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: as_json(part) for key, part in value.items()}
    return [as_json(part) for part in value] if isinstance(value, list | tuple) else value


def main() -> None:
    """Measure, predict, print and write."""
    made = parser()
    given = made.parse_args()
    cores, console = sorted(os.sched_getaffinity(0)), Console(width=200)
    if not 1 <= given.cores <= len(cores):
        made.error(f"--cores must be 1 to {len(cores)}, the cores of this machine, got {given.cores}")
    if given.updates < 1:
        made.error(f"--updates must be 1 or more, got {given.updates}")
    arguments = ["--preset", given.preset, "--env", given.env, "--agent", given.agent, "--device", "cpu"]
    arguments += ["--threads", str(given.cores), "--environment.num-threads", str(given.cores), *given.train]
    settings = parse(arguments)
    rank, alone = measure_rank(settings, cores[: given.cores], given.updates)
    if given.spread is not None:
        rank = replace(rank, spread=given.spread)
    reductions = {ranks: measure_all_reduce(ranks, rank.gradient_bytes, cores) for ranks in MEASURED}
    link = fitted_link(2, reductions[2]["small"], reductions[2]["large"], rank.gradient_bytes)
    between = Link(given.latency / 1e6, given.bandwidth * 1e9)

    machine = f"{platform.machine()}, {len(cores)} cores"
    console.print(
        f"One rank, {given.cores} of the cores of this machine ({machine}): {settings.env}, {settings.agent}, ", end=""
    )
    console.print(f"{settings.environment.num_envs} environments, {settings.ppo.steps} steps")
    shown = Table("phase of an update", "ms")
    for name in ("environment", "inference", "learning"):
        shown.add_row(name, f"{1e3 * getattr(rank, name):.1f}")
    shown.add_row("each further rank's steps", f"{1e3 * rank.other_rank:.2f}")
    for ranks, times in reductions.items():
        shared = ", on shared cores" if ranks > len(cores) else ""
        shown.add_row(
            f"one all-reduce of {rank.gradient_bytes:,} bytes, ranks: {ranks}{shared}", f"{1e3 * times['large']:.2f}"
        )
    console.print(shown)
    console.print(
        f"{rank.sequences} sequences in {rank.minibatches} minibatches; spread of an update's time {rank.spread:.1%}"
    )

    local = Cluster(link, between, ranks_per_machine=len(cores) // given.cores)
    here = scaling(rank, local, RANKS, given.seed)
    network = f"assumed network: {given.bandwidth} GB/s, {given.latency} µs"
    console.print(table(f"Machines like this one, {local.ranks_per_machine} ranks each; {network}", here))
    shared = Cluster(link, between, ranks_per_machine=RANKS[-1], cores=len(cores))
    crowded = scaling(rank, shared, MEASURED, given.seed)
    console.print(table(f"This machine alone, whose {len(cores)} cores the ranks share", crowded))
    gpu = Cluster(Link(given.gpu_latency / 1e6, given.gpu_bandwidth * 1e9), between, ranks_per_machine=given.gpus)
    gpus = scaling(gpu_rank(rank, settings, alone["environment_step"], given), gpu, RANKS, given.seed)
    title = (
        f"Assumed machines with {given.gpus} GPUs: {given.gpu_learn_ms} ms a minibatch, {given.gpu_act_ms} ms to act, "
    )
    console.print(table(title + f"network {given.bandwidth} GB/s, {given.latency} µs", gpus))

    report: dict[str, Any] = {
        "machine": machine,
        "options": {name: str(value) for name, value in vars(given).items() if name != "json"},
        "rank": asdict(rank) | alone,
        "all_reduce": reductions,
        "link": asdict(link),
        "this_machine": rows_of(crowded),
        "machines": rows_of(here),
        "gpu_machines": rows_of(gpus),
    }
    if given.check:
        report["check"] = check(rank, link, cores, arguments, settings, given)
        print_check(console, report["check"], len(cores), given.cores)
    report["load"] = os.getloadavg()[0]
    if given.json:
        given.json.write_text(json.dumps(as_json(report), indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
