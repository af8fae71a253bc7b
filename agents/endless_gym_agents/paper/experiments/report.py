"""Figures and tables of an experiment, our results next to the published ones, in a folder with a README."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from endless_gym_agents.common import atomic, regular, tables
from endless_gym_agents.evaluation import results
from endless_gym_agents.evaluation.curves import AXES, FAMILIES, Curve, aggregate, evaluated, published
from endless_gym_agents.evaluation.plot import HOURS, draw
from endless_gym_agents.evaluation.statistics import interquartile_mean
from endless_gym_agents.paper.experiments import planning
from endless_gym_agents.paper.experiments.definitions import Run
from endless_gym_agents.paper.experiments.planning import Job
from endless_gym_agents.settings import PAPER_STEPS_PER_UPDATE, paper_run_length
from endless_gym_agents.training.logs import read_progress, update_seconds

#: A row of a table: text or numbers by column; missing columns stay empty.
Row = dict[str, str | float]


def write(jobs: Sequence[Job], folder: Path, scale: float) -> Path:
    """Write the report of an experiment from its finished jobs.

    Args:
        jobs: All jobs of the experiment.
        folder: Folder of the report; created if it does not exist.
        scale: Scale of the jobs.

    Returns:
        Path of the report, Markdown.
    """
    folder.mkdir(parents=True, exist_ok=True)
    experiment, done = jobs[0].experiment, [job for job in jobs if job.state() == "done"]
    pages = {
        "curves": _curves,
        "ablation": _ablation,
        "wall-time": _wall_time,
        "simulation-speed": _speed,
        "search": _search,
    }
    rows, figures = pages[experiment.kind](done, folder)
    text = [f"# {experiment.title}", "", f"Section {experiment.section} of the paper. {experiment.about}", ""]
    text += [f"{len(done)} of {len(jobs)} runs are done."]
    if scale != 1:
        small = f"a version at scale {scale:g}, and not the experiment of the paper: fewer updates, environments, steps and seeds"
        text += ["", f"This is {small}. Do not compare its numbers with the published ones."]
    if experiment.kind == "curves":
        protocol = experiment.evaluation
        episodes = "one episode" if protocol.repetitions == 1 else f"{protocol.repetitions} episodes"
        text += ["", f"Evaluation: {protocol.seeds} seeds from 200,000 on, {episodes} each."]
        text += [
            "Mean and standard deviation are over the runs; best is the highest mean over the runs at any checkpoint."
        ]
    if rows:
        text += ["", *_table(rows, folder / "table.csv")]
    for figure in figures:
        text += ["", f"![{figure.stem}]({figure.name})"]
    page = folder / "README.md"
    atomic.write(page, "\n".join(text) + "\n")
    return page


def _table(rows: Sequence[Row], file: Path) -> list[str]:
    """Write a table as CSV, and return its lines in Markdown."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    atomic.write(file, tables.csv_text(columns, ([row.get(name, "") for name in columns] for row in rows)))

    def cell(value: str | float) -> str:
        if isinstance(value, str):
            return value
        return f"{value:,}" if isinstance(value, int) else f"{value:,.3f}" if abs(value) < 1000 else f"{value:,.0f}"

    numbers = {name: all(not isinstance(row.get(name, 0), str) for row in rows) for name in columns}
    return tables.markdown(numbers, ([cell(row.get(name, "")) for name in columns] for row in rows))


def _by_run(jobs: Sequence[Job]) -> list[tuple[Run, list[Job]]]:
    """The runs in their order, with their jobs."""
    runs = jobs[0].experiment.runs if jobs else ()
    return [(run, own) for run in runs if (own := [job for job in jobs if job.run is run])]


def _beside(run: Run, own: Mapping[str, float]) -> Row:
    """A row with our numbers and the published ones."""
    row: Row = {"environment": run.env, "run": run.name}
    for name in dict.fromkeys([*own, *run.values]):
        if name in own:
            row[name] = own[name]
        if name in run.values:
            row[f"{name} (paper)"] = float(run.values[name])
    return row


def _curves(jobs: Sequence[Job], folder: Path) -> tuple[list[Row], list[Path]]:
    rows: list[Row] = []
    panels: dict[str, tuple[str, list[Curve], list[str]]] = {}
    for run, own in _by_run(jobs):
        merged = results.Experiment(run.env, run.name)
        for job in own:
            (one,) = results.read(job.folder / planning.EVALUATION)
            merged.runs += one.runs
        curve = evaluated(merged)
        options = run.flags.get("environment.option", [])
        task = " ".join([run.env, *(options if isinstance(options, list) else [])])
        _, curves, labels = panels.setdefault(task, (run.env, [], []))
        curves.append(curve)
        labels += [run.published] if run.published else []
        rows.append(_row(task, run, curve))
    figures = []
    for task, (env, curves, labels) in panels.items():
        _, axis = results.metric(env)
        name = task.replace(" ", "-").replace("=", "-")
        figures.append(draw(name, axis, [*curves, *published(env, labels)], "std", folder))
        if curves[0].steps[-1] < 0.1 * max((one.steps[-1] for one in published(env, labels)), default=0):
            # Next to the published curves, ours would be a dot.
            figures.append(draw(f"{name}-ours", axis, curves, "std", folder))
    if jobs and jobs[0].experiment.aggregate:
        family = jobs[0].experiment.aggregate
        labels = list(dict.fromkeys(run.published for run in jobs[0].experiment.runs))
        paper = [curve for env in FAMILIES[family] for curve in published(env, labels)]
        own_curves = [curve for _, curves, _ in panels.values() for curve in curves]
        ours = [one for one in aggregate(family, own_curves) if one.source == "evaluated"]
        figures.append(draw(family, AXES[family], [*ours, *aggregate(family, paper)], "std", folder))
    return rows, figures


