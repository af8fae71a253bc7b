"""Results of an evaluation: metrics of the checkpoints of runs, and the JSON files that `endless-plot` reads."""

from __future__ import annotations

import json
import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from endless_gym.specs import Metric, spec
from endless_gym_agents.common import regular
from endless_gym_agents.evaluation.statistics import Summary, summarise
from endless_gym_agents.memories import MEMORIES
from endless_gym_agents.settings import Recurrence, Settings


def metric(env: str) -> Metric:
    """Name of an environment's metric in the results, and its plot label; the return if there is no such environment here."""
    try:
        return spec(env).metric
    except ValueError:
        return Metric("reward", "Return")


@dataclass
class Run:
    """The evaluated checkpoints of a run.

    Attributes:
        run: Name of the run, such as its folder.
        seed: Seed of its training.
        steps: Environment steps before each checkpoint, ascending.
        metrics: Mean over the episodes of each checkpoint, by name of the metric.
        episodes: Final infos of the episodes of each checkpoint; empty if they were not stored.
        cost: What the run took: `parameters`, `state_bytes` and, if one thread learnt, `core_seconds`; as far as it is known.
    """

    run: str
    seed: int
    steps: list[int] = field(default_factory=list)
    metrics: dict[str, list[float]] = field(default_factory=dict)
    episodes: list[list[dict[str, float]]] = field(default_factory=list)
    cost: dict[str, float] = field(default_factory=dict)

    def add(self, steps: int, episodes: Sequence[Mapping[str, float]]) -> None:
        """Append a checkpoint with its number of environment steps and the final infos of its episodes."""
        self.steps.append(steps)
        self.episodes.append([dict(episode) for episode in episodes])
        for name in episodes[0]:
            if name != "seed":
                mean = sum(episode[name] for episode in episodes) / len(episodes)
                self.metrics.setdefault(name, []).append(mean)


@dataclass
class Experiment:
    """Runs that differ only in their seeds.

    Attributes:
        env: Environment id.
        label: Name in plots and tables, such as `gru_rec`.
        options: Reset parameters.
        runs: The runs.
        last: Whether the last checkpoints of the runs are compared, although these may have stopped at different steps.
    """

    env: str
    label: str
    options: dict[str, Any] = field(default_factory=dict)
    runs: list[Run] = field(default_factory=list)
    last: bool = False

    def common_steps(self) -> list[int]:
        """Numbers of environment steps at which every run has a checkpoint, ascending; of `last` checkpoints the largest one."""
        if self.last:
            return [max(run.steps[-1] for run in self.runs)]
        steps = set(self.runs[0].steps).intersection(*(run.steps for run in self.runs))
        return sorted(steps)

    def scores(self, metric: str) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """Mean of a metric for each run and checkpoint, float64 (runs, common steps)."""
        steps = self.common_steps()
        places = [[-1] if self.last else [run.steps.index(step) for step in steps] for run in self.runs]
        return np.array([[run.metrics[metric][i] for i in found] for run, found in zip(self.runs, places, strict=True)])

    def summaries(self, metric: str) -> list[tuple[int, Summary, str]]:
        """Estimates of a metric for each checkpoint: over the runs, or over the episodes if there is a single run.

        Returns:
            Number of environment steps, estimates, and a description of the sample such as `5 runs`, for each checkpoint.
        """
        if len(self.runs) > 1:
            columns = self.scores(metric).T
            fewest = min(run.steps[-1] for run in self.runs)
            over = f"{len(self.runs)} runs" + f" that stopped from {fewest:,} steps on" * self.last
            return [(step, summarise(column), over) for step, column in zip(self.common_steps(), columns, strict=True)]
        (run,) = self.runs
        return [
            (step, summarise([episode[metric] for episode in episodes], of_runs=False), f"{len(episodes)} episodes")
            for step, episodes in zip(run.steps, run.episodes, strict=True)
        ]


