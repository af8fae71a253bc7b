"""`endless-eval`: evaluate trained agents with the protocol of the paper.

Each checkpoint plays 50 seeds that training never uses, three episodes each, with sampled actions. The score of a run is the
mean over these episodes; statistics of an agent are computed over its runs.

```console
endless-eval runs/mine                                   # all checkpoints of a run
endless-eval runs --last --json results.json             # the last checkpoints of all runs below a folder
```
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from endless_gym_agents.common import atomic, command, tables
from endless_gym_agents.common.ranges import Natural, Positive
from endless_gym_agents.evaluation.conformance import state_bytes
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS, REPETITIONS, evaluate
from endless_gym_agents.evaluation.results import Experiment, Experiments, Run, metric, own_name, to_json
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress, update_seconds
from endless_gym_agents.training.train import choose_device


@dataclass(frozen=True)
class EvalArguments:
    """Arguments of `endless-eval`; the defaults are the protocol of the paper."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """checkpoint files, folders of runs, or folders that contain runs at any depth"""
    last: bool = False
    """evaluate only the last checkpoint of each run; runs that stop when they have learnt are compared at their ends"""
    first_seed: Natural = EVALUATION_SEEDS.start
    """first seed; the seeds are consecutive"""
    seeds: Positive = 50
    """number of seeds"""
    repetitions: Positive = REPETITIONS
    """episodes per seed"""
    action_seed: Natural = 0
    """seed of the action sampling; the same seed gives the same results"""
    greedy: bool = False
    """take the most likely actions instead of sampling; not the protocol of the paper"""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available, else the CPU"""
    threads: Natural = 0
    """CPU threads of PyTorch; 0 for PyTorch's default"""
    engine_threads: Natural = 0
    """threads that step the environments; 0 for one per core"""
    json: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """write the results to this file, for `endless-plot`; `-` for standard output, instead of the table"""
    episodes: bool = False
    """include every episode in the file"""


def find(paths: tuple[Path, ...], last: bool) -> list[tuple[Path, list[Path]]]:
    """Find runs and their checkpoints.

    Args:
        paths: Checkpoint files, folders of runs, or folders that contain runs.
        last: Only the last checkpoint of each run.

    Returns:
        The folder of each run, with its checkpoint files in order.

    Raises:
        FileNotFoundError: A path does not exist, or contains no checkpoint.
    """
    found: dict[Path, list[Path]] = {}
    if not paths:
        raise FileNotFoundError(
            "no path given; expected checkpoint files, folders of runs or folders that contain runs"
        )
    for path in (path.parent if path.name == checkpoint.FOLDER else path for path in paths):
        if path.is_file():
            run = path.parent.parent if path.parent.name == checkpoint.FOLDER else path
            files = found.setdefault(run, [])
            files += [path] if path not in files else []
            continue
        if not path.exists():
            raise FileNotFoundError(
                f"no such file or folder: {path}; expected a checkpoint file, the folder of a run or a folder that contains runs"
            )
        below = sorted(
            folder.parent for folder in path.rglob(checkpoint.FOLDER) if checkpoint.last(folder.parent).exists()
        )
        if not below:
            raise FileNotFoundError(
                f"no checkpoint in {path}; expected the folder of a run, as endless-train writes it"
            )
        for run in below:
            found[run] = [checkpoint.last(run)] if last else checkpoint.files(run)
    return list(found.items())


def cost(loaded: checkpoint.Checkpoint, folder: Path) -> dict[str, float]:
    """What an agent and its run took, for `Run.cost`."""
    found: dict[str, float] = {
        "parameters": loaded.agent.num_parameters,
        "state_bytes": state_bytes(loaded.agent.initial_memory(1).state),
    }
    if loaded.settings.threads == 1 and (rows := read_progress(folder)):
        found["core_seconds"] = round(sum(update_seconds(rows)), 2)
    return found


