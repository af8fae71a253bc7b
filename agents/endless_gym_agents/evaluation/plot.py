"""`endless-plot`: plot learning curves together with the curves of the paper, per environment or aggregated and normalised.

Each plot is a PNG file, with a CSV file of the plotted values and a JSON file of the scores of each run.

```console
endless-plot                                         # the curves of the paper
endless-plot results.json --published gru trxl       # an evaluation and the paper's curves, one plot per environment
endless-plot results.json --aggregate endless        # all endless environments in one plot
endless-plot results.json --aggregate all            # all tasks of the results in one plot, also your own
endless-plot runs/mine                               # the training rewards of a run
```
"""

from __future__ import annotations

import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

from endless_gym.program.printable import printable
from endless_gym_agents.common import atomic, command, tables
from endless_gym_agents.common.palette import AGENTS
from endless_gym_agents.common.ranges import Natural
from endless_gym_agents.evaluation import compare
from endless_gym_agents.evaluation.curves import (
    AXES,
    FAMILIES,
    Curve,
    Floats,
    aggregate,
    evaluated,
    joined,
    published,
    published_environments,
    published_labels,
    training,
)
from endless_gym_agents.evaluation.results import Experiment, metric, own_name, read

Spread = Literal["std", "iqm", "runs"]


@dataclass(frozen=True)
class PlotArguments:
    """Arguments of `endless-plot`."""

    paths: tyro.conf.Positional[tuple[Path, ...]] = ()
    """files of `endless-eval --json`, and folders of runs for their training rewards"""
    out: Path = Path("plots")
    """output folder for the plots and their data"""
    published: tuple[str, ...] = ("gru", "trxl", "gru_rec", "trxl_rec")
    """agents of the paper to include, where it has their curves; `--published` without a value for none"""
    env: tuple[str, ...] = ()
    """environments to plot; by default those of the given results, or without results all environments of the paper"""
    aggregate: Literal["no", "finite", "endless", "all"] = "no"
    """one plot over all environments of this kind of the paper instead of one plot per environment; scores are the task progress
    in finite environments, and divided by the best mean of the paper's GRU in endless ones. all: over all tasks of the results,
    normalised as by `endless-compare`"""
    range: tuple[str, ...] = ()
    """with `--aggregate all`: the returns that become 0 and 1 in a task, as for `endless-compare`"""
    spread: Spread = "std"
    """std: mean over the runs and one standard deviation, as in the aggregated plots of the paper; iqm: interquartile mean and
    its 95 % interval, corrected for few runs; runs: one line per run, as in the other plots of the paper"""
    max_steps: Natural = 0
    """largest number of environment steps to plot; 0 for all"""


def estimates(curve: Curve, spread: Spread) -> list[tuple[float, ...]]:
    """A row for each checkpoint: steps, then centre, low and high; or for the spread `runs`, steps and the score of each run."""
    columns: Sequence[Floats] = list(curve.scores)
    if spread != "runs":
        columns = curve.mean() if spread == "std" else curve.interquartile_mean()
    return list(zip(curve.steps.tolist(), *(column.tolist() for column in columns), strict=True))


@dataclass(frozen=True)
class Scale:
    """The horizontal axis of a plot.

    Attributes:
        name: What `Curve.steps` counts, as named in the files.
        label: Label of the axis.
        unit: Steps or seconds per unit of the axis.
    """

    name: str
    label: str
    unit: float


STEPS, HOURS = Scale("steps", "Steps (in millions)", 1e6), Scale("seconds", "Hours", 3600.0)


