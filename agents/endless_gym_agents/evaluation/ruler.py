"""Tasks that measure one thing about a memory each, and what their scores are between.

The score of a task is a return. It is normalised so that 0 is what an agent without memory reaches after the same training, and
1 is what the scripted expert reaches. A task has a gate: an agent without memory must stay below half of the way from random
actions to the expert, or else the task does not measure memory.

```console
python -m endless_gym_agents.ruler          # plays experts and random actions, and prints the tasks
```
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from endless_gym.create import make_vec
from endless_gym.experts import Experts
from endless_gym.specs import spec
from endless_gym_agents.common import command
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS
from endless_gym_agents.settings import STATES, VECTORS, Environment, Settings

#: What a task measures: which of several things was seen; where something is; in which order things were seen; how many; whether
#: what was seen last replaces what was seen before.
Label = Literal["object", "spatial", "sequential", "capacity", "rewriting"]
#: Share of the way from random actions to the expert that an agent without memory must not reach.
GATE = 0.5
#: Seeds of the episodes of experts and random actions; the evaluation's first ones.
SEEDS = range(EVALUATION_SEEDS.start, EVALUATION_SEEDS.start + 400)


@dataclass(frozen=True)
class Task:
    """A task of the ruler.

    Attributes:
        name: Name, unique in the ruler.
        label: What it measures.
        env: Environment id.
        expert: Mean return of the expert in episodes of `SEEDS`.
        random: Mean return of random actions in the same episodes.
        options: Reset parameters, each as NAME=VALUE.
        longer: Environment id and reset parameters of a longer version, on which trained agents are evaluated; None if none fits
            their observations and actions.
        observable: Flags of `endless-train`, of which `env` is another environment, that make the task fully observable; None if
            nothing does.
    """

    name: str
    label: Label
    env: str
    expert: float
    random: float
    options: tuple[str, ...] = ()
    longer: tuple[str, tuple[str, ...]] | None = None
    observable: Mapping[str, Any] | None = None

    def flags(self) -> dict[str, Any]:
        """Flags of `endless-train` for this task, without `env`."""
        chosen: dict[str, Any] = {"environment.option": list(self.options)} if self.options else {}
        popgym: dict[str, Any] = {"environment.wrapper": [VECTORS], "environment.observation": "features"}
        return chosen | (popgym if self.env.startswith("popgym") else {})

    def twin(self) -> tuple[str, dict[str, Any]] | None:
        """Environment id and flags of the fully observable task; None if there is none. A labyrinth's lacks the position."""
        described = spec(self.env)
        states = {"environment.wrapper": [STATES]} if described.markov_state else None
        changed = dict(self.observable or states or {})
        return (changed.pop("env", self.env), self.flags() | changed) if changed else None

    def passes_gate(self, memoryless: float) -> bool:
        """Whether an agent without memory with this mean return fails the task, as it must."""
        return memoryless < self.random + GATE * (self.expert - self.random)


def _mayhem(
    name: str, label: Label, expert: float, random: float, options: tuple[str, ...], longer: tuple[str, ...]
) -> Task:
    grid = "MortarMayhem-Grid-v0"
    return Task(name, label, grid, expert, random, options, (grid, longer), {"env": "MortarMayhemB-Grid-v0"})


_OPEN = ("show_origin=true", "show_goal=true")
#: One coin after the other, each shown for six steps, without spotlights; large, so that small agents learn it quickly.
_COIN = (
    "initial_spawns=0",
    "spawn_interval=1000000000",
    "agent_visible=true",
    "show_last_action=false",
    "coin_scale=0.6",
    "agent_scale=0.375",
    "max_steps=256",
)
_LATE = "command_count=[1]", "command_show_delay=[20]"

