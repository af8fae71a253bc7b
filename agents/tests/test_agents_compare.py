"""`endless-compare`: what it reads, refuses, writes and claims."""

import csv
import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from endless_gym_agents.evaluation import compare, ruler
from endless_gym_agents.evaluation.compare import Comparison, Score
from endless_gym_agents.evaluation.plot import PlotArguments, draw_all
from endless_gym_agents.evaluation.results import Experiment, Run, to_json

GRID = "MortarMayhem-Grid-v0"


def scores(agent: str, task: str, values: list[float], steps: int = 100) -> list[Score]:
    return [Score(agent, task, seed, value, steps, f"{agent}-{seed}") for seed, value in enumerate(values, 1)]


def evaluated(file: Path, label: str, option: int, rewards: list[float], steps: int = 64, **protocol: Any) -> Path:
    """A file as `endless-eval --json` writes it."""
    runs = []
    for seed, reward in enumerate(rewards, 1):
        runs.append(Run(f"runs/{label}-{seed}", seed))
        for at, value in ((32, 0.0), (steps, reward)):
            runs[-1].add(at, [{"reward": value, "task_progress": value / 2}])
    experiment = Experiment(GRID, label, {"command_count": [option]}, runs)
    file.write_text(json.dumps(to_json([experiment], {"seeds": 2} | protocol)))
    return file


def test_scores_are_normalised_by_none_and_the_expert(tmp_path: Path) -> None:
    files = [
        evaluated(tmp_path / "none.json", "ppo", 2, [0.01, 0.03]),
        evaluated(tmp_path / "gru.json", "gru", 2, [0.2, 0.11]),
    ]
    rows, experts = compare.read_scores([tmp_path])
    assert {(row.agent, row.task, row.steps) for row in rows} == {
        (name, "two-commands", 64) for name in ("none", "gru")
    }
    comparison = Comparison(rows, compare.ranges_of(rows, experts))
    assert comparison.ranges == {"two-commands": (pytest.approx(0.02), ruler.TASKS["two-commands"].expert)}
    assert comparison.table("gru") == pytest.approx(np.array([[1.0], [0.5]]))
    assert comparison.aggregates["gru"].iqm.value == pytest.approx(0.75)
    assert comparison.aggregates["gru"].gap.value == pytest.approx(0.25)
    assert comparison.aggregates["gru"].profile[25].value == 0.5  # of the scores above one half
    # The same files again, by name, add nothing.
    assert compare.read_scores([tmp_path, *files])[0] == rows


