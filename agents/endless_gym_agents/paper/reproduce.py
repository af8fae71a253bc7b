"""`endless-reproduce`: repeat the experiments of the paper, with figures and tables next to the published ones.

Each run is an `endless-train` process with its own folder; several experiments may share a run. Repeating the command skips
finished runs and resumes interrupted ones.

```console
endless-reproduce --list                       # the experiments
endless-reproduce endless --scale 0.01         # a small version
endless-reproduce endless --jobs 8             # the experiment, eight runs at a time
endless-reproduce endless --ray auto           # on the machines of a Ray cluster
```
"""

from __future__ import annotations

import json
import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from rich.table import Table

from endless_gym.program.printable import printable
from endless_gym_agents.common import command, tables
from endless_gym_agents.common.clock import duration
from endless_gym_agents.common.ranges import Natural, Positive, Range
from endless_gym_agents.paper import jobs, jobs_ray
from endless_gym_agents.paper.experiments import definitions, planning
from endless_gym_agents.paper.experiments.definitions import Experiment
from endless_gym_agents.paper.experiments.planning import Job
from endless_gym_agents.training import checkpoint


@dataclass(frozen=True)
class ReproduceArguments:
    """Arguments of `endless-reproduce`."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """experiments, as `--list` names them; `all` for all of them; or JSON files of your own"""
    list: bool = False
    """print the experiments, and run nothing"""
    json: bool = False
    """with `--list`: print JSON"""
    dry_run: bool = False
    """print the commands that are left to run, and run nothing"""
    status: bool = False
    """print what is done, what is left and the estimated remaining time, and run nothing"""
    report: bool = False
    """write figures and tables of the finished runs, and run nothing"""
    out: Path = Path("reproduction")
    """folder of the runs, figures and tables"""
    scale: str = "1"
    """a smaller version: a number up to 1, or `tiny` for one update. It multiplies seeds, updates, trials and episodes;
    its square root multiplies environments, steps of a rollout, seeds of the evaluation and the searched parameters"""
    seeds: Annotated[tuple[int, ...], Range(0)] = ()
    """seeds of the runs; by default 1 to the number that the paper uses, 5 for most"""
    jobs: Natural = 0
    """runs at the same time; 0 for one per GPU, or without GPUs one per core. With --ray, on all machines together; 0 for as
    many as the resources permit"""
    device: str = "auto"
    """`cpu`, `cuda`, ...; `auto` for CUDA if available, else the CPU. Each run sees one GPU"""
    nice: Annotated[int, Range(0, 19)] = 19
    """added to the niceness of the runs, 0 to 19; 19 leaves the cores to all other processes"""
    keep_checkpoints: bool = False
    """keep all checkpoints of evaluated runs, some gigabytes per run, instead of only the last"""
    ray: str = ""
    """run on Ray. The flag alone starts Ray on this machine; with an address, the runs are on that cluster, whose machines must
    share the folder --out"""
    job_cpus: Positive = 1
    """with --ray: CPU cores of a run"""
    job_gpus: Annotated[float | None, Range(0)] = None
    """with --ray: GPUs of a run; by default 1 if the cluster has any and the device is not `cpu`"""


def listed(experiments: list[Experiment], scale: float) -> Table:
    """A table of experiments at a scale; the column `runs` shows the number of runs times the number of seeds."""
    names = ("name", "paper", "runs", "updates", "title")
    table = tables.table("", {name: name in ("runs", "updates") for name in names})
    for experiment in experiments:
        values = planning.as_json(experiment, scale)
        updates = sorted({row["updates"] for row in values["runs"]})
        span = f"{updates[0]:,}" if len(updates) == 1 else f"{updates[0]:,}-{updates[-1]:,}"
        count = f"{len(experiment.runs)} x {values['seeds']}"
        table.add_row(experiment.name, experiment.section, count, span if updates[-1] else "", experiment.title)
    return table


def show_status(planned: list[Job], console: Console) -> None:
    """Print a line about each job."""
    seconds = planning.seconds_left(planned)
    for number, job in enumerate(planned):
        state, trained = job.state(), min(job.updates_done(), job.updates)
        of = f", update {trained} of {job.updates}" if job.updates else ""
        if job.experiment.kind == "curves" and state != "done" and trained == job.updates:
            of += ", evaluation left"
        elif trained < job.updates and seconds is not None:
            of += f", {duration(seconds[number])} left"
            of += "" if trained else ", estimated from other runs"
        console.print(f"{state:<11}  {job.title}{of}")


def remove_checkpoints(job: Job) -> None:
    """Remove the checkpoints of an evaluated run, except the last."""
    if job.experiment.kind == "curves":
        for file in (job.folder / checkpoint.FOLDER).glob("update-*.pt*"):
            file.unlink()


def execute(arguments: ReproduceArguments) -> None:
    """Do what the arguments say.

    Raises:
        ValueError: An argument is invalid, a folder has another run, or a run failed.
        KeyboardInterrupt: The runs were stopped.
    """
    console, scale = command.Terminal(), planning.read_scale(arguments.scale)
    every = arguments.names == ("all",) or (arguments.list and not arguments.names)
    experiments = [definitions.load(name) for name in (definitions.names() if every else arguments.names)]
    if not experiments:
        raise ValueError("no experiment given; `endless-reproduce --list` lists them")
    if arguments.list:
        if arguments.json:
            print(json.dumps([planning.as_json(experiment, scale) for experiment in experiments], indent=1))
        else:
            tables.show(listed(experiments, scale), console)
        return
    # Ray assigns cores and GPUs to each run; how many run at the same time is known once it is connected.
    machine = jobs.machine(arguments.jobs, "cpu" if arguments.ray else arguments.device, arguments.nice)
    machine = replace(machine, device=arguments.device, job_cores=arguments.job_cpus if arguments.ray else 0)
    if arguments.ray:
        command.check_installed("--ray", "ray", "ray")
    out = arguments.out.resolve() if arguments.ray else arguments.out  # Ray's processes have other working directories.
    parts = {one.name: planning.jobs_of(one, out, scale, arguments.seeds) for one in experiments}
    # Runs shared by several experiments are run once.
    planned = list({job.folder: job for own in parts.values() for job in own}.values())
    planning.check_folders(planned)
    left = [job for job in planned if job.state() != "done"]
    if arguments.dry_run:
        for number, job in enumerate(left):
            for line in job.commands(machine):
                print(printable(jobs.shown(line, machine, number)))
        return
    if arguments.status:
        show_status(planned, console)
    side_by_side = "on Ray" if arguments.ray else f"{machine.jobs} at a time"
    console.print(f"{planning.summary(planned, machine.jobs)}, {side_by_side}")
    if arguments.status:
        return
    for package in ("tensorboard", "matplotlib"):
        command.check_installed("endless-reproduce", package)
    folder, failed = planning.folder_of(out, scale), []
    if left and not arguments.report:
        given = (arguments.device, arguments.nice, arguments.job_cpus, arguments.job_gpus)
        connection = (
            jobs_ray.connected(arguments.ray, arguments.jobs, *given) if arguments.ray else nullcontext(machine)
        )
        with connection as machine:
            # Speeds are measured one at a time.
            alone = [job for job in left if job.experiment.kind == "simulation-speed"]
            others = [job for job in left if job not in alone]
            for some, on in ((others, machine), (alone, replace(machine, jobs=1))):
                runner = jobs.Runner(
                    on,
                    folder / jobs.LIST,
                    console.print,
                    lambda: planning.summary(planned, machine.jobs),
                    (lambda job: None) if arguments.keep_checkpoints else remove_checkpoints,
                )
                runner.run(some)
                failed += runner.failed
                if runner.stopped:
                    console.print(f"{planning.summary(planned, machine.jobs)}; repeat the command to continue")
                    raise KeyboardInterrupt
    from endless_gym_agents.paper.experiments import report

    for experiment in experiments:
        written = report.write(parts[experiment.name], folder / experiment.name, scale)
        console.print(f"{written}, with its figures and tables")
    if failed:
        logs = "; ".join(f"{job.title} (log {job.folder}.log)" for job in failed)
        raise ValueError(f"{len(failed)} runs failed: {logs}; repeat the command to continue")


def main() -> int:
    """Entry point of the command `endless-reproduce`; returns the exit status."""
    given = jobs_ray.with_address(sys.argv[1:])
    return command.main("endless-reproduce", ReproduceArguments, execute, __doc__, given)


if __name__ == "__main__":
    sys.exit(main())
