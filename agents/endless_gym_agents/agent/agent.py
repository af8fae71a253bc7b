"""The agent: an actor-critic of encoder, memory, body and heads.

```python
from endless_gym import make_vec, spec
from endless_gym_agents.agent import make_agent
from endless_gym_agents.settings import PRESETS

settings = PRESETS["quick"]                          # with feature observations
agent = make_agent(settings, spec(settings.env))
with make_vec(settings.env, 8, observation="features", autoreset="same_step") as envs:
    observation, info = envs.reset(seed=0)
    memory = agent.initial_memory(envs.num_envs)
    for _ in range(100):
        output = agent.act(observation, memory)      # updates the memory
        observation, reward, done, _, info = envs.step(output.action.numpy())
        memory.reset(done)                           # where an episode has ended
```

`act` is `observe`, `decide` and `remember`. A rollout sends the actions after `decide`, so that the environments step while
`remember` updates the memory.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor, nn

from endless_gym.interop import torch_view
from endless_gym.specs import Frames, Spec
from endless_gym_agents.agent.acting import ActingWeights, acting_weights, weights_version
from endless_gym_agents.agent.encoders import FRAME, Encoder, Observation, OwnEncoder, Shapes
from endless_gym_agents.agent.heads import Perceptron, PolicyHead, ReconstructionHead, ValueHead
from endless_gym_agents.agent.transforms import FrameStack, ObservationTransform, PositionalEncoding, TransformState
from endless_gym_agents.common import own
from endless_gym_agents.environments import wrappers
from endless_gym_agents.memories.layers import linear_relu, orthogonal
from endless_gym_agents.memories.memory import AnyMemory, MemoryState, Minibatch, NoMemory
from endless_gym_agents.memories.recurrent import RecurrentMemory
from endless_gym_agents.memories.transformer import TransformerMemory
from endless_gym_agents.settings import Settings

#: An array or tensor of n environments, (n, ...).
Array: TypeAlias = NDArray[Any] | Tensor
#: An observation as a vector environment returns it: an array, or a mapping if the observation space is a dict.
RawObservation: TypeAlias = Array | Mapping[str, Array]


@dataclass
class AgentMemory:
    """The agent's memory of n environments between two steps.

    Attributes:
        reset_mask: Whether the next observation is the first of an episode, bool (n,).
        transform_state: State of the observation transform.
        state: State of the memory.
    """

    reset_mask: Tensor
    transform_state: TransformState
    state: MemoryState

    def __post_init__(self) -> None:
        """Make the mask of a step at which no episode starts."""
        self.no_reset = torch.zeros_like(self.reset_mask)

    def reset(self, done: Tensor | NDArray[np.bool_]) -> None:
        """Mark the next observation as the first of an episode where `done`, bool (n,), is true."""
        done = done if isinstance(done, Tensor) else torch_view(done)
        self.reset_mask = self.reset_mask | done.to(self.reset_mask.device)

    def state_dict(self) -> dict[str, Any]:
        """Everything as tensors and numbers by name, for a checkpoint."""
        # The checkpoint format fixes these keys.
        return {"first": self.reset_mask, "observer": self.transform_state, "state": self.state.state_dict()}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load what `state_dict` returned, for the same number of environments; tensors are moved to this memory's device."""
        device = self.reset_mask.device
        self.reset_mask = state_dict["first"].to(device)
        self.transform_state = {name: tensor.to(device) for name, tensor in state_dict["observer"].items()}
        self.state.load_state_dict(state_dict["state"])


@dataclass
class ActOutput:
    """The agent's output for one step of n environments.

    Attributes:
        action: int64 (n, branches).
        log_prob: Log-probability of the choice in each branch, float32 (n, branches).
        value: Value estimate, float32 (n,).
        observation: The transformed observation that the network received, as stored for learning.
    """

    action: Tensor
    log_prob: Tensor
    value: Tensor
    observation: Observation


@dataclass
class Decision:
    """What `Agent.decide` returns for one step of n environments.

    Attributes:
        action: int64 (n, branches).
        outputs: Logits and value, float32 (n, outputs); see `ActingWeights.heads`.
        memory_update: What `Agent.remember` writes into the memory.
    """

    action: Tensor
    outputs: Tensor
    memory_update: Any


