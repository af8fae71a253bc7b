"""All settings of a training run, and the presets that fill them.

Every field is a command-line flag of `endless-train`; `--preset` chooses the defaults that the other flags change. The names are
those of the paper's hyperparameter table where it has them.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass, field
from typing import Any, Literal

from endless_gym.agents.metrics import is_finite
from endless_gym.specs import DEFAULT_ENV_ID, spec

AgentName = Literal["gru", "lstm", "trxl", "gtrxl", "none", "stack", "position"]
PresetName = Literal["paper", "old", "throughput", "quick"]

#: The seeds that training draws an episode's seed from. Evaluation uses seeds from 200,000 on: levels that no training has seen.
TRAINING_SEEDS = range(100_000)


@dataclass(frozen=True)
class Environment:
    """What the agent plays."""

    option: tuple[str, ...] = ()
    """reset parameters, each as NAME=VALUE with the value as JSON, such as `command_count=[2]`"""
    observation: Literal["rgb", "features"] = "rgb"
    """`rgb`: frames, as in the paper. `features`: a short vector of what the frame shows, for small machines"""
    num_envs: int = 32
    """environments in all groups together; the paper's number of workers"""
    groups: int = 2
    """groups of environments; one is stepped while the agent decides for another"""
    engine: Literal["thread", "process"] = "thread"
    """`thread`: environments in this process. `process`: in an engine's process, over shared memory"""
    num_threads: int = 0
    """the engine's threads; 0 for one for each core"""


@dataclass(frozen=True)
class Recurrence:
    """GRU and LSTM."""

    hidden_size: int = 512
    """size of the hidden state"""
    layers: int = 1
    """recurrent layers, one upon the other"""
    residual: bool = False
    """add the recurrent layers' input to their output"""
    embedding: bool = True
    """a fully connected layer in front of the recurrent layers"""
    sequence_length: int = 512
    """steps that gradients flow back through, at most; longer segments are cut and go on from stored states"""


@dataclass(frozen=True)
class Transformer:
    """Transformer-XL, and with `gating` GTrXL."""

    layers: int = 3
    """attention blocks, one upon the other"""
    width: int = 384
    """size of the vectors between the blocks"""
    heads: int = 4
    """attention heads"""
    window: int = 0
    """length of the sliding memory window: the current step and those before it that it can attend to; 0 for the longest episode,
    and 256 in endless environments, as in the paper"""
    positional_encoding: Literal["absolute", "learned", "relative", "none"] = "absolute"
    """how attention knows the time of a memory"""
    positions: int = 0
    """rows of the absolute or learned encoding's table; 0 for the longest episode, and 2048 in endless environments, as in the
    paper"""
    query_encoding: bool = False
    """add the absolute or learned encoding of the current step to the queries, too"""
    shared_heads: bool = True
    """one matrix for all heads of a block, for queries, keys and values each, as in the paper's experiments"""
    gating: bool = False
    """GTrXL's gates in place of the residual connections; set by the agent `gtrxl`"""
    gate_bias: float = 0.0
    """bias of the gates; the larger, the closer a fresh block is to the identity. The paper tries 0 and 2"""
    initialisation: Literal["xavier", "orthogonal", "kaiming", "tfixup"] = "xavier"
    """weights of a fresh block"""
    sequence_length: int = 64
    """consecutive steps that are learned from together; their keys and values are projected once for all of them"""


@dataclass(frozen=True)
class Model:
    """The network around the memory."""

    vector_width: int = 128
    """units of the encoder of vectors (features, vector observations, positions)"""
    body_width: int = 0
    """units of the layer after the memory; 0 for the memory's width, and without a memory for `recurrence.hidden-size`"""
    head_width: int = 512
    """units of the hidden layer of the policy's and the value's head"""
    value_gain: float = 1.0
    """scale of the value head's first weights; with rewards of 0.1, small ones save the first updates"""
    stack: int = 4
    """grey frames that the agent `stack` observes; the paper stacks 4 and 16"""


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation, and the coefficients of the losses."""

    updates: int = 10_000
    """updates of a whole run; one update sees `num_envs * steps` steps"""
    decay_updates: int = 10_000
    """updates over which learning rate and entropy coefficient decay linearly; the final value holds from then on"""
    steps: int = 512
    """steps in each environment between two updates; the paper's worker steps"""
    epochs: int = 3
    """how often an update sees each step"""
    minibatches: int = 8
    """parts that an epoch is divided into"""
    gamma: float = 0.995
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of generalised advantage estimation"""
    clip_range: float = 0.1
    """epsilon of the clipped surrogate, and of the clipped value loss"""
    advantage_normalisation: Literal["none", "batch", "minibatch"] = "none"
    """over what advantages are brought to mean 0 and standard deviation 1"""
    value_coefficient: float = 0.5
    """weight of the value loss"""
    learning_rate: float = 2.75e-4
    """AdamW's learning rate at the start"""
    final_learning_rate: float = 1.0e-5
    """and at the end of its decay"""
    entropy_coefficient: float = 1.0e-4
    """weight of the entropy bonus at the start"""
    final_entropy_coefficient: float = 1.0e-6
    """and at the end of its decay"""
    reconstruction_coefficient: float = 0.0
    """weight of the observation reconstruction; 0 for none. The paper uses 0.1 where it uses it"""
    ground_truth_coefficient: float = 0.0
    """weight of the ground-truth estimation; 0 for none. Only for environments whose `info` has the ground truth"""
    max_gradient_norm: float = 0.25
    """gradients are scaled down to this norm"""


