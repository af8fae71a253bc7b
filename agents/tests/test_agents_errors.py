"""User errors print one line on standard error, exit with status 1, and leave no file."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from endless_gym_agents.evaluation import compare, enjoy, plot, probe, protocol, record
from endless_gym_agents.paper import leaderboard, reproduce, search
from endless_gym_agents.training import train

GRID = "--env MortarMayhem-Grid-v0"
NO_RAY = (
    r"--ray needs ray, which is not installed: pip install './agents\[ray\]', or the wheel file with `\[ray\]` appended"
)
PROGRAMS = {
    "endless-train": train.main,
    "endless-eval": protocol.main,
    "endless-enjoy": enjoy.main,
    "endless-plot": plot.main,
    "endless-probe": probe.main,
    "endless-record": record.main,
    "endless-search": search.main,
    "endless-reproduce": reproduce.main,
    "endless-compare": compare.main,
    "endless-leaderboard": leaderboard.main,
}


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("endless-train --env NoSuch-v0", "id must be one of .*, got 'NoSuch-v0'"),
        (f"endless-train {GRID} --device nonsense", "--device must be auto, cpu, cuda or cuda:INDEX, got `nonsense`"),
        (f"endless-train {GRID} --ppo.epochs 0", "--ppo.epochs must be 1 or more, got 0"),
        ("endless-train --resume nowhere", "no run in nowhere; expected a folder with settings.json"),
        (f"endless-train {GRID} --environment.option command_count=[1] colour=1", ".*colour"),
        (f"endless-train {GRID} --environment.option colour=1 --environment.engine process", ".*colour"),
        ("endless-train --resume foreign", "foreign/settings.json is not of this version of endless-train"),
        ("endless-eval", "no path given; expected checkpoint files"),
        ("endless-eval nowhere", "no such file or folder: nowhere; expected a checkpoint file"),
        ("endless-eval .", "no checkpoint in .; expected the folder of a run"),
        ("endless-eval text.pt", "text.pt is not a checkpoint, or is truncated: "),
        *(
            (f"endless-train {GRID} --{flag} {given}", f"--{flag} must be {allowed}, got {given}")
            for flag, given, allowed in (
                ("seed", "-1", "0 or more"),
                ("target-reward", "nan", "finite"),
                ("ppo.final-learning-rate", "inf", "0 or more"),
                ("ppo.clip-range", "0.0", "greater than 0"),
                ("ppo.gamma", "1.5", "0 to 1"),
                ("ppo.minibatches", "16385", "1 to 16384, the steps of an update"),
            )
        ),
        (
            f"endless-train {GRID} --agent trxl --ppo.steps 500 --transformer.sequence-length 64",
            "--ppo.steps must be a multiple of --transformer.sequence-length, got 500 steps and sequences of 64",
        ),
        ("endless-train --env mortarmayhem-grid-v0", "id must be .*; did you mean MortarMayhem-Grid-v0?"),
        ("endless-eval text.pt --seeds 0", "--seeds must be 1 or more, got 0"),
        ("endless-enjoy text.pt --seeds 1 -1", "--seeds must be 0 or more, got -1"),
        ("endless-probe text.pt --max-steps 0", "--max-steps must be 1 or more, got 0"),
        ("endless-record text.pt", "text.pt is not a checkpoint, or is truncated: "),
        ("endless-search --minutes -1", "--minutes must be 0 or more, got -1.0"),
        ("endless-plot --published gru nope", "--published must be among gru, .*, got `nope`"),
        ("endless-reproduce finite --seeds -1 --status", "--seeds must be 0 or more, got -1"),
        ("endless-eval text.pt --json none/results.json", "cannot write none/results.json: no folder none"),
        ("endless-enjoy nowhere", "no checkpoint nowhere"),
        ("endless-enjoy nowhere --seeds", "--seeds must contain at least one seed, got none"),
        ("endless-plot nowhere.json", "no such file or folder: nowhere.json"),
        ("endless-plot text.json", "text.json is not a file of `endless-eval --json`"),
        ("endless-plot .", "no progress.jsonl in .; expected the folder of a run"),
        ("endless-plot --env NoSuch-v0", "no curves of environment `NoSuch-v0`; the paper has curves of "),
        (
            "endless-plot one.json --aggregate finite",
            "gru: the finite plot needs evaluations in all of MortarMayhem-v0, ",
        ),
        ("endless-search --env NoSuch-v0", "id must be one of .*, got 'NoSuch-v0'"),
        ("endless-search --parameters ppo.gamma", "--parameters for gru must be among ppo.epochs, "),
        ("endless-search --percentile 0", "--percentile must be greater than 0 and at most 100, got 0.0"),
        ("endless-search --run mine", "--run and --resume are not supported: the search names its runs; use --folder"),
        ("endless-search --time-limit 3", "--time-limit and --target-reward are not supported: "),
        ("endless-search --ray", NO_RAY),
        ("endless-reproduce", "no experiment given; `endless-reproduce --list` lists them"),
        ("endless-reproduce nope", "experiment must be one of finite, .*; got `nope`"),
        ("endless-reproduce nope.json", "no such file: nope.json"),
        ("endless-reproduce finite --scale 2", "--scale must be greater than 0 and at most 1, or tiny; got `2`"),
        ("endless-reproduce finite --scale small", "--scale must be .* got `small`"),
        ("endless-reproduce finite --nice 20 --status", "--nice must be 0 to 19, got 20"),
        ("endless-reproduce endless --ray", NO_RAY),
        ("endless-compare", "no path given; expected files of `endless-eval --json`"),
        ("endless-compare nowhere", "no such file or folder: nowhere; expected results"),
        ("endless-compare text.json", "text.json is not a file of results"),
        ("endless-compare foreign", "no results in foreign; evaluate its runs with: endless-eval foreign --last"),
        ("endless-compare one.json", "--metric must be one of task_progress in one.json, got `reward`"),
        (
            "endless-compare one.json --metric task_progress",
            "MysteryPath-v0 .* lacks runs of `none` and an expert: --range",
        ),
        ("endless-compare one.json --metric task_progress --range a=1,2", "--range: no runs of task `a`; there are "),
        ("endless-leaderboard nope", "track must be one of ablations, full, million, or a JSON file; got `nope`"),
        ("endless-leaderboard nope.json", r"\[Errno 2\] No such file or directory: 'nope.json'"),
        ("endless-leaderboard text.json", "track text: `tasks` is unknown, missing or empty; allowed: about, tasks"),
        ("endless-leaderboard million --tasks nope", "--tasks must be among repeat-first-12, .*, got `nope`"),
        ("endless-leaderboard million --sizes tiny", "--sizes must be among gru, got `tiny`"),
    ],
)
def test_user_error_prints_one_line_and_leaves_no_file(
    command: str,
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    call: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "text.pt").write_text("not a checkpoint\n")
    (tmp_path / "text.json").write_text("{}")
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "settings.json").write_text('{"learning_rate": 1}')
    run = {"run": "a", "seed": 1, "steps": [10], "metrics": {"task_progress": [0.5]}}
    experiment = {"env": "MysteryPath-v0", "label": "gru", "options": {}, "runs": [run]}
    (tmp_path / "one.json").write_text(json.dumps({"experiments": [experiment]}))
    if "--ray" in command:
        monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.chdir(tmp_path)
    program, *arguments = command.split()
    assert call(PROGRAMS[program], *arguments) == 1
    error = capsys.readouterr().err
    assert re.match(f"{program}: {message}", error), error
    assert error.count("\n") == 1
    assert {file.name for file in tmp_path.rglob("*") if file.is_file()} == {
        "text.pt",
        "text.json",
        "one.json",
        "settings.json",
    }


def test_an_unknown_flag_suggests_the_nearest(call: Callable[..., int], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        call(train.main, "--ppo.num-epochs", 0)
    assert ended.value.code == 2
    error = capsys.readouterr().err
    assert re.search(r"Unrecognized options: --ppo\.num-epochs\b", error), error
    assert re.search(r"Perhaps you meant:.*--ppo\.epochs\b", error, re.DOTALL), error
