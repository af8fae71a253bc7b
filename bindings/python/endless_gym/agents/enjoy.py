"""`endless-enjoy`: watch a trained agent play: a film with its observation beside the ground-truth view.

```console
endless-enjoy runs/mine                                        # one episode, as a GIF
endless-enjoy runs/mine --seeds 200000 200001 --out play.mp4   # several, as MP4 (needs ffmpeg)
```
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from rich.console import Console

from endless_gym.agents import command, film
from endless_gym.agents.agent import Agent, observation_shapes
from endless_gym.agents.encoders import FRAME
from endless_gym.agents.evaluate import EVALUATION_SEEDS
from endless_gym.agents.train import choose_device
from endless_gym.specs import spec
from endless_gym.vector import EndlessVectorEnv, make_vec


@dataclass(frozen=True)
class Enjoyment:
    """What to film."""

    checkpoint: tyro.conf.Positional[Path]
    """a checkpoint's file, or a run's folder for its last one"""
    seeds: tuple[int, ...] = (EVALUATION_SEEDS.start,)
    """of the episodes, which follow each other in the film"""
    out: Path = Path("episode.gif")
    """the film's file, .gif or .mp4"""
    draws: int = 0
    """seed of the agent's draws"""
    greedy: bool = False
    """take the most likely actions instead of drawing them"""
    max_steps: int = 1000
    """end an episode in the film after this number of steps; 0 for no limit"""
    fps: int = 0
    """pictures in a second; 0 for the environment's own number"""
    device: str = "cpu"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA where there is one"""


@dataclass
class Showing:
    """Plays episodes, and gives their pictures.

    Attributes:
        agent: Who plays.
        draws: Seed of the agent's draws.
        greedy: Take the most likely actions.
        max_steps: The most steps of an episode that are played; 0 for no limit.
        rewards: Of the episodes so far, summed.
        lengths: Their steps so far.
    """

    agent: Agent
    draws: int = 0
    greedy: bool = False
    max_steps: int = 0
    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)

    def pictures(self, seeds: tuple[int, ...]) -> Iterator[film.Picture]:
        """A picture for the start of each episode and one for each step; the last one stands for a second."""
        settings = self.agent.settings
        generator = torch.Generator(self.agent.device).manual_seed(self.draws)
        # The film shows frames, whatever the agent observes.
        shown = "rgb" if settings.environment.observation == "rgb" else "rgb+features"
        options = settings.options()
        for seed in seeds:
            # Environments keep things from one episode to the next, as the original's do; a fresh one has none.
            with make_vec(settings.env, 1, 1, options=options, autoreset="disabled", observation=shown) as envs:
                yield from self._episode(envs, seed, generator)

    def _episode(self, envs: EndlessVectorEnv, seed: int, generator: torch.Generator) -> Iterator[film.Picture]:
        settings, memory = self.agent.settings, self.agent.initial_memory(1)
        described = spec(settings.env)
        keys = observation_shapes(described, settings.environment.observation)
        observation, _ = envs.reset(seed=[seed])
        reward, length, done = 0.0, 0, False
        self.rewards.append(0.0)
        self.lengths.append(0)
        picture = self._picture(envs, observation, f"{settings.env}  seed {seed}  step 0")
        yield picture
        while not done and not (self.max_steps and length >= self.max_steps):
            single = next(iter(keys))
            seen = {key: observation[key] for key in keys} if isinstance(observation, dict) else {single: observation}
            action = self.agent.act(seen, memory, generator, self.greedy).action.cpu().numpy()
            observation, rewards, terminated, truncated, _ = envs.step(action)
            reward, length = reward + float(rewards[0]), length + 1
            done = bool(terminated[0] or truncated[0])
            self.rewards[-1], self.lengths[-1] = reward, length
            text = f"{settings.env}  seed {seed}  step {length}  action {'-'.join(map(str, action[0]))}  reward {reward:.2f}"
            picture = self._picture(envs, observation, text + ("  end" if done else ""))
            yield picture
        for _ in range(described.render_fps):
            yield picture

    @staticmethod
    def _picture(envs: EndlessVectorEnv, observation: Any, text: str) -> film.Picture:
        frame = observation[FRAME] if isinstance(observation, dict) else observation
        return film.compose(np.asarray(frame)[0], envs.ground_truth_view(0), text)


def work(given: Enjoyment) -> None:
    """Film, and tell."""
    if not given.seeds:
        raise ValueError("no seeds to play; give --seeds with one or more")
    film.check(given.out)
    agent = command.load_checkpoint(given.checkpoint, choose_device(given.device)).agent
    showing = Showing(agent, given.draws, given.greedy, given.max_steps)
    console = Console()
    with Console(stderr=True).status(f"playing {agent.settings.env}"):
        film.write(given.out, showing.pictures(given.seeds), given.fps or spec(agent.settings.env).render_fps)
    for seed, reward, length in zip(given.seeds, showing.rewards, showing.lengths, strict=True):
        console.print(f"seed {seed}: reward {reward:.2f} in {length} steps")
    console.print(f"{given.out}", soft_wrap=True)


def main() -> int:
    """The command `endless-enjoy`."""
    given = tyro.cli(Enjoyment, prog="endless-enjoy", description=command.description(__doc__), args=sys.argv[1:])
    return command.run("endless-enjoy", lambda: work(given))


if __name__ == "__main__":
    sys.exit(main())
