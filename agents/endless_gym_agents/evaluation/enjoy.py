"""`endless-enjoy`: record a video of a trained agent, or, in environments without pictures, print what it sees.

A video shows its frames next to the ground-truth view.

```console
endless-enjoy runs/mine                                        # one episode, as animated WebP
endless-enjoy runs/mine --seeds 200000 200001 --out play.mp4   # several, as MP4 (needs ffmpeg)
```
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro

from endless_gym.specs import spec
from endless_gym.vector import EndlessVectorEnv
from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.common import command
from endless_gym_agents.common.ranges import Natural, Range
from endless_gym_agents.environments import wrappers
from endless_gym_agents.evaluation import video
from endless_gym_agents.evaluation.evaluate import EVALUATION_SEEDS
from endless_gym_agents.training import checkpoint
from endless_gym_agents.training.train import choose_device


@dataclass(frozen=True)
class EnjoyArguments:
    """Arguments of `endless-enjoy`."""

    checkpoint: tyro.conf.Positional[Path]
    """a checkpoint file, or the folder of a run for its last checkpoint"""
    seeds: Annotated[tuple[int, ...], Range(0)] = (EVALUATION_SEEDS.start,)
    """seeds of the episodes, which are shown in order"""
    out: Path = Path("episode.webp")
    """output file, .webp (lossless) or .mp4 (needs ffmpeg)"""
    action_seed: Natural = 0
    """seed of the action sampling"""
    greedy: bool = False
    """take the most likely actions instead of sampling"""
    max_steps: Natural = 1000
    """stop recording an episode after this number of steps; 0 for no limit"""
    fps: Natural = 0
    """frames per second; 0 for the environment's frame rate"""
    device: str = "cpu"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available, else the CPU"""


@dataclass
class EpisodeRecorder:
    """Plays episodes and generates their video frames.

    Attributes:
        agent: The agent that plays.
        action_seed: Seed of the action sampling.
        greedy: Take the most likely actions instead of sampling.
        max_steps: Largest number of steps of an episode; 0 for no limit.
        rewards: Sum of rewards of each episode so far.
        lengths: Number of steps of each episode so far.
    """

    agent: Agent
    action_seed: Natural = 0
    greedy: bool = False
    max_steps: Natural = 0
    rewards: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)

    def frames(self, seeds: tuple[int, ...]) -> Iterator[Any]:
        """Generate a frame, or a text, for the start and each step of the episodes; the last frame lasts one second."""
        generator = torch.Generator(self.agent.device).manual_seed(self.action_seed)
        for seed in seeds:
            # Like the original, an environment keeps some state between episodes; a new one gives the same video for a seed.
            mode = "rgb_array" if spec(self.agent.settings.env).shown else "ansi"
            with wrappers.make(self.agent.settings, 1, 1, autoreset="disabled", render_mode=mode) as envs:
                yield from self._episode(envs, seed, generator)

    def _episode(self, envs: Any, seed: int, generator: torch.Generator) -> Iterator[Any]:
        settings, memory = self.agent.settings, self.agent.initial_memory(1)
        env_spec = spec(settings.env)
        observation, _ = envs.reset(seed=[seed])
        done = False
        self.rewards.append(0.0)
        self.lengths.append(0)
        frame = self._frame(envs.unwrapped, f"{settings.env}  seed {seed}  step 0")
        yield frame
        while not done and not (self.max_steps and self.lengths[-1] >= self.max_steps):
            action = self.agent.act(observation, memory, generator, self.greedy).action.cpu().numpy()
            observation, reward, terminated, truncated, _ = envs.step(env_spec.batched_actions(action))
            done = bool(terminated[0] or truncated[0])
            self.rewards[-1] += float(reward[0])
            self.lengths[-1] += 1
            text = f"{settings.env}  seed {seed}  step {self.lengths[-1]}  action {'-'.join(map(str, action[0]))}"
            text += f"  reward {self.rewards[-1]:.2f}"
            frame = self._frame(envs.unwrapped, text + ("  end" if done else ""))
            yield frame
        for _ in range(env_spec.render_fps if env_spec.shown else 0):
            yield frame

    @staticmethod
    def _frame(envs: EndlessVectorEnv, text: str) -> Any:
        # Drawn by the environment, since the agent may observe features, or what a wrapper makes of the frame.
        (frame,) = envs.render() or ()
        if isinstance(frame, str):
            return f"{text}\n    {frame}"
        return video.compose(frame, envs.ground_truth_view(0), text)


def execute(arguments: EnjoyArguments) -> None:
    """Record the video, and print the reward and length of each episode."""
    if not arguments.seeds:
        raise ValueError("--seeds must contain at least one seed, got none")
    command.check_outputs([arguments.out], checkpoint.protected(arguments.checkpoint))
    agent = checkpoint.load(arguments.checkpoint, choose_device(arguments.device)).agent
    recorder = EpisodeRecorder(agent, arguments.action_seed, arguments.greedy, arguments.max_steps)
    console = command.Terminal()
    if spec(agent.settings.env).shown is None:
        for text in recorder.frames(arguments.seeds):
            print(text)
        return
    with command.Terminal(stderr=True).status(f"playing {agent.settings.env}"):
        video.write(
            arguments.out, recorder.frames(arguments.seeds), arguments.fps or spec(agent.settings.env).render_fps
        )
    for seed, reward, length in zip(arguments.seeds, recorder.rewards, recorder.lengths, strict=True):
        console.print(f"seed {seed}: reward {reward:.2f} in {length} steps")
    console.print(f"{arguments.out}", soft_wrap=True)


def main() -> int:
    """Entry point of the command `endless-enjoy`; returns the exit status."""
    return command.main("endless-enjoy", EnjoyArguments, execute, __doc__)


if __name__ == "__main__":
    sys.exit(main())
