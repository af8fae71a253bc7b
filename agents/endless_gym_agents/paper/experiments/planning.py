"""Turns an experiment into jobs: their flags at a scale, folders, progress and estimated remaining time."""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from endless_gym_agents.common import command, regular
from endless_gym_agents.common.clock import duration
from endless_gym_agents.paper import jobs
from endless_gym_agents.paper.experiments.definitions import Evaluation, Experiment, Run, Value
from endless_gym_agents.paper.search_space import STUDY, space
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.logs import read_progress, update_seconds

#: The scale `tiny`: one update of most runs.
TINY = 1 / 50_000
#: Files of a job: the results of its evaluation, and of its measurement of speed.
EVALUATION, SPEED = "evaluation.json", "speed.json"
State = Literal["done", "interrupted", "not started"]


@dataclass(frozen=True)
class Job:
    """A run of an experiment with one seed.

    Attributes:
        experiment: The experiment, at its scale.
        run: The run, with the flags at that scale.
        seed: Seed of the training.
        out: Folder of all runs and reports at that scale.
    """

    experiment: Experiment
    run: Run
    seed: int
    out: Path

    @property
    def folder(self) -> Path:
        """Folder of the run, shared by all experiments that contain the run."""
        return self.out / "runs" / command.folder_name(self.run.env) / self.run.name / f"seed-{self.seed}"

    @property
    def title(self) -> str:
        """Environment, name and seed."""
        return f"{self.run.env} {self.run.name} seed {self.seed}"

    @property
    def updates(self) -> int:
        """Updates of the training; 0 for jobs of other kinds."""
        trains = self.experiment.kind in ("curves", "ablation", "wall-time")
        return self.run.settings().ppo.updates if trains else 0

    def updates_done(self) -> int:
        """Updates in the log of the run."""
        return len(read_progress(self.folder))

    def state(self) -> State:
        """Whether the job is done, and if not, whether it can be resumed."""
        if not self.commands(jobs.Machine(1)):
            return "done"
        begun = (checkpoint.last(self.folder), self.folder / STUDY)
        return "interrupted" if any(file.exists() for file in begun) else "not started"

    def has_succeeded(self) -> bool:
        """Whether all updates are done; `endless-train` also ends with status 0 if it was interrupted."""
        return self.updates_done() >= self.updates

    def progress(self) -> str:
        """The updates so far, or nothing before a checkpoint."""
        begun = self.updates and checkpoint.last(self.folder).exists()
        return f"at update {self.updates_done()} of {self.updates}" if begun else ""

    def commands(self, machine: jobs.Machine) -> list[list[str]]:
        """The command lines that are left, in order; the first word of each is a program of this package."""
        experiment, run, folder = self.experiment, self.run, str(self.folder)
        here = ["--device", machine.device, "--threads", "1"]
        own = ["--env", run.env, *command.flags(run.flags), "--seed", str(self.seed)]
        train = [*here, "--environment.num-threads", str(machine.engine_threads)]
        if experiment.kind == "simulation-speed":
            speed = ["--env", run.env, "--episodes", str(experiment.episodes), "--json", str(self.folder / SPEED)]
            wanted = [["endless-speed", *speed]]
        elif experiment.kind == "search":
            given = experiment.search
            search = ["--folder", folder, "--trials", str(given.trials), "--warm-up", str(given.warm_up)]
            search += ["--parameters", *given.parameters] if given.parameters else []
            wanted = [["endless-search", *search, *own, *train]]
        elif (self.folder / checkpoint.SETTINGS).exists():
            wanted = [["endless-train", "--resume", folder, *train]]
        else:
            wanted = [["endless-train", *own, "--run", folder, *train]]
        if experiment.kind == "curves":
            protocol = experiment.evaluation
            if "--run" in wanted[0]:
                wanted[0] += ["--checkpoint-interval", str(protocol.interval), "--keep-checkpoints"]
            test = ["--seeds", str(protocol.seeds), "--repetitions", str(protocol.repetitions), *here]
            test += ["--engine-threads", str(machine.engine_threads), "--json", str(self.folder / EVALUATION)]
            wanted.append(["endless-eval", folder, *test])
        if not self.folder.exists():
            return wanted
        left = jobs.listed(self.out / jobs.LIST).get(self.title, {}).get("left", len(wanted))
        result = {"curves": EVALUATION, "simulation-speed": SPEED}.get(experiment.kind)
        if result:  # It is written as a whole, at the end.
            left = 0 if (self.folder / result).exists() else max(left, 1)
        return wanted[len(wanted) - left :]


