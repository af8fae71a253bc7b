"""The experiments of the paper as data: files, scales, plans, and runs that are stopped and resumed."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents_helpers import EXPERIMENT, changed

from endless_gym_agents.common import command
from endless_gym_agents.evaluation.curves import published
from endless_gym_agents.paper.experiments import definitions, planning, report
from endless_gym_agents.paper.reproduce import ReproduceArguments, execute
from endless_gym_agents.settings import to_dict
from endless_gym_agents.training.train import parse

NAMES = definitions.names()


def own(folder: Path, **changes: Any) -> Path:
    file = folder / "mine.json"
    file.write_text(json.dumps(EXPERIMENT | changes))
    return file


def log_of(job: planning.Job, updates: int, seconds: float) -> None:
    """Write a run's log with this many updates of this many seconds each."""
    job.folder.mkdir(parents=True)
    rows = [
        json.dumps({"update": 1 + n, "seconds/a": seconds / 4, "seconds/b": seconds * 3 / 4}) for n in range(updates)
    ]
    (job.folder / "progress.jsonl").write_text("\n".join(rows) + "\n")


@pytest.mark.parametrize("name", NAMES)
def test_flags_of_an_experiment_give_its_settings(name: str) -> None:
    """The command line of a run gives its settings, also at a small scale."""
    experiment = definitions.load(name)
    for one in (experiment, planning.scaled(experiment, planning.TINY)):
        run = one.runs[-1]
        given = parse(["--env", run.env, *command.flags(run.flags)])
        assert given.validated() == run.settings()
        if experiment.kind == "curves" and run.published:
            assert published(run.env, [run.published]), run
    assert all(run.settings().ppo.updates <= 2 for run in planning.scaled(experiment, planning.TINY).runs)


def test_runs_with_the_same_name_have_the_same_settings() -> None:
    known: dict[tuple[str, str], dict[str, Any]] = {}
    for name in NAMES:
        experiment = definitions.load(name)
        if experiment.kind == "simulation-speed":
            continue
        for run in experiment.runs:
            values = to_dict(run.settings())
            assert known.setdefault((run.env, run.name), values) == values, run
    lists = [(definitions.load(name).section, name) for name in NAMES]
    assert lists == sorted(lists)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sede": 1}, "experiment mine: unknown key `sede`; allowed: title, section, about, kind, seeds, runs, "),
        ({"kind": "curve"}, "experiment mine: `kind` must be one of curves, ablation, .*, got 'curve'"),
        ({"seeds": 0}, "experiment mine: `seeds` must be 1 or more, got 0"),
        ({"seeds": "5"}, "experiment mine: `seeds` must be int, got '5'"),
        ({"runs": []}, "experiment mine: `runs` must contain at least one run"),
        ({"aggregate": "both"}, "experiment mine: `aggregate` must be finite or endless, got 'both'"),
        ({"evaluation": {"seed": 3}}, "mine, `evaluation`: unknown key `seed`; allowed: interval, seeds, repetitions"),
        (
            {"runs": [{"name": "a"}]},
            "experiment mine, run 1: `env` is missing; allowed: name, env, flags, published, values",
        ),
        ({"runs": [{"name": "a", "env": "Nope-v0"}]}, "experiment mine, run 1: id must be one of "),
        (
            {"runs": [{"name": "a", "env": "MortarMayhem-v0", "flags": {"epochs": 3}}]},
            "unknown flag `epochs`; allowed: ",
        ),
        ({"runs": [{"name": "a", "env": "MortarMayhem-v0", "flags": {"run": "x"}}]}, "unknown flag `run`; allowed: "),
        (
            {"runs": [{"name": "a", "env": "MortarMayhem-v0", "flags": {"ppo.epochs": 0.5}}]},
            "flag `ppo.epochs` must be int, got 0.5",
        ),
        ({"runs": 2 * [{"name": "a", "env": "MortarMayhem-v0"}]}, "names of runs in an environment must differ"),
    ],
)
def test_mistakes_in_an_experiment_file_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        definitions.parse("mine", json.dumps(EXPERIMENT | changes))