def _row(task: str, run: Run, curve: Curve) -> Row:
    """The scores of a run at its last and at its best checkpoint."""
    name, _ = results.metric(run.env)
    row: Row = {"environment": task, "run": run.name, "metric": name}
    found = [("", curve)] + [(" (paper)", one) for one in published(run.env, [run.published])]
    for suffix, one in found:
        means = one.scores.mean(0)
        row[f"last{suffix}"], row[f"std{suffix}"] = float(means[-1]), float(one.scores[:, -1].std())
        row[f"best{suffix}"] = float(means.max())
        row[f"steps{suffix}"], row[f"runs{suffix}"] = int(one.steps[-1]), len(one.scores)
    return row


def _column(job: Job, name: str) -> list[float]:
    """A metric of each update of a run; NaN where it has none yet."""
    rows = read_progress(job.folder)
    return [float("nan") if row.get(name) is None else float(row[name]) for row in rows]


def ablation_numbers(success: Sequence[Sequence[float]], gradients: Sequence[Sequence[float]]) -> dict[str, float]:
    """The numbers of the paper's ablation table.

    Args:
        success: Success of the last 100 training episodes, by run and update; NaN before the first episode has ended.
        gradients: Gradient norm, by run and update.

    Returns:
        Mean and standard deviation of the success over the runs at the update with the highest mean, that update as a share of
        the run, and mean and standard deviation of the gradient norm over all runs and the updates until then.
    """
    length = min(map(len, success))
    table = np.array([one[:length] for one in success])
    known = np.isfinite(table).all(0)
    best = int(np.where(known, table.mean(0), -1.0).argmax()) if known.any() else length - 1
    norms = np.array([one[: best + 1] for one in gradients])
    return {
        "success_mean": float(table[:, best].mean()),
        "success_std": float(table[:, best].std()),
        "duration": (best + 1) / length,
        "gradient_norm_mean": float(norms.mean()),
        "gradient_norm_std": float(norms.std()),
    }


def _ablation(jobs: Sequence[Job], folder: Path) -> tuple[list[Row], list[Path]]:
    rows, curves = [], []
    for run, own in _by_run(jobs):
        success = [_column(job, "episode/success") for job in own]
        rows.append(_beside(run, ablation_numbers(success, [_column(job, "gradient_norm") for job in own])))
        length = min(map(len, success))
        steps = np.array(_column(own[0], "steps")[:length]).astype(np.int64)
        scores = np.nan_to_num(np.array([one[:length] for one in success]))
        curves.append(Curve(run.env, run.name, "training", steps, scores))
    rows.sort(key=lambda row: -float(row["success_mean"]))
    return rows, [draw("success", "Success of training episodes", curves, "std", folder)] if curves else []


def _wall_time(jobs: Sequence[Job], folder: Path) -> tuple[list[Row], list[Path]]:
    rows = []
    panels: dict[str, list[Curve]] = {}
    for run, own in _by_run(jobs):
        updates = [update_seconds(read_progress(job.folder)) for job in own]
        # The first update includes compilation and the start of the environments.
        seconds = np.array([value for one in updates for value in (one[1:] or one)])
        whole = paper_run_length(run.env, run.settings().agent)
        numbers = {"mean": seconds.mean(), "std": seconds.std(), "min": seconds.min(), "max": seconds.max()}
        numbers |= {"median": float(np.median(seconds)), "iqm": interquartile_mean(seconds)}
        numbers["hours"] = seconds.mean() * whole / 3600
        rows.append(_beside(run, {name: float(number) for name, number in numbers.items()}))
        for curve in published(run.env, [run.published]):
            # The published scores over the paper's training time and over ours.
            times = {curve.label: run.values["mean"]} if "mean" in run.values else {}
            times[f"{curve.label} in our time"] = float(seconds.mean())
            for label, mean in times.items():
                at = np.rint(curve.steps / PAPER_STEPS_PER_UPDATE * mean).astype(np.int64)
                panels.setdefault(run.env, []).append(replace(curve, label=label, steps=at))
    return rows, [
        draw(f"{env}-wall-time", results.metric(env)[1], curves, "std", folder, HOURS) for env, curves in panels.items()
    ]


def _speed(jobs: Sequence[Job], folder: Path) -> tuple[list[Row], list[Path]]:
    rows = []
    for run, (job, *_) in _by_run(jobs):
        measured = json.loads(regular.text(job.folder / planning.SPEED))
        rows.append(_beside(run, {"mean": measured["mean"], "std": measured["std"]}))
    return rows, []


def _search(jobs: Sequence[Job], folder: Path) -> tuple[list[Row], list[Path]]:
    rows: list[Row] = []
    for run, (job, *_) in _by_run(jobs):
        if not (job.folder / "best.json").exists():
            rows.append({"environment": run.env, "run": run.name, "best choices": "no trial complete"})
            continue
        best: dict[str, Any] = json.loads(regular.text(job.folder / "best.json"))
        states = [trial["state"] for trial in best["trials"]]
        (chosen,) = [trial["choices"] for trial in best["trials"] if trial["trial"] == best["trial"]]
        rows.append(
            {
                "environment": run.env,
                "run": run.name,
                "trials complete": states.count("COMPLETE"),
                "trials pruned": states.count("PRUNED"),
                "best reward": float(best["reward"]),
                "best choices": ", ".join(f"{name} {choice}" for name, choice in chosen.items()),
            }
        )
    return rows, []