def read_scale(text: str) -> float:
    """The scale that `--scale` names.

    Raises:
        ValueError: It is neither `tiny` nor a number in (0, 1].
    """
    try:
        scale = TINY if text == "tiny" else float(text)
    except ValueError:
        scale = 0.0
    if not 0 < scale <= 1:
        raise ValueError(f"--scale must be greater than 0 and at most 1, or tiny; got `{text}`")
    return scale


def scaled(experiment: Experiment, scale: float) -> Experiment:
    """A smaller version of an experiment; with scale 1, the experiment itself.

    Seeds, updates, decay updates, updates between checkpoints, trials and episodes are multiplied by the scale; environments,
    steps of a rollout, seeds and repetitions of the evaluation and parameters of a search by its square root. Networks and
    tasks stay the same.

    Args:
        experiment: The experiment.
        scale: Greater than 0, at most 1.
    """
    if scale == 1:
        return experiment

    def times(number: int, factor: float, least: int = 1) -> int:
        return min(number, max(least, round(number * factor)))

    root = math.sqrt(scale)
    runs = []
    for run in experiment.runs:
        settings = run.settings()
        ppo, environment = settings.ppo, settings.environment
        flags: dict[str, Value] = {
            "ppo.updates": times(ppo.updates, scale),
            "ppo.decay-updates": times(ppo.decay_updates, scale),
            "ppo.steps": times(ppo.steps // 64, root) * 64,
            "environment.num-envs": environment.groups * times(environment.num_envs // environment.groups, root),
        }
        runs.append(dataclasses.replace(run, flags={**run.flags, **flags}))
    protocol, search = experiment.evaluation, experiment.search
    searched = search.parameters or tuple(space(runs[0].settings()))
    return dataclasses.replace(
        experiment,
        runs=tuple(runs),
        seeds=times(experiment.seeds, scale),
        episodes=times(experiment.episodes, scale),
        evaluation=Evaluation(
            times(protocol.interval, scale), times(protocol.seeds, root, 2), times(protocol.repetitions, root)
        ),
        search=dataclasses.replace(
            search,
            trials=times(search.trials, scale),
            warm_up=times(search.warm_up, scale),
            parameters=searched[: times(len(searched), root)],
        ),
    )


def jobs_of(experiment: Experiment, out: Path, scale: float, seeds: Sequence[int] = ()) -> list[Job]:
    """The jobs of an experiment at a scale, ordered by seed, then by run.

    Args:
        experiment: The experiment at its full size.
        out: Folder for all experiments.
        scale: Scale of the experiment.
        seeds: Seeds; empty for 1 to the number that the experiment names.
    """
    experiment = scaled(experiment, scale)
    chosen = tuple(seeds) or range(1, experiment.seeds + 1)
    return [Job(experiment, run, seed, folder_of(out, scale)) for seed in chosen for run in experiment.runs]


def folder_of(out: Path, scale: float) -> Path:
    """Folder of the runs and reports at a scale."""
    return out if scale == 1 else out / f"scale-{scale:g}"


def check_folders(planned: Sequence[Job]) -> None:
    """Check that any runs already in the folders belong to the jobs.

    Raises:
        ValueError: A folder has a run with other settings.
    """
    for job in planned:
        if not job.updates or not (job.folder / checkpoint.SETTINGS).exists():
            continue
        found, wanted = checkpoint.read_settings(job.folder), job.run.settings()
        for name in ("env", "agent", "preset", "transformer", "recurrence", "model", "ppo"):
            if getattr(found, name) != getattr(wanted, name):
                raise ValueError(
                    f"{job.folder} has a run with another `{name}`: {getattr(found, name)}, and the experiment has "
                    f"{getattr(wanted, name)}; use another --out, or remove the folder"
                )


def evaluation_seconds(job: Job) -> float | None:
    """Time of a job's evaluation; None if it has none, or before it is done."""
    file = job.folder / EVALUATION
    return json.loads(regular.text(file)).get("seconds") if file.exists() else None


def _estimate(planned: Sequence[Job], measured: Callable[[Job], float | None]) -> Callable[[Job], float] | None:
    """Estimate a measurement for jobs without one: the mean over the same environment and agent, or else over all jobs.

    Args:
        planned: The jobs.
        measured: Returns the measurement of a job, or None.

    Returns:
        A function that returns a job's measurement or its estimate; None if no job has a measurement.
    """
    known = [(job, value) for job in planned if (value := measured(job)) is not None]
    if not known:
        return None

    def kind(job: Job) -> tuple[str, Value]:
        return job.run.env, job.run.flags.get("agent", "gru")

    def estimate(job: Job) -> float:
        value = measured(job)
        alike = [other for one, other in known if kind(one) == kind(job)] or [other for _, other in known]
        return statistics.mean(alike) if value is None else value

    return estimate


def seconds_left(planned: Sequence[Job]) -> list[float] | None:
    """Estimated seconds that each job still takes; None before the first measured update.

    A job without a measured update is estimated from the seconds per environment step of the others. Evaluations are included
    once the first one is done.
    """

    def steps(job: Job) -> int:
        settings = job.run.settings()
        return settings.environment.num_envs * settings.ppo.steps

    def per_step(job: Job) -> float | None:
        times = update_seconds(read_progress(job.folder))
        return statistics.median(times) / steps(job) if times else None

    training, evaluation = _estimate(planned, per_step), _estimate(planned, evaluation_seconds)
    if training is None:
        return None
    left = [max(0, job.updates - job.updates_done()) * steps(job) * training(job) for job in planned]
    if evaluation is not None:
        for number, job in enumerate(planned):
            if job.experiment.kind == "curves" and not (job.folder / EVALUATION).exists():
                left[number] += evaluation(job)
    return left


def remaining_seconds(planned: Sequence[Job], side_by_side: int) -> float | None:
    """Estimated seconds until all jobs are done; None before the first measured update.

    Args:
        planned: The jobs.
        side_by_side: Number of jobs that run at the same time.
    """
    left = seconds_left(planned)
    return None if left is None else max(sum(left) / side_by_side, max(left))


def summary(planned: Sequence[Job], side_by_side: int) -> str:
    """One line with the progress of the jobs and the estimated remaining time."""
    states = [job.state() for job in planned]
    trained, total = sum(min(job.updates_done(), job.updates) for job in planned), sum(job.updates for job in planned)
    text = f"{states.count('done')} of {len(planned)} jobs done, {states.count('interrupted')} begun"
    if total:
        text += f", {trained:,} of {total:,} updates"
        seconds = remaining_seconds(planned, side_by_side)
        evaluated = [evaluation_seconds(job) is not None for job in planned if job.experiment.kind == "curves"]
        if trained < total and seconds is None:
            text += "; time unknown before the first update"
        elif seconds:
            text += f"; the rest takes {duration(seconds)}" + (
                ", and its evaluation" if evaluated and not any(evaluated) else ""
            )
    return text


def as_json(experiment: Experiment, scale: float) -> dict[str, Any]:
    """An experiment for `--list --json`: the content of its file, plus the updates and steps of each run at the scale."""
    small = scaled(experiment, scale)
    values = json.loads(json.dumps(dataclasses.asdict(small)))
    for row, run in zip(values["runs"], small.runs, strict=True):
        settings = run.settings()
        row["updates"] = settings.ppo.updates if small.kind != "simulation-speed" else 0
        row["steps"] = row["updates"] * settings.environment.num_envs * settings.ppo.steps
    return dict(values)