#: The tasks. The numbers of experts and random actions are those that the program prints.
TASKS = {
    task.name: task
    for task in (
        _mayhem("one-command", "object", 0.1, 0.0185, ("command_count=[1]",), ("command_count=[2]",)),
        _mayhem("two-commands", "sequential", 0.2, 0.0195, ("command_count=[2]",), ("command_count=[3]",)),
        _mayhem("three-commands", "sequential", 0.3, 0.0177, ("command_count=[3]",), ("command_count=[5]",)),
        _mayhem("ten-commands", "sequential", 1.0, 0.0223, ("command_count=[10]",), ("command_count=[15]",)),
        _mayhem("late-command", "object", 0.1, 0.0143, _LATE, (_LATE[0], "command_show_delay=[60]")),
        Task("growing-sequence", "capacity", "Endless-MortarMayhem-v0", 4.0, 0.0083, ("max_steps=1000",)),
        Task("path", "spatial", "MysteryPath-Grid-v0", 1.802, 0.2635, (*_OPEN, "reward_path_progress=0.1")),
        Task("path-sparse", "spatial", "MysteryPath-Grid-v0", 0.9975, 0.0075, _OPEN),
        Task("spotlights", "object", "SearingSpotlights-v0", 1.25, 0.01),
        Task(
            "repeat-first", "object", "popgym-RepeatFirstEasy-v0", 1.0, -0.4943, (), ("popgym-RepeatFirstMedium-v0", ())
        ),
        Task(
            "repeat-first-12",
            "object",
            "popgym-RepeatFirstEasy-v0?num_decks=12",
            1.0,
            -0.4988,
            (),
            ("popgym-RepeatFirstEasy-v0?num_decks=16", ()),
        ),
        Task("repeat-previous", "sequential", "popgym-RepeatPreviousEasy-v0", 1.0, -0.4942),
        Task(
            "repeat-previous-8",
            "sequential",
            "popgym-RepeatPreviousEasy-v0?k=8",
            1.0,
            -0.4991,
            (),
            ("popgym-RepeatPreviousEasy-v0?k=8&num_decks=2", ()),
        ),
        Task("count-recall", "capacity", "popgym-CountRecallEasy-v0", 1.0, -0.9274),
        Task("autoencode", "capacity", "popgym-AutoencodeEasy-v0", 1.0, -0.4895),
        Task("mine-sweeper", "spatial", "popgym-MineSweeperEasy-v0", 0.7134, -0.2147),
        Task("labyrinth", "spatial", "popgym-LabyrinthExploreEasy-v0", 0.9694, -0.3453),
        Task(
            "moving-coin",
            "rewriting",
            "Endless-SearingSpotlights-v0",
            5.8375,
            0.1119,
            _COIN,
            ("Endless-SearingSpotlights-v0", (*_COIN, "agent_speed=2")),
            {"environment.option": [*_COIN, "coins_visible=true"]},
        ),
    )
}


def mean_return(task: Task, expert: bool, seeds: Sequence[int] = SEEDS) -> float:
    """Mean return of the scripted expert, or of random actions, in one episode of each seed."""
    num_envs = len(seeds)
    generator, described = np.random.default_rng(0), spec(task.env)
    choose: Callable[[Any, Any], NDArray[Any]]
    if expert:
        choose = Experts(task.env, num_envs).act
    else:

        def choose(observation: Any, start: Any) -> NDArray[Any]:
            return described.batched_actions(described.random_actions(generator, num_envs))

    options = Settings(environment=Environment(option=task.options)).options()
    with make_vec(
        task.env, num_envs, 1, options=options, seeds=list(seeds), observation="features", autoreset="same_step"
    ) as envs:
        observation, _ = envs.reset()
        start, running, returns = np.ones(num_envs, np.bool_), np.ones(num_envs, np.bool_), np.zeros(num_envs)
        while running.any():
            observation, reward, terminated, truncated, _ = envs.step(choose(observation, start))
            returns += np.where(running, reward, 0.0)
            start = terminated | truncated
            running &= ~start
    return float(returns.mean())


def execute() -> None:
    """Print the tasks, with the mean returns of experts and random actions."""
    for task in TASKS.values():
        expert, random = (mean_return(task, expert) for expert in (True, False))
        print(
            f"{task.name:<17} {task.label:<11} expert {expert:7.4f}  random {random:7.4f}  {task.env} {' '.join(task.options)}"
        )


def main() -> int:
    """Entry point of the program; returns the exit status."""
    return command.run("ruler", execute)


if __name__ == "__main__":
    sys.exit(main())