@dataclass
class AgentOutput:
    """The network's outputs for a minibatch of M steps, with gradients.

    Attributes:
        logits: Log-probabilities of all choices of each branch, list of float32 (M, choices).
        value: Value estimates, float32 (M,).
        frame: Logits of the reconstructed frames, float32 (M, channels, 84, 84); None without a reconstruction head.
        ground_truth: Estimates of the ground truth, float32 (M, entries); None without a ground-truth head.
    """

    logits: list[Tensor]
    value: Tensor
    frame: Tensor | None
    ground_truth: Tensor | None

    def log_prob(self, actions: Tensor) -> Tensor:
        """Log-probabilities of actions int64 (M, branches), float32 (M, branches)."""
        chosen = [logits.gather(1, actions[:, i : i + 1]) for i, logits in enumerate(self.logits)]
        return torch.cat(chosen, dim=1)

    def entropy(self) -> Tensor:
        """Entropy of the policy, summed over the branches, float32 (M,)."""
        return torch.stack([-(logits.exp() * logits).sum(-1) for logits in self.logits]).sum(0)


class Agent(nn.Module):
    """An actor-critic with memory, for environments with a given observation and action space.

    `act` computes one step while a rollout is collected; `forward` computes a minibatch with gradients.
    """

    def __init__(
        self,
        settings: Settings,
        shapes: Shapes,
        branches: Sequence[int],
        ground_truth: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        """Make an agent with newly initialised weights.

        Args:
            settings: Settings of the network and its memory.
            shapes: Shapes of one environment's observation, by key.
            branches: Number of choices of each branch of the action.
            ground_truth: Entries of the environment's ground truth; 0 if it has none.
            device: Device of the weights and the memories.

        Raises:
            ValueError: Reconstruction without frames, or a ground-truth loss without ground truth.
        """
        super().__init__()
        self.settings, self.device = settings, torch.device(device)
        recurrence = settings.recurrence
        if recurrence.match_gru:
            size = matched_hidden_size(settings, shapes, branches, ground_truth)
            recurrence = dataclasses.replace(recurrence, hidden_size=size)
        self.branches = tuple(branches)
        #: Shapes of one environment's observation, by key.
        self.observation_shapes = {key: tuple(shape) for key, shape in shapes.items()}
        self.transform = ObservationTransform(shapes)
        if settings.agent == "stack":
            self.transform = FrameStack(shapes, settings.model.stack, self.device)
        elif settings.agent == "position":
            self.transform = PositionalEncoding(shapes, self.device)
        if settings.encoder:
            own_encoder = own.load("--encoder", settings.encoder, nn.Module)
            self.encoder: Encoder = OwnEncoder(own_encoder, self.transform.shapes, settings.options("encoder_option"))
        else:
            self.encoder = Encoder(self.transform.shapes, settings.model.vector_width)
        self.memory: AnyMemory
        if settings.agent == "gru" or settings.agent == "lstm":
            self.memory = RecurrentMemory(settings.agent, self.encoder.width, recurrence, self.device)
        elif settings.agent == "trxl" or settings.agent == "gtrxl":
            gating = settings.transformer.gating or settings.agent == "gtrxl"
            transformer = dataclasses.replace(settings.transformer, window=settings.window(), gating=gating)
            self.memory = TransformerMemory(self.encoder.width, transformer, settings.positions(), self.device)
        elif settings.agent_class:
            layer = own.load("--agent", settings.agent_class, nn.Module)
            self.memory = RecurrentMemory(
                layer, self.encoder.width, recurrence, self.device, settings.options("agent_option")
            )
        else:
            self.memory = NoMemory(self.encoder.width, self.device)
        has_memory = not isinstance(self.memory, NoMemory)
        width = settings.model.body_width or (self.memory.width if has_memory else recurrence.hidden_size)
        self.body = nn.Sequential(orthogonal(nn.Linear(self.memory.width, width)), nn.ReLU())
        self.policy = PolicyHead(width, settings.model.head_width, branches)
        self.value = ValueHead(width, settings.model.head_width, settings.model.value_gain)
        self.reconstruction: ReconstructionHead | None = None
        if settings.ppo.reconstruction_coefficient:
            if FRAME not in shapes:
                raise ValueError(
                    "--ppo.reconstruction-coefficient needs frames, and the observation has only "
                    f"{', '.join(shapes)}; use --environment.observation rgb or the coefficient 0"
                )
            self.reconstruction = ReconstructionHead(self.memory.width, self.transform.shapes[FRAME][-1])
        self.ground_truth: Perceptron | None = None
        if settings.ppo.ground_truth_coefficient:
            if not ground_truth:
                raise ValueError(
                    f"--ppo.ground-truth-coefficient needs a ground truth, and {settings.env} has none; "
                    "use an endless environment or the coefficient 0"
                )
            self.ground_truth = Perceptron(self.memory.width, settings.model.head_width, ground_truth)
        self._weights: ActingWeights | None = None
        self._watched: list[nn.Parameter] = []
        self.to(self.device)
        self.to(memory_format=torch.channels_last)

    @property
    def num_parameters(self) -> int:
        """Number of trainable parameters."""
        return sum(parameter.numel() for parameter in self.parameters())

    def initial_memory(self, num_envs: int) -> AgentMemory:
        """A new memory for `num_envs` environments, all at the start of an episode."""
        reset_mask = torch.ones(num_envs, dtype=torch.bool, device=self.device)
        return AgentMemory(reset_mask, self.transform.initial_state(num_envs), self.memory.initial_state(num_envs))

    @torch.no_grad()
    def act(
        self,
        observation: RawObservation,
        memory: AgentMemory,
        generator: torch.Generator | None = None,
        greedy: bool = False,
    ) -> ActOutput:
        """Choose actions for one observation, and update the memory.

        Args:
            observation: Observation of n environments, as a vector environment returns it, or a dict of tensors.
            memory: Memory of the same n environments; updated in place.
            generator: Generator that samples the actions, on the agent's device; None for PyTorch's default generator.
            greedy: Take the most likely choice of each branch instead of sampling.

        Raises:
            ValueError: The observation is not of the kind that the agent was trained on.
        """
        observed, transform_state = self.observe(self.to_tensors(observation), memory)
        noise = None if greedy else self.noise((len(memory.reset_mask),), generator)
        decision = self.decide(observed, memory, noise)
        self.remember(memory, decision, transform_state)
        weights = self.acting_weights()
        log_prob = weights.log_prob(decision.outputs, decision.action)
        return ActOutput(decision.action, log_prob, decision.outputs[:, -1], observed)

    def observe(self, observation: Observation, memory: AgentMemory) -> tuple[Observation, TransformState]:
        """Transform an observation of n environments, tensors on the agent's device, without updating the memory.

        Returns:
            The observation that the network takes, and the transform's state after it, for `remember`.
        """
        return self.transform.apply(observation, memory.transform_state, memory.reset_mask)

    @torch.no_grad()
    def embed(self, observed: Observation) -> Tensor:
        """Encode and embed what `observe` returned, for `decide`: float (n, width). The memory has no influence."""
        return self._embed(observed, self.acting_weights())

    @torch.no_grad()
    def decide(
        self, observed: Observation, memory: AgentMemory, noise: Tensor | None, embedded: Tensor | None = None
    ) -> Decision:
        """Choose actions, without updating the memory.

        Args:
            observed: What `observe` returned.
            memory: Memory of the same n environments.
            noise: Gumbel noise, float32 (n, branches, choices), as `noise` returns it; None for the most likely choices.
            embedded: What `embed` returned for `observed`; computed if None.
        """
        weights = self.acting_weights()
        reset_mask = None if memory.reset_mask is memory.no_reset else memory.reset_mask
        x = self._embed(observed, weights) if embedded is None else embedded
        with self.autocast_after_embedding():
            hidden, memory_update = self.memory.step(x, memory.state, reset_mask)
            outputs = weights.heads(hidden)
        logits = weights.logits(outputs)
        # The Gumbel-max trick: the largest of the logits with independent Gumbel noise is a sample of the policy.
        action = (logits if noise is None else logits + noise).argmax(-1)
        return Decision(action, outputs, memory_update)

    @torch.no_grad()
    def remember(self, memory: AgentMemory, decision: Decision, transform_state: TransformState) -> None:
        """Update the memory after `decide`; the next observation continues the episodes until `AgentMemory.reset`."""
        with self.autocast_after_embedding():
            self.memory.update_state(memory.state, decision.memory_update)
        memory.transform_state = transform_state
        memory.reset_mask = memory.no_reset

    @torch.no_grad()
    def bootstrap_value(self, observation: RawObservation, memory: AgentMemory) -> Tensor:
        """Value estimates float32 (n,) of an observation, without updating the memory; arguments as for `act`."""
        observed, _ = self.observe(self.to_tensors(observation), memory)
        return self.decide(observed, memory, None).outputs[:, -1]

    def noise(self, shape: tuple[int, ...], generator: torch.Generator | None) -> Tensor:
        """Gumbel noise for `decide`, float32 (*shape, branches, choices)."""
        drawn = torch.empty((*shape, len(self.branches), max(self.branches)), device=self.device)
        return drawn.exponential_(generator=generator).log_().neg_()

    def refresh(self) -> None:
        """Rebuild the weights for acting at the next step.

        This happens automatically after `forward` with gradients, and after parameter changes that PyTorch records (a fused
        optimizer's step is not recorded). Call it after any other change.
        """
        self._weights = None

    def acting_weights(self) -> ActingWeights:
        """The weights for acting; rebuilt if the parameters have changed, see `refresh`."""
        if not self._watched:
            self._watched = list(self.parameters())
        version = weights_version(self._watched)
        if self._weights is None or self._weights.version != version:
            dtype = torch.bfloat16 if self.settings.bf16 else torch.float32
            after = torch.float32 if self._is_float32_after_embedding else dtype
            with torch.no_grad():
                layers = (self.encoder.vector, self.memory.embedding, self.body, self.policy, self.value)
                self._weights = acting_weights(version, dtype, after, *layers)
                self.memory.refresh(dtype)
        return self._weights

    def forward(self, observation: Observation, minibatch: Minibatch, rows: Tensor | None = None) -> AgentOutput:
        """Compute the network's outputs for a minibatch, with gradients.

        Args:
            observation: Transformed observations of the steps `minibatch.indices`, tensors (M, ...) on the agent's device; with
                `rows`, (rows, ...).
            minibatch: A minibatch that `memory.minibatches` returned.
            rows: Row of each step's observation, int64 (M,), if equal observations are passed only once; see `Segment.distinct`.
        """
        if torch.is_grad_enabled():
            self.refresh()
        with self.autocast():
            embedded = self.memory.embed(self.encoder(observation))
        with self.autocast_after_embedding():
            memory_output = self.memory(embedded if rows is None else embedded.index_select(0, rows), minibatch)
            hidden = self.body(memory_output)
            logits, value = self.policy(hidden), self.value(hidden)
            truth = self.ground_truth(memory_output) if self.ground_truth is not None else None
        with self.autocast():
            frame = self.reconstruction(memory_output) if self.reconstruction is not None else None
        return AgentOutput([branch.log_softmax(-1) for branch in logits], value, frame, truth)

    def to_tensors(self, observation: RawObservation) -> Observation:
        """Convert a vector environment's observation to tensors on the agent's device; frames stay uint8.

        Args:
            observation: One array (n, ...) if the agent's observation has one part, or a mapping; other keys are ignored.

        Raises:
            ValueError: The observation is not of the kind that the agent was trained on.
        """
        mapping = self.as_mapping(observation)
        self._check_observation(mapping)
        return {
            key: (value if isinstance(value, Tensor) else torch_view(value)).to(self.device, non_blocking=True)
            for key, value in ((key, mapping[key]) for key in self.observation_shapes)
        }

    def _check_observation(self, given: Mapping[str, Array]) -> None:
        def is_of(key: str, shape: tuple[int, ...]) -> bool:
            if key not in given:
                return False
            is_frame = str(given[key].dtype).removeprefix("torch.") == "uint8"
            return tuple(given[key].shape[1:]) == shape and is_frame == (key == FRAME)

        if all(is_of(key, shape) for key, shape in self.observation_shapes.items()):
            return
        kind = self.settings.environment.observation
        expected = ", ".join(
            f"`{key}` {'uint8' if key == FRAME else 'float32'} {('n', *shape)}".replace("'", "")
            for key, shape in self.observation_shapes.items()
        )
        dtypes = {key: str(value.dtype).removeprefix("torch.") for key, value in given.items()}
        got = ", ".join(f"`{key}` {dtypes[key]} {tuple(value.shape)}" for key, value in given.items())
        raise ValueError(
            f"observation must be {expected}, since the agent was trained on {'frames' if kind == 'rgb' else kind}; got "
            f"{got or 'one array'}; make the environments with observation={kind!r}"
        )

    def as_mapping(self, observation: RawObservation) -> Mapping[str, Any]:
        """A vector environment's observation by key, whether its observation space is a dict or not."""
        if isinstance(observation, Mapping):
            return observation
        # A bare array fits only an agent whose observation has one part.
        return {next(iter(self.observation_shapes)): observation} if len(self.observation_shapes) == 1 else {}

    def _embed(self, observed: Observation, weights: ActingWeights) -> Tensor:
        """As `embed`, with given weights."""
        with self.autocast():
            if weights.vector is None:
                encoded: Tensor = self.encoder(observed)
            else:
                vectors = [observed[key] for key in self.encoder.vectors]
                encoded = linear_relu(vectors[0] if len(vectors) == 1 else torch.cat(vectors, dim=-1), weights.vector)
                if self.encoder.frames is not None:
                    encoded = torch.cat([self.encoder.frames(observed[FRAME]), encoded], dim=-1)
            return encoded if weights.embedding is None else linear_relu(encoded, weights.embedding)

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """The autocast context of the encoder, the embedding and the reconstruction."""
        if not self.settings.bf16:
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def autocast_after_embedding(self) -> contextlib.AbstractContextManager[Any]:
        """The autocast context of the other layers."""
        return contextlib.nullcontext() if self._is_float32_after_embedding else self.autocast()

    @property
    def _is_float32_after_embedding(self) -> bool:
        """Whether bfloat16 ends with the embedding: on the CPU, converting the small layers around a recurrent memory costs more
        than it saves.
        """
        return self.device.type == "cpu" and isinstance(self.memory, RecurrentMemory)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Agent:
        # PyTorch calls this when the parameters move, for example to another device.
        self.refresh()
        self._watched = []
        super()._apply(fn, recurse)
        return self


def matched_hidden_size(settings: Settings, shapes: Shapes, branches: Sequence[int], ground_truth: int) -> int:
    """The hidden size with which an agent has about as many parameters as the agent `gru` with `recurrence.hidden_size`.

    Args:
        settings: Settings of the agent, with `recurrence.match_gru`.
        shapes: Shapes of one environment's observation, by key.
        branches: Number of choices of each branch of the action.
        ground_truth: Entries of the environment's ground truth; 0 if it has none.

    Returns:
        A multiple of 4, so that it can be divided among heads.

    Raises:
        ValueError: No such size has the number of parameters up to 5 %.
    """
    given = settings.recurrence.hidden_size

    def count(changed: Settings, size: int) -> int:
        recurrence = dataclasses.replace(changed.recurrence, hidden_size=size, match_gru=False)
        with torch.device("meta"):
            made = Agent(dataclasses.replace(changed, recurrence=recurrence), shapes, branches, ground_truth, "meta")
        return made.num_parameters

    wanted = count(dataclasses.replace(settings, agent="gru", agent_option=()), given)
    low, high = 1, 2
    while count(settings, 4 * high) < wanted:
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if count(settings, 4 * middle) < wanted else (low, middle)
    counts = {4 * size: count(settings, 4 * size) for size in (low, high)}
    size = min(counts, key=lambda size: abs(counts[size] - wanted))
    if abs(counts[size] - wanted) > 0.05 * wanted:
        raise ValueError(
            f"--recurrence.match-gru: {settings.agent_name} has {counts[size]} parameters with the closest hidden size {size}, "
            f"the agent gru with {given} has {wanted}; choose a larger --recurrence.hidden-size"
        )
    return size


def make_agent(settings: Settings, spec: Spec, device: torch.device | str = "cpu") -> Agent:
    """Make an agent with newly initialised weights for an environment.

    Args:
        settings: Settings of the agent.
        spec: The environment's specification.
        device: Device of the weights and the memories.

    Raises:
        ValueError: The settings need frames or a ground truth that the environment does not have, or the observation is not made
            of frames and vectors.
    """
    observation = settings.environment.observation
    space = spec.observation_space(Frames() if observation == "rgb" else None, observation == "features")
    if settings.environment.wrapper:
        space = wrappers.observation_space(settings)
    if not isinstance(space, spaces.Dict):
        space = spaces.Dict({FRAME if observation == "rgb" else "features": space})
    for key, part in space.items():
        if not isinstance(part, spaces.Box):
            raise ValueError(
                f"observations must be frames and vectors, got {part} in `{key}`; make them vectors, in environments of POPGym "
                "by --environment.wrapper endless_gym_agents.popgym:Vectors"
            )
    shapes = {key: part.shape or () for key, part in space.items()}
    return Agent(settings, shapes, spec.branches, spec.ground_truth, device)
