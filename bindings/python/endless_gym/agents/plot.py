"""`endless-plot`: learning curves, and the paper's aggregated, normalised plot, beside the paper's own curves.

Each plot is a PNG; beside it are a CSV file with the curves as they are drawn and a JSON file with the score of each run.

```console
endless-plot                                         # the paper's curves
endless-plot results.json --published gru trxl       # an evaluation beside them, each environment by itself
endless-plot results.json --aggregate endless        # all endless environments in one plot
endless-plot runs/mine                               # the rewards of a run's training
```
"""

from __future__ import annotations

import csv
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from endless_gym.agents import command, metrics
from endless_gym.agents.curves import (
    FAMILIES,
    Curve,
    Floats,
    aggregate,
    evaluated,
    published,
    published_environments,
    training,
)
from endless_gym.agents.results import read

Spread = Literal["std", "iqm", "runs"]


@dataclass(frozen=True)
class Plots:
    """What to draw."""

    paths: tyro.conf.Positional[tuple[Path, ...]] = ()
    """files of `endless-eval --json`, and runs' folders for the rewards of their training"""
    out: Path = Path("plots")
    """folder for the plots and their data"""
    published: tuple[str, ...] = ("gru", "trxl", "gru_rec", "trxl_rec")
    """the paper's agents that are drawn, too, where it has them; none for `--published` alone"""
    env: tuple[str, ...] = ()
    """environments that are drawn; those of the given results, or without results all of the paper's"""
    aggregate: Literal["no", "finite", "endless"] = "no"
    """draw these environments in one plot, in place of one plot for each: finite ones by their task progress, endless ones
    divided by the best mean of the paper's GRU"""
    spread: Spread = "std"
    """std: the mean over the runs and one standard deviation, as the paper's aggregated plots; iqm: the interquartile mean and
    its 95 % bootstrap interval; runs: each run by itself, as the paper's other plots"""
    max_steps: int = 0
    """draw no further than this number of environment steps; 0 for all"""


def estimates(curve: Curve, spread: Spread) -> list[tuple[float, ...]]:
    """A row for each checkpoint: steps, then centre, low and high, or with `runs` each run's score."""
    columns: list[Floats] = list(curve.scores)
    if spread != "runs":
        columns = list(curve.mean() if spread == "std" else curve.interquartile_mean())
    return [
        (int(step), *(float(value) for value in row))
        for step, row in zip(curve.steps, zip(*columns, strict=True), strict=True)
    ]