@dataclass(frozen=True)
class Settings:
    """Train an agent with PPO on one of the Memory Gym environments."""

    env: str = DEFAULT_ENV_ID
    """environment id; `endless list` shows them"""
    agent: AgentName = "gru"
    """the memory: gru, lstm, trxl (Transformer-XL), gtrxl (with gates); or one of the naive baselines: none, stack (grey frames),
    position (the step's number, encoded, as an observation)"""
    preset: PresetName = "paper"
    """the defaults of all other settings. paper: the paper's final hyperparameters; old: those of its previous study; throughput:
    many environments, short segments; quick: small networks on feature observations, minutes on two cores"""
    seed: int = 1
    """fixes the network's first weights, the episodes' seeds and all draws"""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA where there is one"""
    threads: int = 0
    """threads that PyTorch computes with on the CPU; 0 leaves that to PyTorch"""
    compile: bool = False
    """compile the network with torch.compile; the first updates take minutes longer"""
    bf16: bool = False
    """compute the network in bfloat16 (autocast); weights and losses stay float32"""
    run: str = ""
    """the run's folder; empty for runs/ENV/AGENT-SEED-TIME"""
    resume: str = ""
    """go on with the run in this folder, from its last checkpoint; its settings are the defaults of the other flags"""
    checkpoint_interval: int = 100
    """updates between two checkpoints; the last update always writes one"""
    keep_checkpoints: bool = False
    """keep one file for each checkpoint, for evaluation, and not the last one only"""
    time_limit: float = 0.0
    """minutes after which training stops, with a checkpoint; 0 for none"""
    target_reward: float | None = None
    """stop when the mean reward of the last 100 episodes is at least this"""
    wandb: bool = False
    """log to Weights & Biases, too, if it is installed"""
    environment: Environment = field(default_factory=Environment)
    recurrence: Recurrence = field(default_factory=Recurrence)
    transformer: Transformer = field(default_factory=Transformer)
    model: Model = field(default_factory=Model)
    ppo: PPO = field(default_factory=PPO)

    def options(self) -> dict[str, Any]:
        """The reset parameters as a dict.

        Raises:
            ValueError: One is not NAME=VALUE, or its value is not JSON.
        """
        options = {}
        for given in self.environment.option:
            name, equals, text = given.partition("=")
            try:
                options[name] = json.loads(text.lower() if text in ("True", "False") else text)
            except json.JSONDecodeError:
                equals = ""
            if not equals:
                raise ValueError(
                    f"reset parameter `{given}`: give NAME=VALUE with the value as JSON, as command_count=[2]"
                )
        return options

    def checked(self) -> Settings:
        """These settings with the environment's own id, once nothing speaks against them.

        Raises:
            ValueError: A number or a combination is not possible; the message says which, and what to do.
        """
        described = spec(self.env)
        described.max_episode_steps(self.options())  # window and positions follow from it, or it says what is wrong
        environment, ppo, transformer = self.environment, self.ppo, self.transformer
        positive = {
            "environment.num-envs": environment.num_envs,
            "environment.groups": environment.groups,
            "ppo.updates": ppo.updates,
            "ppo.decay-updates": ppo.decay_updates,
            "ppo.steps": ppo.steps,
            "ppo.epochs": ppo.epochs,
            "ppo.minibatches": ppo.minibatches,
            "recurrence.layers": self.recurrence.layers,
            "recurrence.hidden-size": self.recurrence.hidden_size,
            "recurrence.sequence-length": self.recurrence.sequence_length,
            "transformer.layers": transformer.layers,
            "transformer.heads": transformer.heads,
            "transformer.width": transformer.width,
            "transformer.sequence-length": transformer.sequence_length,
            "model.stack": self.model.stack,
            "model.vector-width": self.model.vector_width,
            "model.head-width": self.model.head_width,
            "checkpoint-interval": self.checkpoint_interval,
        }
        for name, number in positive.items():
            if number < 1:
                raise ValueError(f"--{name} is {number}; give 1 or more")
        for name, number in {
            "threads": self.threads,
            "environment.num-threads": environment.num_threads,
            "model.body-width": self.model.body_width,
            "transformer.positions": transformer.positions,
            "transformer.window": transformer.window,
        }.items():
            if number < 0:
                raise ValueError(f"--{name} is {number}; give 0 or more")
        if environment.num_envs % environment.groups:
            raise ValueError(
                f"{environment.num_envs} environments do not divide into {environment.groups} groups of one size; "
                "change --environment.num-envs or --environment.groups"
            )
        if transformer.window == 1:
            raise ValueError(f"--transformer.window is {transformer.window}; a window of 1 has no past, give 2 or more")
        if transformer.width % (2 * transformer.heads):
            raise ValueError(
                f"--transformer.width is {transformer.width}; it must be a multiple of twice the {transformer.heads} heads"
            )
        if self.agent in ("trxl", "gtrxl") and ppo.steps % min(transformer.sequence_length, ppo.steps):
            raise ValueError(
                f"segments of {ppo.steps} steps do not divide into sequences of {transformer.sequence_length}; "
                "change --ppo.steps or --transformer.sequence-length"
            )
        if self.environment.observation == "features" and self.ppo.reconstruction_coefficient:
            raise ValueError("reconstruction is of frames; drop --ppo.reconstruction-coefficient or observe `rgb`")
        if transformer.query_encoding and transformer.positional_encoding not in ("absolute", "learned"):
            raise ValueError(
                f"--transformer.query-encoding needs an absolute or learned encoding, not {transformer.positional_encoding}"
            )
        return dataclasses.replace(self, env=described.id)

    def positions(self) -> int:
        """Rows of the positional encoding's table."""
        return self.transformer.positions or self._longest_episode() or 2048

    def window(self) -> int:
        """Length of the memory window."""
        return self.transformer.window or max(2, self._longest_episode() or 256)

    def _longest_episode(self) -> int:
        """Steps; 0 in endless environments, and where there is no limit."""
        return max(0, spec(self.env).max_episode_steps(self.options())) if is_finite(self.env) else 0


