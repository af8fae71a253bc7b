"""`endless-eval`: the paper's evaluation of trained agents.

Each checkpoint plays 50 seeds that no training has seen, three times each, drawing its actions. A run's score is the mean of
these episodes; what is said of an agent is said over its runs.

```console
endless-eval runs/mine                                   # the run's checkpoints
endless-eval runs --last --json results.json             # the last checkpoints of all runs below a folder
```
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from endless_gym.agents import checkpoint, command, metrics
from endless_gym.agents.evaluate import EVALUATION_SEEDS, REPETITIONS, evaluate
from endless_gym.agents.results import Experiment, Experiments, Run, to_json
from endless_gym.agents.train import choose_device


@dataclass(frozen=True)
class Evaluation:
    """What to evaluate, and how; the defaults are the paper's protocol."""

    paths: tyro.conf.Positional[tuple[Path, ...]]
    """checkpoints' files, runs' folders, or folders with runs somewhere below them"""
    last: bool = False
    """only the last checkpoint of each run"""
    first_seed: int = EVALUATION_SEEDS.start
    """the seeds are this one and those that follow it"""
    seeds: int = len(EVALUATION_SEEDS)
    """how many seeds are played"""
    repetitions: int = REPETITIONS
    """how often each seed is played"""
    draws: int = 0
    """seed of the agent's draws: the same one gives the same numbers"""
    greedy: bool = False
    """take the most likely actions instead of drawing them; not the paper's protocol"""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA where there is one"""
    threads: int = 0
    """threads that PyTorch computes with on the CPU; 0 leaves that to PyTorch"""
    engine_threads: int = 0
    """threads that step the environments; 0 for one for each core"""
    json: Annotated[str, tyro.conf.arg(metavar="FILE")] = ""
    """write all results to this file, which `endless-plot` reads; `-`: to the standard output, in place of the table"""
    episodes: bool = False
    """write each episode, too"""


def find(paths: tuple[Path, ...], last: bool) -> list[tuple[Path, list[Path]]]:
    """Runs, each with its checkpoints' files in order.

    Raises:
        FileNotFoundError: One of the paths does not exist, or there is no checkpoint below it.
    """
    found: dict[Path, list[Path]] = {}
    if not paths:
        raise FileNotFoundError("nothing to evaluate; give a checkpoint, a run's folder or a folder of runs")
    for path in (path.parent if path.name == checkpoint.FOLDER else path for path in paths):
        if path.is_file():
            run = path.parent.parent if path.parent.name == checkpoint.FOLDER else path
            given = found.setdefault(run, [])
            given += [path] if path not in given else []
            continue
        if not path.exists():
            raise FileNotFoundError(f"no file or folder {path}; give a checkpoint, a run's folder or a folder of runs")
        below = sorted(folder.parent for folder in path.rglob(checkpoint.FOLDER) if any(folder.glob("*.pt")))
        if not below:
            raise FileNotFoundError(f"no checkpoint in {path}; give a run's folder, as `endless-train` writes it")
        for run in below:
            found[run] = [run / checkpoint.FOLDER / checkpoint.LAST] if last else checkpoint.files(run)
    return list(found.items())


def evaluate_runs(given: Evaluation, console: Console) -> list[Experiment]:
    """Play the episodes of all checkpoints."""
    if given.seeds < 1 or given.repetitions < 1:
        raise ValueError(f"{given.seeds} seeds, {given.repetitions} times each: give 1 or more of both")
    runs, device = find(given.paths, given.last), choose_device(given.device)
    if given.threads:
        torch.set_num_threads(given.threads)
    seeds = range(given.first_seed, given.first_seed + given.seeds)
    experiments = Experiments()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        checkpoints = bar.add_task("checkpoints", total=sum(len(files) for _, files in runs))
        episodes = bar.add_task("episodes", total=given.seeds * given.repetitions)
        for folder, files in runs:
            run: Run | None = None
            for file in files:
                bar.reset(episodes, description=f"episodes of {file.name}")
                loaded = command.load_checkpoint(file, device)
                settings = loaded.settings
                if run is None:
                    run = Run(str(folder), settings.seed)
                    experiments.of(settings).runs.append(run)
                results = evaluate(
                    loaded.agent,
                    seeds,
                    given.repetitions,
                    num_threads=given.engine_threads or None,
                    draws=given.draws,
                    greedy=given.greedy,
                    ended=lambda number: bar.advance(episodes, number),
                )
                run.add(loaded.steps, results)
                bar.advance(checkpoints)
    return experiments.all()


def table(experiment: Experiment) -> Table:
    """All metrics of the last checkpoint, and the paper's metric of those before it."""
    options = "".join(f", {name}={value}" for name, value in experiment.options.items())
    first, _ = metrics.metric(experiment.env)
    rows = [(first, *row) for row in experiment.summaries(first)]
    title = f"{experiment.env}, {experiment.label}, over {rows[0][-1]}{options}"
    drawn = Table(title=title, title_justify="left", box=box.SIMPLE)
    for name in ("steps", "metric", "mean", "std", "IQM", "95 % interval"):
        drawn.add_column(name, justify="left" if name == "metric" else "right", no_wrap=True)
    others = [name for name in experiment.runs[0].metrics if name != first]
    rows += [(name, *row) for name in others for row in experiment.summaries(name)[-1:]]
    for name, step, summary, _ in rows:
        interval = f"{summary.low:.4f} {summary.high:.4f}"
        drawn.add_row(f"{step:,}", name, f"{summary.mean:.4f}", f"{summary.std:.4f}", f"{summary.iqm:.4f}", interval)
    return drawn


def protocol(given: Evaluation) -> dict[str, Any]:
    """How it was evaluated, for the results."""
    return {
        "first_seed": given.first_seed,
        "seeds": given.seeds,
        "repetitions": given.repetitions,
        "draws": given.draws,
        "greedy": given.greedy,
    }


def work(given: Evaluation) -> None:
    """Evaluate, and tell."""
    if given.json not in ("", "-") and not Path(given.json).resolve().parent.is_dir():
        raise FileNotFoundError(f"no folder {Path(given.json).parent} to write {given.json} to; make it first")
    messages = Console(stderr=True)
    experiments = evaluate_runs(given, messages)
    for experiment in experiments:
        if not experiment.common_steps():
            raise ValueError(
                f"the {len(experiment.runs)} runs of {experiment.env}, {experiment.label}, have no checkpoint at the same number "
                "of steps; evaluate them one by one, or train with one --checkpoint-interval and --keep-checkpoints"
            )
    written = to_json(experiments, protocol(given), given.episodes)
    if given.json == "-":
        print(json.dumps(written, indent=1))
        return
    if given.json:
        Path(given.json).write_text(json.dumps(written) + "\n")
    console = Console()
    for experiment in experiments:
        console.print(table(experiment))


def main() -> int:
    """The command `endless-eval`."""
    given = tyro.cli(Evaluation, prog="endless-eval", description=command.description(__doc__), args=sys.argv[1:])
    return command.run("endless-eval", lambda: work(given))


if __name__ == "__main__":
    sys.exit(main())