def draw(name: str, axis: str, curves: Sequence[Curve], spread: Spread, out: Path) -> Path:
    """Write NAME.png, NAME.csv and NAME.json.

    Returns:
        The picture's file.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    out.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(9, 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for place, curve in enumerate(curves):
        rows = estimates(curve, spread)
        steps = [row[0] / 1e6 for row in rows]
        style = "--" if curve.source == "published" else "-"
        title = f"{curve.label} (paper)" if curve.source == "published" else curve.label
        marker = "o" if len(steps) == 1 else ""
        if spread == "runs":
            for run in range(len(curve.scores)):
                values = [row[1 + run] for row in rows]
                axes.plot(
                    steps, values, style, marker=marker, color=f"C{place}", alpha=0.8, label=title if not run else ""
                )
        else:
            axes.plot(steps, [row[1] for row in rows], style, marker=marker, color=f"C{place}", label=title)
            axes.fill_between(
                steps, [row[2] for row in rows], [row[3] for row in rows], color=f"C{place}", alpha=0.2, lw=0
            )
    axes.set(title=name, xlabel="Steps (in millions)", ylabel=axis)
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend()
    figure.savefig(out / f"{name}.png", dpi=150)

    with (out / f"{name}.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        if spread == "runs":
            writer.writerow(["source", "label", "run", "steps", "score"])
            for curve in curves:
                for row in estimates(curve, spread):
                    writer.writerows(
                        [curve.source, curve.label, run, row[0], score] for run, score in enumerate(row[1:])
                    )
        else:
            writer.writerow(["source", "label", "steps", "mean" if spread == "std" else "iqm", "low", "high"])
            writer.writerows([curve.source, curve.label, *row] for curve in curves for row in estimates(curve, spread))
    data = [
        {"env": curve.env, "label": curve.label, "source": curve.source}
        | {"steps": curve.steps.tolist(), "scores": curve.scores.tolist()}
        for curve in curves
    ]
    (out / f"{name}.json").write_text(json.dumps({"axis": axis, "curves": data}) + "\n")
    return out / f"{name}.png"


def given_curves(paths: Sequence[Path]) -> list[Curve]:
    """The curves of results' files and runs' folders.

    Raises:
        FileNotFoundError: A path does not exist.
        ValueError: A file is something else.
    """
    curves: list[Curve] = []
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"no file or folder {path}; give a file of `endless-eval --json` or a run's folder")
        curves += [training(path)] if path.is_dir() else [evaluated(one) for one in read(path)]
    return curves


def draw_all(given: Plots) -> list[Path]:
    """Draw all that is wanted.

    Returns:
        The pictures' files.
    """
    own = given_curves(given.paths)
    known = published_environments()
    for env in given.env:
        if env not in known and env not in {curve.env for curve in own}:
            raise ValueError(f"no curves of environment `{env}`; the paper has {', '.join(known)}")
    pictures = []
    if given.aggregate != "no":
        theirs = [curve for env in FAMILIES[given.aggregate] for curve in published(env, given.published)]
        curves = aggregate(given.aggregate, [*own, *theirs])
        complete = {curve.label for curve in curves if curve.source == "evaluated"}
        partial = {curve.label for curve in own if curve.env in FAMILIES[given.aggregate]} - complete
        # An agent with reconstruction may stand in for one without; see `aggregate`.
        partial = {label for label in partial if label.removesuffix("_rec") not in complete}
        if partial or (own and not complete):
            raise ValueError(
                f"{', '.join(sorted(partial)) or 'the results'}: the {given.aggregate} plot wants evaluations in all of "
                f"{', '.join(FAMILIES[given.aggregate])}"
            )
        if not curves:
            raise ValueError(
                f"nothing to draw: the paper has no {', '.join(given.published)} in all {given.aggregate} tasks"
            )
        axis = "Task progress" if given.aggregate == "finite" else "Normalised score"
        pictures.append(draw(given.aggregate, axis, _cut(curves, given.max_steps), given.spread, given.out))
    else:
        # The rewards of training are another measure than those of the evaluation, and get plots of their own.
        trained = [curve for curve in own if curve.source == "training"]
        measured = [curve for curve in own if curve.source != "training"]
        for env in dict.fromkeys(curve.env for curve in trained):
            curves = [curve for curve in trained if curve.env == env and env in (given.env or (env,))]
            if curves:
                axis = "Reward of training episodes"
                pictures.append(draw(f"{env}-training", axis, _cut(curves, given.max_steps), given.spread, given.out))
        envs = given.env or tuple(dict.fromkeys(curve.env for curve in measured)) or (() if trained else tuple(known))
        for env in envs:
            curves = [curve for curve in measured if curve.env == env] + published(env, given.published)
            if curves:
                _, axis = metrics.metric(env)
                pictures.append(draw(env, axis, _cut(curves, given.max_steps), given.spread, given.out))
    return pictures


def work(given: Plots) -> None:
    """Draw, and tell."""
    console = Console()
    for picture in draw_all(given):
        console.print(f"{picture}, with its data in .csv and .json", soft_wrap=True)


def _cut(curves: Sequence[Curve], steps: int) -> list[Curve]:
    return [curve.until(steps) if steps else curve for curve in curves]


def main() -> int:
    """The command `endless-plot`."""
    given = tyro.cli(Plots, prog="endless-plot", description=command.description(__doc__), args=sys.argv[1:])
    return command.run("endless-plot", lambda: work(given))


if __name__ == "__main__":
    sys.exit(main())
