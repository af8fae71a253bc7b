"""The SLURM templates of the documentation: bash, options of `sbatch`, and the commands that they start."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "docs" / "operate"
TEMPLATES = sorted(FOLDER.glob("slurm-*.sh"))
#: The options of `sbatch` that the templates use, from its manual page, and the values that it allows.
SBATCH = {
    "array": r"\d+-\d+",
    "cpus-per-task": r"\d+",
    "gpus": r"\d+",
    "gpus-per-node": r"\d+",
    "job-name": r"\w+",
    "nodes": r"\d+",
    "ntasks": r"\d+",
    "ntasks-per-node": r"\d+",
    "open-mode": r"append|truncate",
    # %x name, %j number of the job, %A number of the array, %a number in the array.
    "output": r"(?:%[xjAa]|[\w.-])+",
    "requeue": None,
    "signal": r"INT@\d+",
    "time": r"\d+:\d\d:\d\d",
}
#: Those of `srun`.
SRUN = {"cpus-per-task": r"\d+"}


def options(template: Path) -> dict[str, str | None]:
    """The options of the lines with `#SBATCH`, by name."""
    found = {}
    for line in template.read_text().splitlines():
        if line.startswith("#SBATCH"):
            for word in shlex.split(line.removeprefix("#SBATCH")):
                name, equals, value = word.removeprefix("--").partition("=")
                assert word.startswith("--"), word
                assert name not in found, name
                found[name] = value if equals else None
    return found


def check(name: str, value: str | None, known: dict[str, str | None]) -> None:
    assert name in known, f"--{name} is not in the table of options"
    pattern = known[name]
    assert value is None if pattern is None else value is not None and re.fullmatch(pattern, value), f"--{name}={value}"


def test_there_are_templates() -> None:
    assert [template.name for template in TEMPLATES] == ["slurm-node.sh", "slurm-seeds.sh", "slurm-torchrun.sh"]
    page = (FOLDER / "clusters.md").read_text()
    for template in TEMPLATES:
        assert f'--8<-- "docs/operate/{template.name}"' in page


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.name)
def test_sbatch_knows_the_options(template: Path) -> None:
    given = options(template)
    for name, value in given.items():
        check(name, value, SBATCH)
    assert {"job-name", "output", "time", "cpus-per-task"} <= given.keys()
    # After the first command, sbatch ignores the lines.
    lines = template.read_text().splitlines()
    assert lines[0] == "#!/bin/bash"
    last = max(number for number, line in enumerate(lines) if line.startswith("#SBATCH"))
    assert all(line.startswith("#") for line in lines[: last + 1])


@pytest.mark.parametrize("template", TEMPLATES, ids=lambda template: template.name)
def test_bash_reads_it(template: Path) -> None:
    checked = subprocess.run(["bash", "-n", template], capture_output=True, text=True)
    assert (checked.returncode, checked.stderr) == (0, "")


def started(template: Path, folder: Path, **variables: str) -> list[list[str]]:
    """The commands that the template starts, each with its arguments; `srun` runs them here."""
    stubs = folder / "stubs"
    stubs.mkdir(exist_ok=True)
    log = folder / "log"
    log.unlink(missing_ok=True)
    record = f'printf "%s\\0" "$(basename "$0")" "$@" >> "{log}"; printf "\\n" >> "{log}"'
    srun = f'{record}\nwhile [[ $1 == --* ]]; do shift; done\nexec "$@"'
    scripts = {
        "srun": srun,
        "endless-train": record,
        "torchrun": record,
        # "node7,node9" of the tests, one a line.
        "scontrol": '[[ "$1 $2" == "show hostnames" ]] && tr , "\\n" <<< "$3"',
    }
    for name, script in scripts.items():
        (stubs / name).write_text(f"#!/bin/bash\n{script}\n")
        (stubs / name).chmod(0o755)
    given = {f"SLURM_{name}": value for name, value in variables.items()}
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SLURM_")}
    environment = kept | {"PATH": f"{stubs}:{os.environ['PATH']}"} | given
    # A variable that is not set is an error.
    done = subprocess.run(["bash", "-eu", template], cwd=folder, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    commands = [line.split("\0")[:-1] for line in log.read_text().splitlines()]
    (_, *arguments), *others = commands
    assert commands[0][0] == "srun"
    while arguments[0].startswith("--"):
        name, _, value = arguments.pop(0)[2:].partition("=")
        check(name, value, SRUN)
    assert [arguments] == others
    return others


def test_the_array_starts_a_run_for_each_seed(tmp_path: Path) -> None:
    from endless_gym_agents.train import parse

    template = FOLDER / "slurm-seeds.sh"
    first, last = map(int, options(template)["array"].split("-"))
    folders = set()
    for task in range(first, last + 1):
        numbers = {"ARRAY_TASK_ID": str(task), "JOB_ID": str(700 + task), "CPUS_PER_TASK": "16"}
        ((program, *arguments),) = started(template, tmp_path, **numbers)
        settings = parse(arguments).validated()
        assert (program, settings.seed, settings.agent) == ("endless-train", task, "gru")
        folders.add(settings.run)
        # The job again, after a checkpoint.
        checkpoint = tmp_path / settings.run / "checkpoints" / "last.pt"
        checkpoint.parent.mkdir(parents=True)
        checkpoint.touch()
        assert started(template, tmp_path, **numbers) == [["endless-train", "--resume", settings.run]]
    assert folders == {f"runs/mortar-{seed}" for seed in (1, 2, 3, 4, 5)}


def test_torchrun_starts_a_rank_for_each_gpu(tmp_path: Path) -> None:
    from torch.distributed.run import get_args_parser

    from endless_gym_agents.train import parse

    template = FOLDER / "slurm-torchrun.sh"
    given = options(template)
    numbers = {"JOB_ID": "1234567", "JOB_NODELIST": "node7,node9", "NNODES": given["nodes"], "CPUS_PER_TASK": "64"}
    ((program, *arguments),) = started(template, tmp_path, **numbers)
    assert program == "torchrun"
    launch = get_args_parser().parse_args(arguments)
    assert (launch.nnodes, launch.nproc_per_node, given["ntasks-per-node"]) == ("2", given["gpus-per-node"], "1")
    assert (launch.rdzv_backend, launch.rdzv_endpoint, launch.rdzv_id) == ("c10d", "node7:24567", "1234567")
    assert (launch.module, launch.training_script) == (True, "endless_gym_agents.train")
    # Some versions of Python remove the first `--`.
    settings = parse([each for each in launch.training_script_args if each != "--"]).validated()
    ranks = int(given["nodes"]) * int(given["gpus-per-node"])
    assert settings.environment.num_envs % (settings.environment.groups * ranks) == 0
    # A run that torchrun starts again finds its checkpoint by the folder.
    assert settings.run


def test_one_node_has_an_engine_of_its_own(tmp_path: Path) -> None:
    from endless_gym_agents.train import parse

    ((program, *arguments),) = started(FOLDER / "slurm-node.sh", tmp_path, JOB_ID="12", CPUS_PER_TASK="16")
    settings = parse(arguments).validated()
    assert (program, settings.environment.engine) == ("endless-train", "process")


@pytest.mark.parametrize("line", ["--gpu=1", "--time=24h", "--requeue=yes", "--array"])
def test_a_wrong_option_is_found(tmp_path: Path, line: str) -> None:
    (template := tmp_path / "template.sh").write_text(f"#!/bin/bash\n#SBATCH {line}\n")
    ((name, value),) = options(template).items()
    with pytest.raises(AssertionError):
        check(name, value, SBATCH)