def test_a_task_outside_of_the_ruler_has_the_environments_expert_or_given_scores(tmp_path: Path) -> None:
    evaluated(tmp_path / "a.json", "gru", 4, [0.1, 0.2])
    rows, experts = compare.read_scores([tmp_path])
    task = f"{GRID} command_count=[4]"
    assert experts == {task: pytest.approx(0.4)}
    with pytest.raises(
        ValueError, match=r"lacks runs of `none`: --range 'MortarMayhem-Grid-v0 command_count=\[4\]=ZERO,ONE'"
    ):
        compare.ranges_of(rows, experts)
    assert compare.ranges_of(rows, experts, [f"{task}=0.1,0.3"]) == {task: (0.1, 0.3)}
    file = tmp_path / "ranges.json"
    file.write_text(json.dumps({task: [0, 0.5]}))
    assert compare.ranges_of(rows, experts, [str(file)]) == {task: (0.0, 0.5)}
    for given, message in (
        ("other=0,1", "--range: no runs of task `other`; there are runs of MortarMayhem"),
        (f"{task}=0", r"must have two numbers, got \[0.0\]"),
        (f"{task}=a,b", "--range must be TASK=ZERO,ONE with two numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            compare.ranges_of(rows, experts, [given])
    # Runs without the metric, and one whose range is not known.
    with pytest.raises(ValueError, match=r"--metric must be one of reward, task_progress in .*, got `success`"):
        compare.read_scores([tmp_path / "a.json"], "success")


def test_unequal_budgets_are_refused_by_name() -> None:
    rows = scores("none", "a", [0, 0]) + scores("gru", "a", [1, 1]) + scores("lru", "a", [1, 1], steps=2000)
    message = "unequal budgets in a: 100 steps of none, gru; 2,000 steps of lru; train all for as long"
    with pytest.raises(ValueError, match=message):
        Comparison(rows, {"a": (0, 1)})
    # Tasks may differ in length.
    assert Comparison(rows[:4] + scores("gru", "b", [1, 1], steps=9), {"a": (0, 1), "b": (0, 1)}).steps == {
        "a": 100,
        "b": 9,
    }


def test_runs_that_differ_in_their_evaluation_or_not_at_all_are_refused(tmp_path: Path) -> None:
    evaluated(tmp_path / "a.json", "gru", 2, [0.1])
    other = tmp_path / "other"
    other.mkdir()
    evaluated(other / "b.json", "gru", 2, [0.2], greedy=True)
    with pytest.raises(ValueError, match=r"the runs were evaluated differently, .*a\.json: .*b\.json: .*greedy"):
        compare.read_scores([tmp_path, other])
    evaluated(other / "b.json", "gru", 2, [0.2])
    with pytest.raises(ValueError, match="two runs of gru in two-commands have the seed 1: runs/gru-1 and runs/gru-1"):
        Comparison(compare.read_scores([tmp_path, other])[0], {"two-commands": (0, 1)})


def test_only_intervals_that_exclude_one_half_are_claims() -> None:
    generator = np.random.default_rng(1)
    tasks, ranges = ("a", "b", "c"), dict.fromkeys(("a", "b", "c"), (0.0, 1.0))
    means = {"better": 0.9, "worse": 0.2, "same": 0.2}
    rows = [
        row
        for agent, mean in means.items()
        for task in tasks
        for row in scores(agent, task, [float(value) for value in mean + 0.05 * generator.normal(size=3)])
    ]
    comparison = Comparison(rows, ranges)
    (claim,) = comparison.claims()
    interval = re.escape("1.00 [0.73, 1.00] (3 and 3 seeds)")
    assert re.fullmatch(
        f"`better` is better than `(worse|same)` with {interval}, `(worse|same)` with {interval}.", claim
    ), claim
    (equal,) = [pair.probability for pair in comparison.pairs if "better" not in (pair.first, pair.second)]
    assert equal.low is not None and equal.low < 0.5 < (equal.high or 0)
    # Three seeds of one task can be in order by chance: of 20 orders, two separate the agents.
    alone = Comparison([row for row in rows if row.task == "a"], ranges)
    assert [pair.probability.value for pair in alone.pairs if pair.first == "better"] == [1.0, 1.0]
    assert not alone.claims()
    assert "do not show that an agent is better" in "\n".join(compare.markdown(alone))
    # One seed has no interval.
    single = Comparison([row for row in rows if row.seed == 1], ranges)
    assert str(single.aggregates["better"].iqm) == f"{single.aggregates['better'].iqm.value:.2f}"
    assert single.note().startswith("One seed: there are no intervals") and not single.claims()


def test_an_agent_with_missing_runs_has_no_estimates() -> None:
    rows = scores("gru", "a", [1, 1]) + scores("gru", "b", [1, 1]) + scores("lru", "a", [1, 0])
    comparison = Comparison(rows, {"a": (0, 1), "b": (0, 1)})
    assert list(comparison.aggregates) == ["gru"] and comparison.agents() == ["gru", "lru"]
    assert compare.cells(comparison)[1][1][:6] == ["lru", "2", "incomplete", "", "0.50", ""]


def test_all_files_are_written(tmp_path: Path, call: Callable[..., int], capsys: Any) -> None:
    """Also with a name that LaTeX would not take."""
    for number, (label, value) in enumerate({"ppo": 0.0, "my_net_width=[1, 2]": 0.19, "gru": 0.1}.items()):
        evaluated(tmp_path / f"{number}.json", label, 2, [value, value + 0.01, round(value + 0.005, 3)])
    out = tmp_path / "out"
    assert call(compare.main, tmp_path, "--out", out, "--json", tmp_path / "numbers.json") == 0
    printed = capsys.readouterr().out
    assert all(
        part in printed for part in ("my_net_width=[1, 2]", "percentile bootstrap", f"{out / 'README.md'}, with")
    )
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["agents"]["gru"]["scores"] == {"two-commands": {"1": 0.1, "2": 0.11, "3": 0.105}}
    assert list(numbers["agents"]) == ["my_net_width=[1, 2]", "gru", "none"]
    # It is not taken for a file of results.
    assert len(compare.read_scores([tmp_path])[0]) == 9

    page = (out / "README.md").read_text()
    assert "64 steps; 0.005 becomes 0, and 0.2 becomes 1." in page
    assert "| `gru` | 0.51 | 0.105 | 0.1 | 0.11 | 0.105 |" in page
    with (out / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 9 and {row["steps"] for row in rows} == {"64"}
    with (out / "improvement.csv").open() as file:
        assert [row["probability"] for row in csv.DictReader(file)] == ["1.0"] * 3

    table = (out / "table.tex").read_text()
    assert re.findall(r"\\(?:top|mid|bottom)rule", table) == [r"\toprule", r"\midrule", r"\bottomrule"]
    opened, closed = (re.findall(rf"\\{kind}{{(\w+)}}", table) for kind in ("begin", "end"))
    assert opened == closed[::-1] == ["table", "tabular"]
    body = table.split(r"\toprule")[1]
    (columns,) = re.findall(r"\\begin{tabular}{(\w+)}", table)
    lines = [line for line in body.splitlines() if line.endswith(r"\\")]
    assert len(lines) == 4 and {line.count("&") for line in lines} == {len(columns) - 1}
    assert r"my\_net\_width=[1, 2]" in table
    assert table.count("{") == table.count("}") and not re.search(r"(?<!\\)[%#_](?! Needs)", table)

    assert (out / "comparison.pdf").read_bytes().startswith(b"%PDF-1.")
    assert ElementTree.parse(out / "comparison.svg").getroot().tag == "{http://www.w3.org/2000/svg}svg"
    # The same runs give the same bytes.
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    assert call(compare.main, tmp_path, "--out", out, "--json", "-") == 0
    assert json.loads(capsys.readouterr().out) == numbers
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def test_names_of_runs_and_their_costs_are_read(tmp_path: Path) -> None:
    """A run of `endless-reproduce` has its name, and rows of the leaderboard their size and cost."""
    folder = tmp_path / "runs" / GRID / "long" / "seed-1"
    folder.mkdir(parents=True)
    evaluated(folder / "evaluation.json", "gru", 2, [0.1])
    row = {"agent": "gru", "size": "small", "task": "two-commands", "seed": 1, "score": 0.2, "steps": 64}
    (tmp_path / "rows.json").write_text(
        json.dumps({"rows": [row | {"core_seconds": 120, "state_bytes": 512, "longer": None}]})
    )
    (found,), _ = compare.read_scores([tmp_path / "runs"])
    assert found.agent == "long"
    # A folder's own files come before those below it.
    (found,), _ = compare.read_scores([tmp_path])
    assert (found.agent, found.cost) == ("gru (small)", {"core_seconds": 120.0, "state_bytes": 512.0})
    page = compare.markdown(Comparison([found], {"two-commands": (0, 0.2)}))
    assert (
        "| agent | seeds | IQM [95 %] | optimality gap [95 %] | two-commands | core-seconds of a run | bytes of state |"
        in page
    )
    assert "| `gru (small)` | 1 | 1.00 | 0.00 | 1.00 | 120 | 512 |" in page


def test_all_tasks_of_the_results_count_in_an_aggregated_plot(tmp_path: Path) -> None:
    """Two tasks of one environment, of which one is not in the ruler."""
    files = tuple(
        evaluated(tmp_path / f"{label}-{option}.json", label, option, [value * option, value * option])
        for label, value in (("ppo", 0.02), ("gru", 0.06))
        for option in (2, 4)
    )
    arguments = PlotArguments(files, tmp_path / "out", aggregate="all", spread="runs")
    (picture,) = draw_all(arguments)
    curves = {curve["label"]: curve for curve in json.loads(picture.with_suffix(".json").read_text())["curves"]}
    assert curves["gru"]["steps"] == [32, 64]
    assert np.array(curves["gru"]["scores"]) == pytest.approx(np.array([[-0.25, 0.5]] * 4), abs=1e-2)
    assert np.array(curves["ppo"]["scores"])[:, 1] == pytest.approx(np.zeros(4))
    (picture,) = draw_all(replace(arguments, range=("two-commands=0,0.12",)))
    assert json.loads(picture.with_suffix(".json").read_text())["curves"][1]["scores"][0][1] == pytest.approx(1.0)
    with pytest.raises(
        ValueError, match=r"gru: the plot of all tasks needs evaluations in MortarMayhem.*count=\[4\], too"
    ):
        draw_all(replace(arguments, paths=files[:3]))
