"""Collection of rollouts: segments of T steps in N environments.

The environments are divided into groups. While the agent computes the actions of one group, the other groups are stepped. A
segment continues the episodes of the previous one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endless_gym.agents.agent import Agent, AgentMemory
from endless_gym.agents.clock import Clock
from endless_gym.agents.encoders import FRAME, Observation
from endless_gym.agents.environments import Environments, StepResult
from endless_gym.interop import unchecked_torch_view


@dataclass
class Segment:
    """T steps of N environments, on the agent's device.

    Attributes:
        observation: Transformed observations before each step, (T, N, ...) each; frames uint8, vectors float32.
        reset_mask: Whether the observation is the first of an episode, bool (T, N).
        action: int64 (T, N, branches).
        log_prob: Log-probability of the choice in each branch, float32 (T, N, branches).
        value: Value estimate of the observation, float32 (T, N).
        reward: Reward of the step, float32 (T, N).
        done: Whether the step ended its episode, bool (T, N).
        ground_truth: Ground truth of the observation, float32 (T, N, entries); None if the agent does not estimate it.
        last_value: Bootstrap value: the value estimate of the observation after the last step, float32 (N,).
    """

    observation: Observation
    reset_mask: Tensor
    action: Tensor
    log_prob: Tensor
    value: Tensor
    reward: Tensor
    done: Tensor
    ground_truth: Tensor | None
    last_value: Tensor

    def flat(self) -> Segment:
        """The segment with steps and environments in one dimension, (T * N, ...); step t of environment n has index t * N + n."""

        def flatten(tensor: Tensor) -> Tensor:
            return tensor.flatten(0, 1)

        return Segment(
            observation={key: flatten(part) for key, part in self.observation.items()},
            reset_mask=flatten(self.reset_mask),
            action=flatten(self.action),
            log_prob=flatten(self.log_prob),
            value=flatten(self.value),
            reward=flatten(self.reward),
            done=flatten(self.done),
            ground_truth=None if self.ground_truth is None else flatten(self.ground_truth),
            last_value=self.last_value,
        )


class RolloutCollector:
    """Collects consecutive segments with an agent, in one preallocated `Segment`.

    Attributes:
        memories: The agent's memory of each group of environments.
        current: The latest result of each group.
        segment: The segment, overwritten by each `collect`.
    """

    def __init__(self, agent: Agent, environments: Environments, steps: int, generator: torch.Generator) -> None:
        """Reset the environments and allocate the segment.

        Args:
            agent: The agent that acts.
            environments: The environments.
            steps: Steps of a segment.
            generator: Generator that samples the actions, on the agent's device.
        """
        self.agent, self.environments, self.steps, self.generator = agent, environments, steps, generator
        groups, per_group = environments.groups, environments.per_group
        self.memories: list[AgentMemory] = [agent.initial_memory(per_group) for _ in range(groups)]
        self.current: list[StepResult] = [environments.reset(group) for group in range(groups)]
        shape = (steps, groups * per_group)

        def empty(*more: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros((*shape, *more), dtype=dtype, device=agent.device)

        branches = len(agent.branches)
        self.segment = Segment(
            observation={
                key: empty(*part, dtype=torch.uint8 if key == FRAME else torch.float32)
                for key, part in agent.transform.shapes.items()
            },
            reset_mask=empty(dtype=torch.bool),
            action=empty(branches, dtype=torch.long),
            log_prob=empty(branches),
            value=empty(),
            reward=empty(),
            done=empty(dtype=torch.bool),
            ground_truth=empty(environments.spec.ground_truth) if agent.ground_truth is not None else None,
            last_value=torch.zeros(shape[1], device=agent.device),
        )

    def collect(self, clock: Clock) -> tuple[Segment, list[dict[str, float]]]:
        """Collect one segment.

        Args:
            clock: Measures the phases `stepping` and `inference`.

        Returns:
            The segment, which the next call overwrites, and the final infos of the episodes that ended.
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
                value = self.agent.bootstrap_value(self.current[group].observation, memory)
                self.segment.last_value[self._columns(group)] = value
        return self.segment, episodes

    def state_dict(self) -> dict[str, Any]:
        """The memories and snapshots of the environments, for a checkpoint between two segments."""
        return {
            "memories": [memory.state_dict() for memory in self.memories],
            "environments": self.environments.snapshots(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned, for the same settings."""
        self.current = self.environments.restore(state_dict["environments"])
        for memory, memory_state in zip(self.memories, state_dict["memories"], strict=True):
            memory.load_state_dict(memory_state)

    def _act(self, group: int, step: int) -> NDArray[np.int64]:
        columns, memory, current, segment = (
            self._columns(group),
            self.memories[group],
            self.current[group],
            self.segment,
        )
        segment.reset_mask[step, columns] = memory.reset_mask
        if segment.ground_truth is not None and current.ground_truth is not None:
            segment.ground_truth[step, columns] = unchecked_torch_view(current.ground_truth)
        output = self.agent.act(current.observation, memory, self.generator)
        for key, part in output.observation.items():
            segment.observation[key][step, columns] = part
        segment.action[step, columns] = output.action
        segment.log_prob[step, columns] = output.log_prob
        segment.value[step, columns] = output.value
        action: NDArray[np.int64] = output.action.cpu().numpy()
        return action

    def _receive(self, group: int, step: int) -> list[dict[str, float]]:
        columns, result = self._columns(group), self.environments.receive(group)
        self.current[group] = result
        self.segment.reward[step, columns] = unchecked_torch_view(result.reward)
        done = torch.from_numpy(result.done).to(self.agent.device)
        self.segment.done[step, columns] = done
        self.memories[group].reset(done)
        return result.episodes

    def _columns(self, group: int) -> slice:
        return slice(group * self.environments.per_group, (group + 1) * self.environments.per_group)