def label(settings: Settings) -> str:
    """Name of an agent and its variations, as in the published curves (where `_lr` marks a different learning rate)."""
    trxl = settings.agent in ("trxl", "gtrxl")
    agents = {"none": "ppo", "stack": f"{settings.model.stack}stack", "position": "pos_enc"}
    name = agents.get(settings.agent, settings.agent_name)
    name += "".join(f"_{option}" for option in settings.agent_option)
    if settings.agent == "gtrxl":
        name += f"_b{settings.transformer.gate_bias:g}"
    if settings.agent in ("gru", "lstm", *MEMORIES) and settings.recurrence.hidden_size != Recurrence().hidden_size:
        name += f"_{settings.recurrence.hidden_size}"
    encoder = (settings.encoder.rpartition(":")[2], *settings.encoder_option) if settings.encoder else ()
    # Those that an environment has by default say nothing about the agent.
    wrappers = (wrapper.rpartition(":")[2] for wrapper in settings.environment.own_wrappers)
    name += "".join(f"_{part}" for part in (*encoder, *wrappers))
    additions = {
        "_gt": settings.ppo.ground_truth_coefficient,
        "_qpos": trxl and settings.transformer.query_encoding,
        "_qprev": trxl and settings.transformer.query_previous,
        "_learned": trxl and settings.transformer.positional_encoding == "learned",
        "_relative": trxl and settings.transformer.positional_encoding == "relative",
        "_rec": settings.ppo.reconstruction_coefficient,
    }
    return name + "".join(addition for addition, value in additions.items() if value)


def own_name(label: str) -> str:
    """A label with our name of the agent without memory, `none`, which the paper calls by its algorithm, `ppo`."""
    return re.sub(r"^ppo\b", "none", label)


class Experiments:
    """Groups runs into experiments by their settings."""

    def __init__(self) -> None:
        self._found: dict[Hashable, Experiment] = {}

    def of(self, settings: Settings) -> Experiment:
        """The experiment of a run with these settings; created if it does not exist."""
        # The engine and its threads do not affect learning, and runs of different lengths belong to the same experiment.
        environment = replace(settings.environment, engine="thread", num_threads=0)
        networks = (settings.recurrence, settings.transformer, settings.model)
        key = (
            settings.env,
            settings.agent,
            settings.agent_option,
            settings.encoder,
            settings.encoder_option,
            settings.bf16,
            environment,
            networks,
            replace(settings.ppo, updates=0),
        )
        if key not in self._found:
            name, taken = label(settings), [one.label for one in self.all() if one.env == settings.env]
            number = sum(other == name or other.startswith(f"{name} (") for other in taken)
            options = settings.options()
            self._found[key] = Experiment(settings.env, f"{name} ({number + 1})" if number else name, options)
        return self._found[key]

    def all(self) -> list[Experiment]:
        """All experiments, in the order of their creation."""
        return list(self._found.values())


def to_json(
    experiments: Sequence[Experiment], protocol: Mapping[str, Any], with_episodes: bool = False
) -> dict[str, Any]:
    """Convert results to JSON-serialisable values.

    Args:
        experiments: The experiments.
        protocol: The evaluation protocol.
        with_episodes: Include the infos of every episode.
    """
    written = []
    for experiment in experiments:
        values = asdict(experiment)
        if not with_episodes:
            for run in values["runs"]:
                del run["episodes"]
        name, _ = metric(experiment.env)
        values["metric"] = name
        values["summary"] = [
            {"steps": step, "over": over, **asdict(summary)} for step, summary, over in experiment.summaries(name)
        ]
        written.append(values)
    return {"protocol": dict(protocol), "experiments": written}


def read(file: Path) -> list[Experiment]:
    """Read the experiments from a file that `endless-eval --json` wrote.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file has another format.
    """
    try:
        content = json.loads(regular.text(file))
    except (UnicodeDecodeError, json.JSONDecodeError):
        content = None
    return from_json(content, file)


def from_json(content: Any, file: Path) -> list[Experiment]:
    """As `read`, from the content of the file."""
    try:
        return [
            Experiment(
                one["env"], one["label"], one["options"], [Run(**run) for run in one["runs"]], one.get("last", False)
            )
            for one in content["experiments"]
        ]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{file} is not a file of `endless-eval --json`") from error
