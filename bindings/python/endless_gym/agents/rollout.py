"""Playing: segments of T steps in N environments, kept as they are learned from.

The environments come in groups. While the agent decides for one, the others step. A segment goes on where the last one ended, in
the middle of episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from endless_gym.agents.agent import Agent, AgentMemory
from endless_gym.agents.clock import Clock
from endless_gym.agents.encoders import FRAME, Observation
from endless_gym.agents.environments import Environments, Received
from endless_gym.interop import unchecked_torch_view


@dataclass
class Segment:
    """T steps of N environments, on the agent's device.

    Attributes:
        observation: What the agent observed, each (T, N, ...); frames uint8.
        first: Whether the observation starts an episode, bool (T, N).
        action: int64 (T, N, branches).
        log_prob: Of each branch's choice, (T, N, branches).
        value: Expected before the step, (T, N).
        reward: What the step earned, (T, N).
        done: Whether it ended an episode, bool (T, N).
        ground_truth: Of the observation, (T, N, entries), if the agent estimates it.
        last_value: Expected after the last step, (N,).
    """

    observation: Observation
    first: Tensor
    action: Tensor
    log_prob: Tensor
    value: Tensor
    reward: Tensor
    done: Tensor
    ground_truth: Tensor | None
    last_value: Tensor

    def flat(self) -> Segment:
        """The same with steps and environments in one dimension, (T * N, ...): step t of environment n is number t * N + n."""

        def flatten(tensor: Tensor) -> Tensor:
            return tensor.flatten(0, 1)

        return Segment(
            observation={key: flatten(part) for key, part in self.observation.items()},
            first=flatten(self.first),
            action=flatten(self.action),
            log_prob=flatten(self.log_prob),
            value=flatten(self.value),
            reward=flatten(self.reward),
            done=flatten(self.done),
            ground_truth=None if self.ground_truth is None else flatten(self.ground_truth),
            last_value=self.last_value,
        )


class Player:
    """Plays segments with an agent, one after the other, and writes each over the last one."""

    def __init__(self, agent: Agent, environments: Environments, steps: int, generator: torch.Generator) -> None:
        self.agent, self.environments, self.steps, self.generator = agent, environments, steps, generator
        groups, per_group = environments.groups, environments.per_group
        self.memories: list[AgentMemory] = [agent.initial_memory(per_group) for _ in range(groups)]
        self.current: list[Received] = [environments.reset(group) for group in range(groups)]
        shape = (steps, groups * per_group)

        def empty(*more: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros((*shape, *more), dtype=dtype, device=agent.device)

        branches = len(agent.branches)
        self.segment = Segment(
            observation={
                key: empty(*part, dtype=torch.uint8 if key == FRAME else torch.float32)
                for key, part in agent.observer.shapes.items()
            },
            first=empty(dtype=torch.bool),
            action=empty(branches, dtype=torch.long),
            log_prob=empty(branches),
            value=empty(),
            reward=empty(),
            done=empty(dtype=torch.bool),
            ground_truth=empty(environments.spec.ground_truth) if agent.ground_truth is not None else None,
            last_value=torch.zeros(shape[1], device=agent.device),
        )

    def play(self, clock: Clock) -> tuple[Segment, list[dict[str, float]]]:
        """Play a segment.

        Returns:
            The segment, which the next call overwrites, and the infos of the episodes that ended.
        """
        episodes: list[dict[str, float]] = []
        for memory in self.memories:
            self.agent.memory.begin_segment(memory.state, self.steps)
        for step in range(self.steps):
            for group in range(self.environments.groups):
                if step:
                    with clock.measure("stepping"):
                        episodes += self._receive(group, step - 1)
                with clock.measure("inference"):
                    action = self._act(group, step)
                with clock.measure("stepping"):
                    self.environments.send(action, group)
        for group, memory in enumerate(self.memories):
            with clock.measure("stepping"):
                episodes += self._receive(group, self.steps - 1)
            with clock.measure("inference"):
                value = self.agent.estimate(self.current[group].observation, memory)
                self.segment.last_value[self._columns(group)] = value
        return self.segment, episodes

    def state(self) -> dict[str, Any]:
        """Memories and environments, for a checkpoint between two segments."""
        return {
            "memories": [memory.tensors() for memory in self.memories],
            "environments": self.environments.snapshots(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Go on where `state` was taken."""
        self.current = self.environments.restore(state["environments"])
        for memory, tensors in zip(self.memories, state["memories"], strict=True):
            memory.load(tensors)

    def _act(self, group: int, step: int) -> Any:
        columns, memory, current, segment = (
            self._columns(group),
            self.memories[group],
            self.current[group],
            self.segment,
        )
        segment.first[step, columns] = memory.first
        if segment.ground_truth is not None and current.ground_truth is not None:
            segment.ground_truth[step, columns] = unchecked_torch_view(current.ground_truth)
        acted = self.agent.act(current.observation, memory, self.generator)
        for key, part in acted.observation.items():
            segment.observation[key][step, columns] = part
        segment.action[step, columns] = acted.action
        segment.log_prob[step, columns] = acted.log_prob
        segment.value[step, columns] = acted.value
        return acted.action.cpu().numpy()

    def _receive(self, group: int, step: int) -> list[dict[str, float]]:
        columns, received = self._columns(group), self.environments.receive(group)
        self.current[group] = received
        self.segment.reward[step, columns] = unchecked_torch_view(received.reward)
        done = torch.from_numpy(received.done).to(self.agent.device)
        self.segment.done[step, columns] = done
        self.memories[group].forget(done)
        return received.episodes

    def _columns(self, group: int) -> slice:
        return slice(group * self.environments.per_group, (group + 1) * self.environments.per_group)
