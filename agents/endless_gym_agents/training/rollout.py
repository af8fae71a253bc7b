"""Collection of rollouts: segments of T steps in N environments.

The environments are divided into groups. While the agent computes the actions of one group, the other groups step. A segment
continues the episodes of the previous one.

Between an observation and the actions, only what the actions need is computed: the observation is copied to its place in the
segment, the network reads it there, and the copy of the actions is the only operation that waits for the device. The memory is
updated while the environments step; log-probabilities and values are computed from the stored outputs at the end of the segment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from endless_gym_agents.agent.agent import Agent, AgentMemory
from endless_gym_agents.agent.encoders import FRAME, Observation
from endless_gym_agents.agent.transforms import ObservationTransform, TransformState
from endless_gym_agents.common.clock import Clock
from endless_gym_agents.environments.groups import Environments, StepResult
from endless_gym_agents.environments.ranks import Ranks
from endless_gym_agents.training.repeats import EmbeddedFrames
from endless_gym_agents.training.transfers import HostCopy, Upload, host_tensor


@dataclass
class Segment:
    """T steps of N environments, on the agent's device.

    Attributes:
        observation: Transformed observations before each step, (T, N, ...) each; frames uint8, vectors float32.
        reset_mask: Whether the observation is the first of an episode, bool (T, N).
        action: int64 (T, N, branches).
        log_prob: Log-probability of the choice in each branch, float32 (T, N, branches).
        value: Value estimate of the observation, float32 (T, N).
        reward: Reward of the step, float32 (T, N); with `PPO.bootstrap_truncated`, plus the discounted value at a time limit.
        done: Whether the step ended its episode, bool (T, N).
        ground_truth: Ground truth of the observation, float32 (T, N, entries); None if the agent does not estimate it.
        last_value: Bootstrap value: the value estimate of the observation after the last step, float32 (N,).
        first_occurrence: Index t * N + n of the first step with an equal observation, int64 (T, N); None if unknown.
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
    first_occurrence: Tensor | None = None

    def flat(self) -> Segment:
        """The segment with steps and environments in one dimension, (T * N, ...); step t of environment n has index t * N + n."""

        def flatten(part: Any) -> Any:
            if isinstance(part, dict):
                return {key: flatten(each) for key, each in part.items()}
            return None if part is None else part.flatten(0, 1)

        parts = {name: flatten(part) for name, part in vars(self).items() if name != "last_value"}
        return replace(self, **parts)

    def distinct(self, indices: Tensor) -> tuple[Observation, Tensor | None]:
        """The observations of steps of a flattened segment; equal ones only once if `first_occurrence` is known.

        Args:
            indices: Indices of M steps, int64 (M,).

        Returns:
            The observations, (rows, ...) each, and the row of each step, int64 (M,); `None` if there is one row per step.
        """
        rows = None
        if self.first_occurrence is not None:
            indices, rows = self.first_occurrence.index_select(0, indices).unique(return_inverse=True)
        return {key: part.index_select(0, indices) for key, part in self.observation.items()}, rows


@dataclass
class Columns:
    """The part of a segment that belongs to one group of n environments, as views of the tensors for each step.

    Attributes:
        observation: Transformed observations by key.
        action: int64 (n, branches).
        outputs: Logits and value, float32 (n, outputs).
        outcome: Rewards and ends of episodes, float32 (2, n), before each step and after the last.
        ground_truth: float32 (n, entries); empty if the agent does not estimate it.
    """

    observation: list[Observation]
    action: Sequence[Tensor]
    outputs: Sequence[Tensor]
    outcome: Sequence[Tensor]
    ground_truth: Sequence[Tensor]