def _replace(settings: Settings, **groups: dict[str, Any]) -> Settings:
    """Settings with some fields of some groups replaced."""
    changed = {name: dataclasses.replace(getattr(settings, name), **fields) for name, fields in groups.items()}
    return dataclasses.replace(settings, **changed)


def _presets() -> dict[str, Settings]:
    paper = Settings()
    old = _replace(
        dataclasses.replace(paper, preset="old"),
        ppo={
            "gamma": 0.99,
            "advantage_normalisation": "minibatch",
            "clip_range": 0.2,
            "value_coefficient": 0.25,
            "learning_rate": 3.0e-4,
            "final_learning_rate": 1.0e-4,
            "final_entropy_coefficient": 1.0e-5,
            "max_gradient_norm": 0.5,
        },
        recurrence={"embedding": False},
    )
    # The same number of steps in an update; segments go on from stored states.
    throughput = _replace(
        dataclasses.replace(paper, preset="throughput"),
        environment={"num_envs": 512},
        ppo={"steps": 32},
        recurrence={"sequence_length": 32},
        transformer={"sequence_length": 32},
    )
    quick = _replace(
        dataclasses.replace(paper, preset="quick", checkpoint_interval=50),
        environment={"observation": "features", "num_envs": 64},
        ppo={
            "updates": 2000,
            "decay_updates": 2000,
            "steps": 64,
            "minibatches": 4,
            "gamma": 0.99,
            "advantage_normalisation": "minibatch",
            "learning_rate": 1.0e-3,
            "final_learning_rate": 1.0e-4,
            "entropy_coefficient": 1.0e-2,
            "final_entropy_coefficient": 1.0e-3,
            "max_gradient_norm": 0.5,
        },
        recurrence={"hidden_size": 128, "sequence_length": 64},
        transformer={"layers": 2, "width": 64, "window": 64, "sequence_length": 32},
        model={"vector_width": 64, "head_width": 64, "value_gain": 0.05},
    )
    return {"paper": paper, "old": old, "throughput": throughput, "quick": quick}


#: The settings that `--preset` starts from.
PRESETS = _presets()


def to_dict(settings: Settings) -> dict[str, Any]:
    """Plain dicts, numbers and strings, for JSON."""
    return dataclasses.asdict(settings)


def from_dict(values: dict[str, Any]) -> Settings:
    """The reverse of `to_dict`.

    Raises:
        TypeError: There is a field that these settings do not have.
    """
    values = dict(values)
    groups = {
        "environment": Environment,
        "recurrence": Recurrence,
        "transformer": Transformer,
        "model": Model,
        "ppo": PPO,
    }
    for name, kind in groups.items():
        values[name] = kind(**values[name])
    values["environment"] = dataclasses.replace(values["environment"], option=tuple(values["environment"].option))
    return Settings(**values)
