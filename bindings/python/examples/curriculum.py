"""A curriculum: the task grows with the agent's skill.

    python curriculum.py                  # one command at first, then one more whenever nearly all episodes succeed
    python curriculum.py --no-curriculum  # all commands from the start
    python curriculum.py --compare 10     # both, with the seeds 1 to 10

Mortar Mayhem shows commands, which the agent must remember and execute in order. Here only a whole sequence without a mistake is
rewarded, so an untrained agent rarely sees a reward: each further command reduces the chance to about a quarter. With
`episode_options` the number of commands of each episode depends on the results of the last ones.

The agent is as small as the task allows, so that a run takes seconds. Its memory is hand-written (it counts the fires and keeps
the list of the commands shown); it learns which moves execute a command, as a table of action preferences, by REINFORCE with a
baseline (Williams, 1992). Both ways of training use the same agent and the same settings.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections import deque
from typing import Any

import numpy as np
from numpy.typing import NDArray

import endless_gym

ID = "MortarMayhem-Grid-v0"
#: Columns of the feature observation.
POSITION, HEADING, COMMAND, BURNING = slice(0, 2), slice(2, 4), slice(4, 13), 13
#: Side of a tile as a share of the screen.
TILE = 14 / 84
COMMANDS, ACTIONS = 9, 4


class Curriculum:
    """Chooses the number of commands of each episode: one more when enough of the last episodes succeeded."""

    def __init__(self, first: int, last: int, episodes: int = 100, success: float = 0.8) -> None:
        self.commands, self._last, self._success = first, last, success
        self._recent: deque[bool] = deque(maxlen=episodes)

    def __call__(self, env: int, episode: int, final: dict[str, Any] | None) -> dict[str, Any]:
        # Episodes that end now may have begun with fewer commands.
        if final is not None and final["options"] == self._options():
            self._recent.append(final["reward"] > 0)
            is_full = len(self._recent) == self._recent.maxlen
            if is_full and sum(self._recent) >= self._success * len(self._recent) and self.commands < self._last:
                self.commands += 1
                self._recent.clear()
        return self._options()

    def _options(self) -> dict[str, Any]:
        return {"command_count": [self.commands]}


class Memory:
    """What the agent remembers of the episodes of n environments."""

    def __init__(self, num_envs: int) -> None:
        self._envs = np.arange(num_envs)
        self._shown = np.full((num_envs, 64), -1)
        self._count = np.zeros(num_envs, int)
        self._current = np.zeros(num_envs, int)
        self._silent = np.zeros(num_envs, int)
        self._last = np.full(num_envs, -1)
        self._burning = np.zeros(num_envs, bool)
        self._start = np.zeros((num_envs, 2))

    def begin(self, envs: NDArray[np.bool_], features: NDArray[np.float32]) -> None:
        """Forget the last episode of these environments."""
        self._shown[envs], self._count[envs], self._current[envs] = -1, 0, 0
        self._silent[envs], self._last[envs], self._burning[envs] = 0, -1, False
        self._start[envs] = features[envs, POSITION]

    def observe(self, features: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """The row of the table for each environment, (n,), and whether it executes a command, bool (n,)."""
        command = features[:, COMMAND]
        shown = np.where(command.any(1), command.argmax(1), -1)
        new = (shown >= 0) & (shown != self._last)
        self._shown[self._envs[new], self._count[new]] = shown[new]
        self._count += new
        self._last = shown
        # The pause between two commands has one step.
        self._silent = np.where(shown >= 0, 0, self._silent + 1)
        burning = features[:, BURNING] == 1
        went_out = self._burning & ~burning
        self._burning = burning
        self._current += went_out
        self._start[went_out] = features[went_out, POSITION]
        moved = np.rint((features[:, POSITION] - self._start) / TILE).astype(int).clip(-1, 1) + 1
        turned = np.rint(np.arctan2(features[:, 3], features[:, 2]) / (np.pi / 2)).astype(int) % 4
        wanted = np.maximum(self._shown[self._envs, self._current], 0)
        executes = (self._silent > 1) & (self._current < self._count)
        return ((wanted * 3 + moved[:, 0]) * 3 + moved[:, 1]) * 4 + turned, executes


class Agent:
    """A table of action preferences."""

    def __init__(self, num_envs: int, seed: int, learning_rate: float) -> None:
        self._preferences = np.zeros((COMMANDS * 9 * 4, ACTIONS))
        self._gradients = np.zeros((num_envs, *self._preferences.shape))
        self._random, self._envs = np.random.default_rng(seed), np.arange(num_envs)
        self._rate, self._baseline = learning_rate, 0.0

    def act(self, rows: NDArray[np.int64], executes: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Actions for the rows of the table. Where the agent executes a command, the episode's reward reinforces them."""
        weights = np.exp(self._preferences[rows])
        policy = weights / weights.sum(1, keepdims=True)
        actions = (policy.cumsum(1) < self._random.random((len(rows), 1))).sum(1).clip(0, ACTIONS - 1)
        taken = np.eye(ACTIONS)[actions]
        self._gradients[self._envs[executes], rows[executes]] += (taken - policy)[executes]
        return actions

    def learn(self, envs: NDArray[np.int64], rewards: NDArray[np.float64]) -> None:
        """The episodes of these environments have ended with these rewards."""
        for env, reward in zip(envs, rewards, strict=True):
            self._preferences += self._rate * (reward - self._baseline) * self._gradients[env]
            self._baseline += 0.01 * (reward - self._baseline)
            self._gradients[env] = 0