def draw(name: str, axis: str, curves: Sequence[Curve], spread: Spread, out: Path, scale: Scale = STEPS) -> Path:
    """Plot curves, and write NAME.png, NAME.csv and NAME.json.

    Args:
        name: Title of the plot and stem of the file names.
        axis: Label of the score axis.
        curves: The curves.
        spread: How the runs are shown.
        out: Output folder; created if it does not exist.
        scale: The horizontal axis.

    Returns:
        Path of the PNG file.

    Raises:
        ModuleNotFoundError: Matplotlib is not installed.
    """
    command.check_installed("a plot", "matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    out.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for number, curve in enumerate(curves):
        own = own_name(curve.label)
        rows, colour = estimates(curve, spread), AGENTS.get(own, (f"C{number}",))[0]
        steps = [row[0] / scale.unit for row in rows]
        style = "--" if curve.source == "published" else "-"
        title = f"{curve.label} (paper)" if curve.source == "published" else own
        marker = "o" if len(steps) == 1 else ""
        if spread == "runs":
            for run in range(len(curve.scores)):
                values = [row[1 + run] for row in rows]
                axes.plot(steps, values, style, marker=marker, color=colour, alpha=0.8, label=title if not run else "")
        else:
            axes.plot(steps, [row[1] for row in rows], style, marker=marker, color=colour, label=title)
            axes.fill_between(steps, [row[2] for row in rows], [row[3] for row in rows], color=colour, alpha=0.2, lw=0)
    axes.set(title=name, xlabel=scale.label, ylabel=axis)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend()
    with atomic.replacing(out / f"{name}.png") as picture:
        figure.savefig(picture, dpi=150, format="png")

    columns = ["source", "label", scale.name, "mean" if spread == "std" else "iqm", "low", "high"]
    table = [(curve.source, curve.label, *row) for curve in curves for row in estimates(curve, spread)]
    if spread == "runs":
        columns[2:] = ["run", scale.name, "score"]
        table = [(*row[:2], run, row[2], score) for row in table for run, score in enumerate(row[3:])]
    atomic.write(out / f"{name}.csv", tables.csv_text(columns, table))
    data = [
        {"env": curve.env, "label": curve.label, "source": curve.source}
        | {scale.name: curve.steps.tolist(), "scores": curve.scores.tolist()}
        for curve in curves
    ]
    atomic.write(out / f"{name}.json", json.dumps({"axis": axis, "curves": data}) + "\n")
    return out / f"{name}.png"


def read_curves(paths: Sequence[Path]) -> list[Curve]:
    """Read the curves from result files and folders of runs.

    Raises:
        FileNotFoundError: A path does not exist, or a folder contains no run.
        ValueError: A file has another format, or contains no curve.
    """
    curves: list[Curve] = []
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(
                f"no such file or folder: {path}; expected a file of `endless-eval --json` or the folder of a run"
            )
        curves += [training(path)] if path.is_dir() else [evaluated(one) for one in read(path)]
    return curves


def aggregate_tasks(paths: Sequence[Path], given: Sequence[str] = ()) -> list[Curve]:
    """The normalised returns of each agent over all tasks of files of results.

    Args:
        paths: The files.
        given: The returns that become 0 and 1, as `--range` takes them.

    Raises:
        ValueError: An agent lacks a task, or a task the returns that become 0 and 1.
    """
    rows, experts = compare.read_scores(paths)
    ranges = compare.ranges_of(rows, experts, given)
    found: dict[str, dict[str, Experiment]] = {}
    for experiment in itertools.chain.from_iterable(map(read, paths)):
        own = found.setdefault(experiment.label, {})
        task = compare.task_name(experiment.env, experiment.options)
        own.setdefault(task, Experiment(task, experiment.label)).runs.extend(experiment.runs)
    curves = []
    for label, own in found.items():
        if missing := [task for task in ranges if task not in own]:
            raise ValueError(f"{label}: the plot of all tasks needs evaluations in {', '.join(missing)}, too")
        parts = []
        for task, (zero, one) in ranges.items():
            steps, scores = np.array(own[task].common_steps(), dtype=np.int64), own[task].scores("reward")
            parts.append(Curve(task, label, "evaluated", steps, (scores - zero) / (one - zero)))
        curves.append(joined("all", label, parts))
    return curves


def draw_all(arguments: PlotArguments) -> list[Path]:
    """Draw all requested plots.

    Returns:
        Paths of the PNG files.

    Raises:
        FileNotFoundError: A path does not exist.
        ValueError: There are no curves for an environment, or too few for an aggregated plot.
    """
    own = [] if arguments.aggregate == "all" else read_curves(arguments.paths)
    known, labels = published_environments(), published_labels()
    if unknown := [label for label in arguments.published if label not in labels]:
        raise ValueError(f"--published must be among {', '.join(labels)}, got `{unknown[0]}`")
    for env in arguments.env:
        if env not in known and env not in {curve.env for curve in own}:
            raise ValueError(f"no curves of environment `{env}`; the paper has curves of {', '.join(known)}")
    plots = []

    def add(name: str, axis: str, curves: Sequence[Curve]) -> None:
        steps = arguments.max_steps
        curves = [curve.until(steps) if steps else curve for curve in curves]
        if curves:
            outputs = [arguments.out / f"{name}.{kind}" for kind in ("png", "csv", "json")]
            command.check_outputs(outputs, [path for path in arguments.paths if path.is_file()])
            plots.append(draw(name, axis, curves, arguments.spread, arguments.out))

    if arguments.aggregate == "all":
        add("all", "Normalised return", aggregate_tasks(arguments.paths, arguments.range))
        return plots
    if arguments.aggregate != "no":
        paper = [curve for env in FAMILIES[arguments.aggregate] for curve in published(env, arguments.published)]
        curves = aggregate(arguments.aggregate, [*own, *paper])
        complete = {curve.label for curve in curves if curve.source == "evaluated"}
        partial = {curve.label for curve in own if curve.env in FAMILIES[arguments.aggregate]} - complete
        # `aggregate` can complete an agent with the curve of its variant with reconstruction.
        partial = {label for label in partial if label.removesuffix("_rec") not in complete}
        if partial or (own and not complete):
            raise ValueError(
                f"{', '.join(sorted(partial)) or 'the results'}: the {arguments.aggregate} plot needs evaluations in all of "
                f"{', '.join(FAMILIES[arguments.aggregate])}"
            )
        if not curves:
            raise ValueError(
                f"nothing to plot: no agent among --published ({', '.join(arguments.published) or 'empty'}) has curves in all "
                f"{arguments.aggregate} environments"
            )
        add(arguments.aggregate, AXES[arguments.aggregate], curves)
        return plots
    # Training rewards are not comparable with evaluation metrics, and are drawn in separate plots.
    trained = [curve for curve in own if curve.source == "training"]
    measured = [curve for curve in own if curve.source != "training"]
    for env in dict.fromkeys(curve.env for curve in trained):
        if env in (arguments.env or (env,)):
            add(f"{env}-training", "Reward of training episodes", [curve for curve in trained if curve.env == env])
    for env in arguments.env or dict.fromkeys(curve.env for curve in measured) or (() if trained else known):
        paper, mine = published(env, arguments.published), [curve for curve in measured if curve.env == env]
        changed = [curve.label for curve in mine if ", " in curve.label]
        if paper and changed:
            print(
                printable(
                    f"endless-plot: {env}: {'; '.join(changed)} is another task than the paper's, with which its score "
                    "cannot be compared; omit the paper's curves with --published"
                ),
                file=sys.stderr,
            )
        curves = mine + paper
        add(env, metric(env).label, curves)
    return plots


def execute(arguments: PlotArguments) -> None:
    """Draw all requested plots, and print their paths."""
    console = command.Terminal()
    for plot in draw_all(arguments):
        console.print(f"{plot}, with its data in .csv and .json", soft_wrap=True)


def main() -> int:
    """Entry point of the command `endless-plot`; returns the exit status."""
    return command.main("endless-plot", PlotArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
