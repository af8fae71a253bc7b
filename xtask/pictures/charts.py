"""Charts of measured results, each in one variant for light and one for dark pages."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullLocator
from matplotlib.transforms import blended_transform_factory

from endless_gym_agents.common.palette import AGENTS as AGENT_COLOURS

matplotlib.use("svg")


class Theme(NamedTuple):
    """Colours of a chart on a light or dark page."""

    text: str
    faint: str
    grid: str
    blue: str
    grey: str
    agents: dict[str, str]


def agents(page: int) -> dict[str, str]:
    """The colour of each agent on a light (0) or dark (1) page."""
    return {name: colours[page] for name, colours in AGENT_COLOURS.items()}


THEMES = {
    "light": Theme("#1f2733", "#66707f", "#dfe3e8", "#2d5ea8", "#7b8696", agents(0)),
    "dark": Theme("#d6dce8", "#8d97a6", "#2b323d", "#6ea4f2", "#8b96a5", agents(1)),
}

#: Width of a chart in inches at 96 pixels each, and its font sizes in points.
WIDTH, TITLE, BODY, SMALL = 8.6, 11.5, 9.5, 8.5
#: Left margin as a share of the width, and the space between two groups as a share of a row.
LEFT, SPACE = 0.012, 0.4

#: Rows of the comparison by group: the start of the name in `benches/comparison.md`, and its label.
GROUPS = {
    "Memory Gym": {
        "original, gymnasium.make": "one environment",
        "original, SyncVectorEnv": "SyncVectorEnv",
        "original, AsyncVectorEnv": "AsyncVectorEnv",
        "original, SubprocVecEnv": "SubprocVecEnv of SB3",
    },
    "Endless Gym": {
        "gymnasium.make": "one environment",
        "serve, 64 environments": "64, in shared memory",
        "make_vec, 64 environments": "64, in process",
        "serve, 1024 environments": "1,024, in shared memory",
        "make_vec, 1024 environments": "1,024, in process",
    },
}


def chart(folder: Path, name: str, height: float, draw: Callable[[Figure, Theme], None]) -> None:
    """Write both variants of a chart as SVG, without a date, so that the same data gives the same files."""
    for variant, theme in THEMES.items():
        settings = {
            "svg.hashsalt": name,
            "font.size": BODY,
            "text.color": theme.text,
            "axes.labelcolor": theme.faint,
            "axes.titlesize": TITLE,
            "xtick.color": theme.faint,
            "ytick.color": theme.text,
            "axes.edgecolor": theme.grid,
            "grid.color": theme.grid,
        }
        with matplotlib.rc_context(settings):
            figure = pyplot.figure(figsize=(WIDTH, height), dpi=96)
            draw(figure, theme)
            metadata = {"Date": None, "Creator": None}
            figure.savefig(folder / f"{name}-{variant}.svg", transparent=True, metadata=metadata)
            pyplot.close(figure)


def header(figure: Figure, theme: Theme, title: str, note: str) -> None:
    """Write the title of a chart and a note below it."""
    height = figure.get_figheight()
    figure.text(LEFT, 1 - 0.2 / height, title, fontsize=TITLE, weight="bold", va="center")
    figure.text(LEFT, 1 - 0.44 / height, note, fontsize=SMALL, color=theme.faint, va="center")


def plain(axes: Axes) -> None:
    """Remove the frame and the tick marks, and draw the grid behind the data."""
    for side in axes.spines.values():
        side.set_visible(False)
    axes.tick_params(length=0, labelsize=SMALL)
    axes.set_axisbelow(True)


def measured(report: str) -> Iterator[tuple[str, float]]:
    """Contender and number of each row in the Markdown tables of `benches/comparison.py`."""
    for line in report.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        number = cells[1].replace(",", "") if line.startswith("| ") and len(cells) > 1 else ""
        if number.replace(".", "", 1).isdigit():
            yield cells[0], float(number)


def short(speed: float) -> tuple[str, str]:
    """A number of steps per second with at least two digits, and its unit."""
    size, unit = (1e6, "M") if speed >= 1e6 else (1e3, "k")
    return f"{speed / size:.{1 if speed < 10 * size else 0}f}", unit


def spread(low: float, high: float) -> str:
    """The range of several measurements, such as `2.6 to 4.5 k` or `716 k to 1.2 M`."""
    (first, unit), (last, last_unit) = short(low), short(high)
    if (first, unit) == (last, last_unit):
        return f"{last} {last_unit}"
    return f"{first} to {last} {unit}" if unit == last_unit else f"{first} {unit} to {last} {last_unit}"


def comparison(folder: Path, report: Path) -> None:
    """Steps per second compared with the original."""
    found = list(measured(report.read_text()))

    def speeds(contender: str) -> list[float]:
        """One number for each environment. A name may continue with their number."""
        return [speed for name, speed in found if name.startswith(contender)]

    groups = {
        group: {what: speeds(contender) for contender, what in rows.items() if speeds(contender)}
        for group, rows in GROUPS.items()
    }
    if not groups["Memory Gym"] or not groups["Endless Gym"]:
        raise ValueError(f"{report} has no table of benches/comparison.py")
    lines = sum(len(rows) for rows in groups.values()) + len(groups) * (1 + SPACE)
    cores = report.read_text().partition("- cores: ")[2].split()[0]

    def draw(figure: Figure, theme: Theme) -> None:
        axes = figure.add_axes((0.225, 0.075, 0.675, 0.77))
        plain(axes)
        axes.set(xscale="log", xlim=(1.4e3, 6e6), ylim=(lines - SPACE - 0.4, -0.6))
        axes.set_xticks([1e4, 1e5, 1e6])
        axes.xaxis.set_major_formatter(FuncFormatter(lambda speed, _: f"{speed:,.0f}"))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_yticks([])
        axes.grid(axis="x", lw=1)
        left = blended_transform_factory(figure.transFigure, axes.transData)
        place = 0.0
        for group, rows in groups.items():
            colour = theme.blue if group == "Endless Gym" else theme.grey
            axes.text(LEFT, place, group, transform=left, va="center", weight="bold")
            for what, values in rows.items():
                place += 1
                low, high = min(values), max(values)
                axes.text(LEFT, place, what, transform=left, va="center")
                axes.plot([low, high], [place, place], color=colour, lw=5, alpha=0.35, solid_capstyle="round")
                axes.plot(values, [place] * len(values), "o", color=colour, ms=6.5, mec="none")
                style = {"textcoords": "offset points", "va": "center", "fontsize": SMALL, "color": colour}
                axes.annotate(spread(low, high), (high, place), (9, 0), **style)
            place += 1 + SPACE
        note = "Logarithmic. A dot for each of the three endless environments; 64 or 1,024 of one are stepped at once."
        header(figure, theme, f"Steps per second on {cores} cores", note)

    chart(folder, "steps-per-second", 3.4, draw)


def hour(folder: Path) -> None:
    """Curves of the runs of `agents/benches/hour.py`, from the files in its folder and into it."""
    environments: dict[str, list[dict[str, Any]]] = {}
    for file in sorted(folder.glob("*.json")):
        data = json.loads(file.read_text())
        environments.setdefault(data["env"], []).append(data)

    def draw(figure: Figure, theme: Theme) -> None:
        height = figure.get_figheight()
        for place, agent in enumerate(("gru", "mingru", "trxl")):
            style = {"fontsize": SMALL, "weight": "bold", "color": theme.agents[agent], "ha": "right"}
            figure.text(0.985 - place * 0.07, 1 - 0.2 / height, agent, **style)
        panels = figure.subplots(-(-len(environments) // 2), 2, squeeze=False).flat
        for axes, (env, own) in zip(panels, environments.items(), strict=False):
            plain(axes)
            axes.set_title(f"{env}, {own[0]['metric'].replace('_', ' ')}", loc="left", fontsize=BODY)
            axes.tick_params(colors=theme.faint)
            axes.grid(axis="y", lw=1)
            for agent, score in own[0]["paper"].items():
                axes.axhline(score, color=theme.agents[agent], lw=0.8, ls="--")
            for agent, run in ((data["agent"], run) for data in own for run in data["runs"]):
                minutes, _, values = np.array(run["curve"]).T
                axes.plot(minutes, values, color=theme.agents[agent], lw=1.2)
            axes.set(xlim=(0, None), ylim=(0, None))
        figure.subplots_adjust(0.06, 0.3 / height, 0.985, 1 - 0.95 / height, wspace=0.13, hspace=0.5)
        note = "Evaluation over minutes of training on one core; dashed: the end of the paper's training, from frames."
        header(figure, theme, "An hour on one core", note)

    chart(folder, "hour", 1.9 * -(-len(environments) // 2) + 0.9, draw)