class RolloutCollector:
    """Collects consecutive segments with an agent, in preallocated tensors.

    Attributes:
        memories: The agent's memory of each group of environments.
        current: The latest result of each group.
    """

    def __init__(
        self,
        agent: Agent,
        environments: Environments,
        steps: int,
        generator: torch.Generator,
        ranks: Ranks | None = None,
    ) -> None:
        """Reset the environments and allocate the segment.

        Args:
            agent: The agent that acts.
            environments: The environments.
            steps: Steps of a segment.
            generator: Generator that samples the actions, on the agent's device; in the same state on every rank.
            ranks: The ranks of the run; `None` for this process alone.
        """
        self.agent, self.environments, self.steps, self.generator = agent, environments, steps, generator
        groups, per_group, device = environments.groups, environments.per_group, agent.device
        self._envs_everywhere = groups * per_group * (ranks or Ranks()).size
        self._own = (ranks or Ranks()).share(self._envs_everywhere)
        self.memories: list[AgentMemory] = [agent.initial_memory(per_group) for _ in range(groups)]
        self.current: list[StepResult] = [environments.reset(group) for group in range(groups)]
        shape, branches = (steps, groups * per_group), len(agent.branches)
        self._observation = {
            key: torch.zeros((*shape, *part), dtype=torch.uint8 if key == FRAME else torch.float32, device=device)
            for key, part in agent.transform.shapes.items()
        }
        self._action = torch.zeros((*shape, branches), dtype=torch.long, device=device)
        self._outputs = torch.zeros((*shape, branches * max(agent.branches) + 1), device=device)
        # Before each step, and after the last.
        self._outcome = torch.zeros((steps + 1, 2, shape[1]), device=device)
        self._last_value = torch.zeros(shape[1], device=device)
        self._ground_truth: Tensor | None = None
        if agent.ground_truth is not None:
            self._ground_truth = torch.zeros((*shape, environments.spec.ground_truth), device=device)
        are_frames = list(agent.observation_shapes) == [FRAME] and type(agent.transform) is ObservationTransform
        self._frames: EmbeddedFrames | None = None
        if are_frames and device.type == "cpu":
            self._frames = EmbeddedFrames(self._observation[FRAME].flatten(0, 1))
        self._parts = [self._columns(self._slice(group)) for group in range(groups)]
        self._actions = [HostCopy((per_group, branches), torch.long, device) for _ in range(groups)]
        self._uploads = [Upload(device) for _ in range(groups)]
        # Rewards and ends of episodes, for their upload.
        self._outcomes = [host_tensor((2, per_group), torch.float32, device).numpy() for _ in range(groups)]

    def collect(self, clock: Clock) -> tuple[Segment, list[dict[str, float]]]:
        """Collect one segment.

        Args:
            clock: Measures the phases `stepping` and `inference`.

        Returns:
            The segment, whose tensors the next call overwrites, and the final infos of the episodes that ended.
        """
        episodes: list[dict[str, float]] = []
        self.agent.refresh()
        if self._frames is not None:
            self._frames.clear()
        # Drawn for the environments of all ranks, so that actions do not depend on the number of ranks.
        noise = self.agent.noise((self.steps, self._envs_everywhere), self.generator)
        noise = noise[:, self._own.start : self._own.stop]
        for group, memory in enumerate(self.memories):
            self.agent.memory.begin_segment(memory.state, self.steps)
            self._outcome[0, 1, self._slice(group)] = memory.reset_mask
        noises = [noise[:, self._slice(group)].unbind() for group in range(self.environments.groups)]
        for step in range(self.steps):
            for group in range(self.environments.groups):
                if step:
                    with clock.measure("stepping"):
                        episodes += self._receive(group, step - 1)
                self._act(group, step, noises[group][step], clock)
        for group, memory in enumerate(self.memories):
            with clock.measure("stepping"):
                episodes += self._receive(group, self.steps - 1)
            with clock.measure("inference"):
                value = self.agent.bootstrap_value(self._uploaded(group), memory)
                self._last_value[self._slice(group)] = value
        return self._segment(), episodes

    def state_dict(self) -> dict[str, Any]:
        """The memories and snapshots of the environments, for a checkpoint between two segments."""
        return {
            "memories": [memory.state_dict() for memory in self.memories],
            "environments": self.environments.snapshots(),
            "wrappers": self.environments.wrapper_states(),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned, for the same settings."""
        self.environments.load_wrapper_states(state_dict.get("wrappers"))
        self.current = self.environments.restore(state_dict["environments"])
        for memory, memory_state in zip(self.memories, state_dict["memories"], strict=True):
            memory.load_state_dict(memory_state)

    def start_episodes(self, environments: list[list[list[bytes]]]) -> None:
        """Start new episodes after resuming a run that had a different number of ranks.

        Args:
            environments: The snapshots of each rank, by group.
        """
        # In the order of the environments' numbers.
        snapshots = [snapshot for rank in environments for group in rank for snapshot in group]
        own = snapshots[self._own.start : self._own.stop]
        groups, per_group = self.environments.groups, self.environments.per_group
        self.environments.restore([own[group * per_group :][:per_group] for group in range(groups)])
        self.current = [self.environments.reset(group) for group in range(groups)]

    def _act(self, group: int, step: int, noise: Tensor, clock: Clock) -> None:
        memory, current, part, agent = self.memories[group], self.current[group], self._parts[group], self.agent
        upload = self._uploads[group]
        with clock.measure("inference"):
            slots, update = part.observation[step], TransformState()
            if type(agent.transform) is ObservationTransform:
                # Copy straight into the segment, where the network reads it.
                for key, value in agent.as_mapping(current.observation).items():
                    upload.copy(value, slots[key])
                observed = slots
            else:
                observed, update = agent.observe(self._uploaded(group), memory)
            decision = agent.decide(observed, memory, noise, self._embedded(group, step))
            actions = self._actions[group]
            actions.start(decision.action)
            actions.wait()
            # Releases arrays. It does not wait: these copies were begun before that of the actions.
            upload.wait()
        with clock.measure("stepping"):
            self.environments.send(actions.array, group)
        with clock.measure("inference"):
            # From here on the environments step.
            agent.remember(memory, decision, update)
            if observed is not slots:
                for key, value in observed.items():
                    slots[key].copy_(value)
            part.action[step].copy_(decision.action)
            part.outputs[step].copy_(decision.outputs)
            if part.ground_truth and current.ground_truth is not None:
                upload.copy(current.ground_truth, part.ground_truth[step])

    def _uploaded(self, group: int) -> Observation:
        """The current observation of a group, in tensors of its own on the agent's device."""
        given = self.agent.as_mapping(self.current[group].observation)
        return self.agent.to_tensors({key: self._uploads[group].tensor(value) for key, value in given.items()})

    def _embedded(self, group: int, step: int) -> Tensor | None:
        """What `Agent.embed` returns for an observation in the segment; None without the cache of equal frames."""
        if self._frames is None:
            return None
        columns = self._slice(group)
        start = step * self._action.shape[1]
        frames = range(start + columns.start, start + columns.stop)
        return self._frames.embed(frames, lambda new: self.agent.embed({FRAME: new}))

    def _receive(self, group: int, step: int) -> list[dict[str, float]]:
        result = self.environments.receive(group)
        self.current[group] = result
        outcome = self._parts[group].outcome[step + 1]
        # One copy for both. `_act` has waited for the last one.
        self._outcomes[group][0], self._outcomes[group][1] = result.reward, result.done
        memory = self.memories[group]
        if self.agent.settings.ppo.bootstrap_truncated and result.truncated.any():
            self._outcomes[group][0] += self._values_beyond(result, memory)
        self._uploads[group].copy(self._outcomes[group], outcome)
        memory.reset_mask = outcome[1].bool() if result.done.any() else memory.no_reset
        return result.episodes

    def _values_beyond(self, result: StepResult, memory: AgentMemory) -> NDArray[np.float32]:
        """Discounted values of the last observations where a time limit ended the episode, else 0, float32 (n,)."""
        if result.final is None:
            raise ValueError("--ppo.bootstrap-truncated needs `final_obs`; a wrapper drops it from `info`")
        agent = self.agent
        observation = {key: np.array(value) for key, value in agent.as_mapping(result.observation).items()}
        for env in np.flatnonzero(result.truncated):
            for key, value in agent.as_mapping(result.final[env]).items():
                observation[key][env] = value
        values: NDArray[np.float32] = agent.bootstrap_value(observation, memory).cpu().numpy()
        return agent.settings.ppo.gamma * values * result.truncated

    @torch.no_grad()
    def _segment(self) -> Segment:
        """The collected segment, with the log-probabilities and values from the outputs of all its steps."""
        ends = self._outcome[:, 1].bool()
        return Segment(
            observation=self._observation,
            reset_mask=ends[:-1],
            action=self._action,
            log_prob=self.agent.acting_weights().log_prob(self._outputs, self._action),
            value=self._outputs[..., -1].contiguous(),
            reward=self._outcome[1:, 0].contiguous(),
            done=ends[1:],
            ground_truth=self._ground_truth,
            last_value=self._last_value,
            first_occurrence=None if self._frames is None else self._frames.first.view(self._action.shape[:2]),
        )

    def _slice(self, group: int) -> slice:
        return slice(group * self.environments.per_group, (group + 1) * self.environments.per_group)

    def _columns(self, columns: slice) -> Columns:
        """The views of a group; made once, since making a view costs as much as a small operation."""
        parts = {key: part[:, columns].unbind() for key, part in self._observation.items()}
        return Columns(
            observation=[{key: part[step] for key, part in parts.items()} for step in range(self.steps)],
            action=self._action[:, columns].unbind(),
            outputs=self._outputs[:, columns].unbind(),
            outcome=self._outcome[:, :, columns].unbind(),
            ground_truth=() if self._ground_truth is None else self._ground_truth[:, columns].unbind(),
        )