def train(seed: int, given: argparse.Namespace, has_curriculum: bool) -> tuple[int, float | None]:
    """Steps until 90 of the last 100 episodes of the whole task succeeded, and the share of them that did."""
    curriculum = Curriculum(1, given.commands) if has_curriculum else None
    options = {"command_count": [given.commands], "reward_command_success": 0.0, "reward_episode_success": 1.0}
    recent: deque[float] = deque(maxlen=100)
    with endless_gym.make_vec(
        ID,
        given.num_envs,
        1,
        seed=1000 * seed,
        options=options,
        observation="features",
        episode_options=curriculum,
        episode_info=True,
    ) as envs:
        agent, memory = Agent(given.num_envs, seed, given.learning_rate), Memory(given.num_envs)
        features, _ = envs.reset()
        memory.begin(np.ones(given.num_envs, bool), features)
        ended, steps = np.zeros(given.num_envs, bool), 0
        while steps < given.total_timesteps:
            rows, executes = memory.observe(features)
            features, reward, terminated, _, info = envs.step(agent.act(rows, executes))
            steps += given.num_envs
            # With next-step auto-reset, this step started another episode where the last step ended one.
            memory.begin(ended, features)
            ended = terminated.copy()
            finished = np.flatnonzero(ended)
            agent.learn(finished, reward[finished])
            is_whole = [info["options"][env]["command_count"] == [given.commands] for env in finished]
            recent.extend(reward[finished[is_whole]])
            if len(recent) == recent.maxlen and sum(recent) >= 0.9 * len(recent):
                break
    return steps, sum(recent) / len(recent) if recent else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--curriculum", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument("--compare", type=int, default=0, metavar="SEEDS", help="train both ways with seeds 1 to SEEDS")
    parser.add_argument("--commands", type=int, default=5, help="commands of the whole task")
    parser.add_argument("--total-timesteps", type=int, default=1_000_000, help="give up after as many steps")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--learning-rate", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()

    start, total, success = time.perf_counter(), 0, None
    ways = [True, False] if given.compare else [given.curriculum]
    for has_curriculum in ways:
        needed = []
        for seed in range(1, given.compare + 1) if given.compare else [given.seed]:
            steps, success = train(seed, given, has_curriculum)
            needed.append(steps)
            print(f"curriculum={has_curriculum} seed={seed} steps={steps} success={success}", flush=True)
        total += sum(needed)
        print(f"curriculum={has_curriculum} median_steps={statistics.median(needed):.0f}")
    rate, shown = total / (time.perf_counter() - start), "none yet" if success is None else f"{success:.3f}"
    print(f"steps={total} steps_per_second={rate:.0f} commands={given.commands} mean_return={shown}")


if __name__ == "__main__":
    main()