def evaluate_runs(arguments: EvalArguments, console: Console, failed: list[str] | None = None) -> list[Experiment]:
    """Evaluate all checkpoints.

    Args:
        arguments: The arguments.
        console: Where the progress bar is shown.
        failed: Receives why a run cannot be evaluated, if other runs can; `None` to raise the first such error.

    Returns:
        The results, with runs that differ only in their seeds grouped into experiments.

    Raises:
        FileNotFoundError: A path does not exist, or contains no checkpoint.
        ValueError: A number is out of range, a file is not a checkpoint, or the device is not available.
    """
    runs, device = find(arguments.paths, arguments.last), choose_device(arguments.device)
    if arguments.threads:
        torch.set_num_threads(arguments.threads)
    seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
    experiments = Experiments()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        checkpoints = bar.add_task("checkpoints", total=sum(len(files) for _, files in runs))
        episodes = bar.add_task("episodes", total=arguments.seeds * arguments.repetitions)
        for folder, files in runs:
            run: Run | None = None
            for file in files:
                bar.reset(episodes, description=f"episodes of {file.name}")
                try:
                    loaded = checkpoint.load(file, device)
                except (OSError, ValueError) as error:
                    if failed is None or len(runs) == 1:
                        raise
                    failed.append(str(error))
                    bar.advance(checkpoints)
                    continue
                settings = loaded.settings
                if run is None:
                    run = Run(str(folder), settings.seed, cost=cost(loaded, folder))
                    experiment = experiments.of(settings)
                    stops = settings.stop_when_learnt or settings.target_reward is not None
                    experiment.last = arguments.last and stops and (experiment.last or not experiment.runs)
                    experiment.runs.append(run)
                results = evaluate(
                    loaded.agent,
                    seeds,
                    arguments.repetitions,
                    num_threads=arguments.engine_threads or None,
                    action_seed=arguments.action_seed,
                    greedy=arguments.greedy,
                    ended=lambda number: bar.advance(episodes, number),
                )
                run.add(loaded.steps, results)
                bar.advance(checkpoints)
    return experiments.all()


def table(experiment: Experiment) -> Table:
    """A table with all metrics of the last checkpoint, and the paper's metric for the earlier ones.

    The interval is that of the interquartile mean (IQM) of the runs, or of the mean of a run's episodes. Final
    infos that count failures as successes are marked, and the caption says which metric to trust.
    """
    first, _ = metric(experiment.env)
    rows = [(first, *row) for row in experiment.summaries(first)]
    label = own_name(experiment.label)
    label += " (ppo in the paper)" if label != experiment.label else ""
    title = ", ".join([experiment.env, label, f"over {rows[0][-1]}", *command.assignments(experiment.options)])
    others = [name for name in experiment.runs[0].metrics if name != first]
    rows += [(name, *row) for name in others for row in experiment.summaries(name)[-1:]]
    # In finite Mortar Mayhem.
    doubtful = {"success", "commands_completed"} if "commands_completed" in others else set()
    caption = (
        f"Trust {first}. * as the original reports it: a last command that failed counts as executed, so that an agent "
        "that fails can reach 1.0."
    )
    interval_of = ("95 % of mean",) if len(experiment.runs) == 1 else ("IQM", "95 % of IQM")
    columns = {name: name != "metric" for name in ("steps", "metric", "mean", "std", *interval_of)}
    result = tables.table(title, columns, caption if doubtful else "")
    for name, step, summary, _ in rows:
        name = f"{name} *" if name in doubtful else name
        interval = f"{summary.low:.4f} {summary.high:.4f}"
        iqm = [] if summary.iqm is None else [f"{summary.iqm:.4f}"]
        result.add_row(f"{step:,}", name, f"{summary.mean:.4f}", f"{summary.std:.4f}", *iqm, interval)
    return result


def execute(arguments: EvalArguments) -> None:
    """Evaluate the checkpoints, and write or print the results."""
    if arguments.json not in ("", "-"):
        if not Path(arguments.json).resolve().parent.is_dir():
            raise FileNotFoundError(f"cannot write {arguments.json}: no folder {Path(arguments.json).parent}")
        runs = find(arguments.paths, arguments.last)
        read = [file for _, files in runs for file in checkpoint.protected(files[0])]
        command.check_outputs([Path(arguments.json)], read)
    messages, start = command.Terminal(stderr=True), time.monotonic()
    failed: list[str] = []
    found = evaluate_runs(arguments, messages, failed)
    experiments = [experiment for experiment in found if experiment.common_steps()]
    failed += [
        f"the {len(experiment.runs)} runs of {experiment.env}, {experiment.label}, have no checkpoints at a common "
        "number of steps; evaluate them separately, or train with the same --checkpoint-interval and --keep-checkpoints"
        for experiment in found
        if experiment not in experiments
    ]
    if not experiments:
        raise ValueError("; ".join(failed))
    names = ("first_seed", "seeds", "repetitions", "action_seed", "greedy")
    written = to_json(experiments, {name: getattr(arguments, name) for name in names}, arguments.episodes)
    written["seconds"] = time.monotonic() - start
    if arguments.json == "-":
        print(json.dumps(written, indent=1))
    else:
        if arguments.json:
            atomic.write(arguments.json, json.dumps(written) + "\n")
        console = command.Terminal()
        for experiment in experiments:
            tables.show(table(experiment), console)
    if failed:
        raise ValueError(f"the others are evaluated; {'; '.join(failed)}")


def main() -> int:
    """Entry point of the command `endless-eval`; returns the exit status."""
    return command.main("endless-eval", EvalArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
