"""The agent: encoder, memory, body and heads.

```python
memory = agent.initial_memory(num_envs)
while playing:
    acted = agent.act(observation, memory)          # memory is brought up to date
    observation, done = step(acted.action)
    memory.forget(done)                             # where an episode has ended
```
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from endless_gym.agents.encoders import FRAME, Encoder, Observation, Shapes, orthogonal
from endless_gym.agents.heads import GroundTruthHead, PolicyHead, ReconstructionHead, ValueHead
from endless_gym.agents.memory import Memory, NoMemory, Plan, State
from endless_gym.agents.naive import ObserverState, make_observer
from endless_gym.agents.recurrent import RecurrentMemory
from endless_gym.agents.settings import Settings
from endless_gym.agents.transformer import TransformerMemory
from endless_gym.interop import unchecked_torch_view
from endless_gym.specs import Frames, Spec


@dataclass
class AgentMemory:
    """What the agent keeps of n environments between two steps.

    Attributes:
        first: Which environments' next observation starts an episode, bool (n,).
        observer: The observer's state.
        state: The memory's state.
    """

    first: Tensor
    observer: ObserverState
    state: State

    def forget(self, done: Tensor | NDArray[np.bool_]) -> None:
        """The next observation of these environments, bool (n,), starts an episode."""
        self.first = self.first | torch.as_tensor(done, device=self.first.device)

    def tensors(self) -> dict[str, Any]:
        """All of it, for a checkpoint."""
        return {"first": self.first, "observer": self.observer.kept, "state": self.state.tensors()}

    def load(self, tensors: dict[str, Any]) -> None:
        """The reverse of `tensors`."""
        device = self.first.device
        self.first = tensors["first"].to(device)
        self.observer.kept = {name: kept.to(device) for name, kept in tensors["observer"].items()}
        self.state.load(tensors["state"])


@dataclass
class Acted:
    """One decision for each of n environments.

    Attributes:
        action: int64 (n, branches).
        log_prob: Of each branch's choice, (n, branches).
        value: The expected return, (n,).
        observation: What the agent observed, as it is learned from.
    """

    action: Tensor
    log_prob: Tensor
    value: Tensor
    observation: Observation


@dataclass
class Evaluated:
    """What the network says of a minibatch of M steps.

    Attributes:
        logits: Of each branch, normalised to log-probabilities, list of (M, choices).
        value: (M,)
        frame: Logits of the reconstructed frame, (M, channels, 84, 84), if there is such a head.
        ground_truth: (M, entries), if there is such a head.
    """

    logits: list[Tensor]
    value: Tensor
    frame: Tensor | None
    ground_truth: Tensor | None

    def log_prob(self, actions: Tensor) -> Tensor:
        """Of actions int64 (M, branches): (M, branches)."""
        chosen = [logits.gather(1, actions[:, i : i + 1]) for i, logits in enumerate(self.logits)]
        return torch.cat(chosen, dim=1)

    def entropy(self) -> Tensor:
        """Summed over the branches, (M,)."""
        return torch.stack([-(logits.exp() * logits).sum(-1) for logits in self.logits]).sum(0)


class Agent(nn.Module):
    """An actor-critic with memory, for environments with a given observation and action space."""

    def __init__(
        self,
        settings: Settings,
        shapes: Shapes,
        branches: Sequence[int],
        ground_truth: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Make an agent with fresh weights.

        Args:
            settings: Of the network and its memory.
            shapes: Of one environment's observation, as `observation_shapes` gives them.
            branches: Choices of each branch of the action.
            ground_truth: Entries of the environment's ground truth.
            device: Where to compute.

        Raises:
            ValueError: The settings ask for what these environments do not have.
        """
        super().__init__()
        self.settings, self.device = settings, torch.device(device)
        self.branches = tuple(branches)
        self.observer = make_observer(settings, shapes, self.device)
        self.encoder = Encoder(self.observer.shapes, settings.model.vector_width)
        self.memory: Memory
        if settings.agent == "gru" or settings.agent == "lstm":
            self.memory = RecurrentMemory(settings.agent, self.encoder.width, settings.recurrence, self.device)
        elif settings.agent == "trxl" or settings.agent == "gtrxl":
            gating = settings.transformer.gating or settings.agent == "gtrxl"
            transformer = dataclasses.replace(settings.transformer, window=settings.window(), gating=gating)
            self.memory = TransformerMemory(self.encoder.width, transformer, settings.positions(), self.device)
        else:
            self.memory = NoMemory(self.encoder.width, self.device)
        remembers = not isinstance(self.memory, NoMemory)
        width = settings.model.body_width or (self.memory.width if remembers else settings.recurrence.hidden_size)
        self.body = nn.Sequential(orthogonal(nn.Linear(self.memory.width, width)), nn.ReLU())
        self.policy = PolicyHead(width, settings.model.head_width, branches)
        self.value = ValueHead(width, settings.model.head_width, settings.model.value_gain)
        self.reconstruction: ReconstructionHead | None = None
        if settings.ppo.reconstruction_coefficient:
            if FRAME not in shapes:
                raise ValueError("there are no frames to reconstruct; observe `rgb` or set the coefficient to 0")
            self.reconstruction = ReconstructionHead(self.memory.width, self.observer.shapes[FRAME][-1])
        self.ground_truth: GroundTruthHead | None = None
        if settings.ppo.ground_truth_coefficient:
            if not ground_truth:
                raise ValueError(
                    f"{settings.env} has no ground truth; set the coefficient to 0 or take an endless environment"
                )
            self.ground_truth = GroundTruthHead(self.memory.width, settings.model.head_width, ground_truth)
        self.to(self.device)
        self.to(memory_format=torch.channels_last)

    @property
    def num_parameters(self) -> int:
        """How many numbers are learned."""
        return sum(parameter.numel() for parameter in self.parameters())

    def compile_parts(self) -> None:
        """Compile what has the same shapes, or nearly, in each call."""
        parts: list[nn.Module | None] = [
            self.encoder,
            self.body,
            self.policy,
            self.value,
            self.reconstruction,
            self.ground_truth,
        ]
        if isinstance(self.memory, TransformerMemory):
            parts += [*self.memory.blocks]
        for part in parts:
            if part is not None:
                part.compile()

    def initial_memory(self, num_envs: int) -> AgentMemory:
        """The memory of environments whose next observations start episodes."""
        first = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        return AgentMemory(first, self.observer.initial_state(num_envs), self.memory.initial_state(num_envs))

    @torch.no_grad()
    def act(
        self,
        observation: Any,
        memory: AgentMemory,
        generator: torch.Generator | None = None,
        greedy: bool = False,
    ) -> Acted:
        """Decide, and remember.

        Args:
            observation: As a vector environment returns it, or a dict of tensors.
            memory: Of the same environments; it is brought up to date.
            generator: Of the draws, on the agent's device; PyTorch's own if there is none.
            greedy: Take the most likely action instead of drawing one.
        """
        observed, news = self.observer.observe(self.tensors(observation), memory.observer, memory.first)
        with self._precision():
            hidden, latent = self.memory.step(self.encoder(observed), memory.state, memory.first)
            self.memory.remember(memory.state, latent)
            hidden = self.body(hidden)
            logits, value = self.policy(hidden), self.value(hidden)
        self.observer.remember(memory.observer, news)
        memory.first = torch.zeros_like(memory.first)
        actions, log_probs = [], []
        for branch in logits:
            branch = branch.log_softmax(-1)
            action = branch.argmax(-1, keepdim=True) if greedy else self._draw(branch, generator)
            actions.append(action)
            log_probs.append(branch.gather(1, action))
        return Acted(torch.cat(actions, 1), torch.cat(log_probs, 1), value, observed)

    @torch.no_grad()
    def estimate(self, observation: Any, memory: AgentMemory) -> Tensor:
        """The expected return (n,); nothing is remembered."""
        observed, _ = self.observer.observe(self.tensors(observation), memory.observer, memory.first)
        with self._precision():
            hidden, _ = self.memory.step(self.encoder(observed), memory.state, memory.first)
            value: Tensor = self.value(self.body(hidden))
        return value

    def evaluate(self, observation: Observation, plan: Plan) -> Evaluated:
        """The network's outputs, with gradients, for the observations of a plan's steps, (M, ...) each."""
        with self._precision():
            remembered = self.memory(self.encoder(observation), plan)
            hidden = self.body(remembered)
            logits, value = self.policy(hidden), self.value(hidden)
            frame = self.reconstruction(remembered) if self.reconstruction is not None else None
            truth = self.ground_truth(remembered) if self.ground_truth is not None else None
        return Evaluated([branch.log_softmax(-1) for branch in logits], value, frame, truth)

    def tensors(self, observation: Any) -> Observation:
        """A vector environment's observation as tensors on the agent's device; frames stay uint8."""
        if not isinstance(observation, Mapping):
            observation = {next(iter(self._keys())): observation}
        return {
            key: (value if isinstance(value, Tensor) else unchecked_torch_view(value)).to(
                self.device, non_blocking=True
            )
            for key, value in observation.items()
        }

    def _keys(self) -> list[str]:
        return [key for key in self.observer.shapes if key != "position"]

    def _draw(self, log_probs: Tensor, generator: torch.Generator | None) -> Tensor:
        """One choice for each row, by the Gumbel trick: int64 (n, 1)."""
        noise = torch.empty_like(log_probs).exponential_(generator=generator).log_()
        return (log_probs - noise).argmax(-1, keepdim=True)

    def _precision(self) -> torch.autocast:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.settings.bf16)


def observation_shapes(spec: Spec, observation: str) -> dict[str, tuple[int, ...]]:
    """Shapes of one environment's observation by key; `observation` is `rgb` or `features`."""
    space = spec.observation_space(Frames() if observation == "rgb" else None, observation == "features")
    if not isinstance(space, spaces.Dict):
        space = spaces.Dict({FRAME if observation == "rgb" else "features": space})
    return {key: tuple(part.shape or ()) for key, part in space.items()}


def make_agent(settings: Settings, spec: Spec, device: torch.device | str = "cpu") -> Agent:
    """A fresh agent for an environment."""
    shapes = observation_shapes(spec, settings.environment.observation)
    return Agent(settings, shapes, spec.branches, spec.ground_truth, device)