def test_a_scale_makes_everything_smaller() -> None:
    full = definitions.load("finite")
    assert planning.scaled(full, 1) is full
    small = planning.scaled(full, 0.01)
    (before, after) = (one.runs[0].settings() for one in (full, small))
    assert (before.ppo.updates, before.ppo.steps, before.environment.num_envs) == (30_000, 512, 32)
    assert (after.ppo.updates, after.ppo.steps, after.environment.num_envs) == (300, 64, 3)
    assert (small.seeds, small.evaluation) == (1, definitions.Evaluation(5, 5, 1))
    assert after.recurrence == before.recurrence


def test_the_remaining_time_is_estimated_from_measured_updates(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two of six jobs have begun; the estimate for the others is the mean over the same agent, or over all.

    The updates of trxl have four times as many environment steps.
    """
    flags = {"ppo.updates": 10, "environment.num-envs": 8, "ppo.steps": 64}
    runs = [
        {"name": agent, "env": "MortarMayhem-v0", "flags": flags | {"agent": agent, "environment.num-envs": envs}}
        for agent, envs in (("gru", 8), ("lstm", 8), ("trxl", 32))
    ]
    file = own(tmp_path, runs=runs, seeds=2)
    given = ReproduceArguments((str(file),), status=True, out=tmp_path / "out", jobs=1)
    planned = planning.jobs_of(definitions.load(str(file)), tmp_path / "out", 1)
    assert [(job.run.name, job.seed) for job in planned] == [(a, s) for s in (1, 2) for a in ("gru", "lstm", "trxl")]
    execute(given)
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines[0] == "not started  MortarMayhem-v0 gru seed 1, update 0 of 10"
    assert not any("left" in line for line in lines)
    assert "time unknown before the first update" in last
    log_of(planned[0], 4, 2.0)
    log_of(planned[1], 5, 8.0)
    # gru: 6 and 10 updates of 2 s; lstm: 5 and 10 of 8 s; trxl: twice 10 of 20 s.
    assert planning.remaining_seconds(planned, 1) == pytest.approx(12 + 20 + 40 + 80 + 200 + 200)
    assert planning.remaining_seconds(planned, 2) == pytest.approx(552 / 2)
    # More machines do not shorten the longest job.
    assert planning.remaining_seconds(planned, 100) == pytest.approx(200)
    execute(given)
    *lines, last = capsys.readouterr().out.splitlines()
    assert lines[0].endswith("update 4 of 10, 12 seconds left")
    assert lines[2].endswith("update 0 of 10, 3.3 minutes left, estimated from other runs")
    assert "9 of 60 updates; the rest takes 9.2 minutes, and its evaluation" in last
    # One evaluation is measured; the five others are expected to take as long.
    (planned[1].folder / "evaluation.json").write_text('{"seconds": 12.0}')
    assert planning.remaining_seconds(planned, 1) == pytest.approx(552 + 5 * 12)
    assert planning.summary(planned, 1).endswith("9 of 60 updates; the rest takes 10.2 minutes")
    log_of(planned[2], 10, 2.0)
    execute(given)
    assert "MortarMayhem-v0 trxl seed 1, update 10 of 10, evaluation left\n" in capsys.readouterr().out


def test_a_run_with_other_settings_is_refused(tmp_path: Path) -> None:
    experiment = definitions.parse("mine", json.dumps(EXPERIMENT))
    (job,) = planning.jobs_of(experiment, tmp_path, 1)
    job.folder.mkdir(parents=True)
    given = job.run.settings()
    (job.folder / "settings.json").write_text(json.dumps(to_dict(given)))
    planning.check_folders([job])
    (job.folder / "settings.json").write_text(json.dumps(to_dict(changed(given, ppo={"gamma": 0.9}))))
    with pytest.raises(ValueError, match="has a run with another `ppo`"):
        planning.check_folders([job])


def test_dry_run_prints_the_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    execute(ReproduceArguments((str(own(tmp_path)),), dry_run=True, out=tmp_path / "out", jobs=1))
    train, test = capsys.readouterr().out.splitlines()
    assert "OMP_NUM_THREADS=1" in train
    assert " nice -n 19 endless-train --env MortarMayhem-Grid-v0 --preset quick " in train
    assert train.endswith("--checkpoint-interval 2 --keep-checkpoints")
    assert " endless-eval " in test
    assert not (tmp_path / "out").exists()


def test_ablation_table_takes_the_best_update() -> None:
    """The best update is that with the highest mean over the runs; updates before the first end of an episode do not count."""
    nan = float("nan")
    found = report.ablation_numbers([[nan, 0.2, 0.8, 0.1], [nan, 0.4, 0.4, 0.3]], [[1, 2, 3, 99], [1, 2, 3, 99]])
    assert found["success_mean"] == pytest.approx(0.6)
    assert found["success_std"] == pytest.approx(0.2)
    assert found["duration"] == 0.75
    assert found["gradient_norm_mean"] == 2
    assert found["gradient_norm_std"] == pytest.approx(np.std([1, 2, 3]))


def test_wall_time_draws_the_published_curves_over_both_times(tmp_path: Path) -> None:
    values = {"mean": 4.0}
    flags = {"agent": "gru", "ppo.updates": 3}
    runs = [{"name": "gru", "env": "MysteryPath-v0", "flags": flags, "published": "gru", "values": values}]
    experiment = definitions.parse("mine", json.dumps(EXPERIMENT | {"kind": "wall-time", "runs": runs}))
    (job,) = planning.jobs_of(experiment, tmp_path, 1)
    log_of(job, 3, 2.0)
    (row,), (figure,) = report._wall_time([job], tmp_path / "out")
    # The paper's run has 25,000 updates, and a checkpoint every 500.
    assert (row["mean"], row["mean (paper)"], row["hours"]) == (2.0, 4.0, pytest.approx(2 * 25_000 / 3600))
    theirs, ours = json.loads(figure.with_suffix(".json").read_text())["curves"]
    assert theirs["seconds"] == list(range(0, 25_001 * 4, 500 * 4))
    assert ours["seconds"] == list(range(0, 25_001 * 2, 500 * 2))
    assert theirs["scores"] == ours["scores"] == published("MysteryPath-v0", ["gru"])[0].scores.tolist()


def test_list_is_readable_and_json(capsys: pytest.CaptureFixture[str]) -> None:
    execute(ReproduceArguments(list=True))
    table = capsys.readouterr().out
    for name in NAMES:
        assert re.search(rf"^ *{name} .*\d+ x \d", table, re.MULTILINE), name
    execute(ReproduceArguments(list=True, json=True))
    listed = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in listed] == NAMES
    assert listed[NAMES.index("endless")]["runs"][0]["updates"] == 50_000


@pytest.mark.usefixtures("in_process")
@pytest.mark.parametrize("name", list({definitions.load(name).kind: name for name in NAMES}.values()))
def test_smallest_version_of_each_kind_of_experiment_runs(name: str, tmp_path: Path) -> None:
    """One run with one update, through evaluation and report."""
    file, experiment = tmp_path / f"{name}.json", definitions.load(name)
    given = json.loads((Path(definitions.__file__).parent / f"{name}.json").read_text())
    run = given["runs"][-1]
    given |= {"runs": [run], "aggregate": ""}
    file.write_text(json.dumps(given))
    execute(ReproduceArguments((str(file),), scale="tiny", out=tmp_path / "out", device="cpu", nice=0))
    page = (tmp_path / "out" / "scale-2e-05" / name / "README.md").read_text()
    assert page.startswith(f"# {experiment.title}\n")
    assert "1 of 1 runs are done." in page
    assert re.search(rf"^\| {run['env']}.* \| ", page, re.MULTILINE), page
    assert (tmp_path / "out" / "scale-2e-05" / name / "table.csv").exists()
    if experiment.kind in ("curves", "ablation"):
        assert list((tmp_path / "out" / "scale-2e-05" / name).glob("*.png"))
