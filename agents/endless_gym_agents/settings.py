"""The settings of a training run, and their presets.

Every field is a command-line flag of `endless-train`. `--preset` selects the defaults, which the other flags override. Names
follow the hyperparameter table of the paper where possible.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Annotated, Any, Literal

from gymnasium import spaces
from gymnasium.vector import VectorWrapper
from torch import nn

from endless_gym.specs import DEFAULT_ENV_ID, Frames, Spec, spec
from endless_gym_agents.common import own, ranges
from endless_gym_agents.common.own import MEMORIES
from endless_gym_agents.common.ranges import AboveZero, Finite, FromZero, Natural, Positive, Range, Share

#: The agents without a memory.
BASELINES = ("none", "stack", "position")
#: The agents of the package. Others are classes of your own; see `Settings.agent`.
AGENTS = ("gru", "lstm", *MEMORIES, "trxl", "gtrxl", *BASELINES)
PresetName = Literal["paper", "old", "overnight", "gpu", "quick"]

#: Seeds of the training episodes. Evaluation uses seeds from 200,000 on, so its levels are never seen in training.
TRAINING_SEEDS = range(100_000)
#: Environment steps of one update in the paper: 32 environments, 512 steps each.
PAPER_STEPS_PER_UPDATE = 32 * 512

#: The wrapper in environments whose observations are not vectors, that without the previous action, and that of fully observable
#: twins.
VECTORS, ONE_HOT, STATES = (f"endless_gym_agents.popgym:{name}" for name in ("Vectors", "OneHot", "States"))

#: An example for each setting that lists items NAME=VALUE.
_EXAMPLES = {
    "environment.option": "'command_count=[2]'",
    "agent_option": "'layers=2'",
    "encoder_option": "'width=256'",
}


def paper_run_length(env: str, agent: str) -> int:
    """Updates of the paper's runs, according to its published curves; for runs that it does not have, those of the closest one.

    Args:
        env: Canonical environment id.
        agent: Name of the agent.
    """
    if env.startswith("Endless"):
        return 50_000
    if "Grid" in env:
        return 10_000
    if env.startswith("MortarMayhem"):
        return 30_000
    if env.startswith("SearingSpotlights") and agent not in ("gru", "trxl"):
        return 16_000 if agent == "lstm" else 20_000
    return 25_000


@dataclass(frozen=True)
class Environment:
    """Training environments."""

    option: tuple[str, ...] = ()
    """reset parameters, each as NAME=VALUE with a JSON value, such as `command_count=[2]`"""
    observation: Literal["rgb", "features"] = "rgb"
    """`rgb`: frames, as in the paper. `features`: a short vector that describes the frame, for fast training without a GPU, and
    in environments without frames"""
    wrapper: tuple[str, ...] = ()
    """wrappers of your own, from the inside out: module:Class or file.py:Class of a `gymnasium.vector.VectorWrapper`, such as one
    that shapes the reward. Without one, integers that an environment returns, as many of POPGym do, become vectors, with the
    previous action"""
    num_envs: Positive = 32
    """total number of environments in all groups and on all ranks of a data-parallel run; the number of workers in the paper"""
    groups: Positive = 1
    """groups of environments. With two, an engine process steps one group while the agent computes the actions for the other;
    this pays off only if a step takes about as long as computing the actions"""
    engine: Literal["thread", "process"] = "thread"
    """`thread`: environments in this process. `process`: in an engine process, over shared memory"""
    num_threads: Natural = 0
    """threads that step the environments; 0 for one per core"""

    @property
    def shows_state(self) -> bool:
        """Whether a wrapper needs the Markov state."""
        return STATES in self.wrapper

    @property
    def own_wrappers(self) -> tuple[str, ...]:
        """The wrappers that change more than the form of observations: your own, and that of fully observable twins."""
        return tuple(wrapper for wrapper in self.wrapper if wrapper not in (VECTORS, ONE_HOT))

    def fitted(self, described: Spec) -> Environment:
        """These settings with features if there are no frames, and with `Vectors` if there is no wrapper for integers."""
        observation: Literal["rgb", "features"] = self.observation if described.frame else "features"
        space = described.observation_space(Frames() if observation == "rgb" else None, observation == "features")
        is_fitting = self.wrapper or isinstance(space, spaces.Box | spaces.Dict)
        wrapper = self.wrapper if is_fitting else (VECTORS,)
        return dataclasses.replace(self, observation=observation, wrapper=wrapper)


@dataclass(frozen=True)
class Recurrence:
    """Memory of all agents but the transformers and the baselines."""

    hidden_size: Positive = 512
    """size of the hidden state"""
    match_gru: bool = False
    """choose the hidden size so that the agent has as many parameters, up to 5 %, as the agent gru with `hidden-size` and the
    same other settings: for comparisons of memories. Not for transformers and baselines"""
    layers: Positive = 1
    """number of stacked recurrent layers"""
    residual: bool = False
    """residual connection around the recurrent layers"""
    embedding: bool = True
    """fully connected layer before the recurrent layers"""
    forget_bias: Finite = 0.0
    """initial bias of the forget gates of the agent lstm; with 1, it forgets less at first"""
    sequence_length: Positive = 512
    """length of truncated BPTT in steps; longer segments are cut into sequences that start from stored states"""
    kernels: Literal["auto", "torch"] = "auto"
    """how the CPU computes these layers while learning. auto: by native kernels where the layer has one; torch: by PyTorch's
    operations"""


@dataclass(frozen=True)
class Transformer:
    """Memory of the agents trxl (Transformer-XL) and gtrxl (GTrXL)."""

    layers: Positive = 3
    """number of blocks"""
    width: Positive = 384
    """embedding dimension of the blocks"""
    heads: Positive = 4
    """attention heads per block"""
    window: Annotated[int, Range(0, 2**16)] = 0
    """length of the sliding attention window: the current step and the past steps that it can attend to; 0 for the length of the
    longest episode, or 256 in endless environments, as in the paper"""
    positional_encoding: Literal["absolute", "learned", "relative", "none"] = "absolute"
    """positional encoding of the cached steps"""
    positions: Natural = 0
    """rows of the table of the absolute or learned encoding; 0 for the length of the longest episode, or 2048 in endless
    environments, as in the paper"""
    query_encoding: bool = False
    """add the absolute or learned encoding to the queries as well"""
    query_previous: bool = False
    """compute the first block's input with a ReLU layer from the embedding and the last block's input at the previous step,
    without gradient"""
    shared_heads: bool = True
    """share the query, key and value projections among the heads of a block, as in the experiments of the paper"""
    gating: bool = False
    """GRU-type gates of GTrXL in place of the residual connections; set by the agent `gtrxl`"""
    gate_bias: Finite = 0.0
    """initial bias of the gates; with a larger one, blocks start closer to the identity. The paper uses 0 and 2"""
    initialisation: Literal["xavier", "orthogonal", "kaiming", "tfixup"] = "xavier"
    """weight initialisation of the blocks"""
    sequence_length: Positive = 1
    """number of consecutive steps that are shuffled together into minibatches. 1, as in the paper: single steps. Longer
    sequences make learning faster and need less memory, but the gradients of long episodes are noisier"""


@dataclass(frozen=True)
class Model:
    """Layers before and after the memory."""

    vector_width: Positive = 128
    """units of the encoder of vector observations (features, vector observation, position)"""
    body_width: Natural = 0
    """units of the layer after the memory; 0 for the memory's output size, or `recurrence.hidden-size` without a memory"""
    head_width: Positive = 512
    """units of the hidden layers of the policy and value heads"""
    value_gain: Finite = 1.0
    """gain of the initial weights of the value head's output layer; a small gain speeds up the first updates if rewards are
    small"""
    stack: Positive = 4
    """number of stacked grey frames of the agent `stack`; the paper uses 4 and 16"""


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation and loss coefficients."""

    updates: Natural = 0
    """number of updates of the run; 0 for as many environment steps as the paper's runs: 50,000 of its updates in endless
    environments, 30,000 in MortarMayhem, 25,000 or fewer in MysteryPath and SearingSpotlights, 10,000 in the grids. One update
    uses `num_envs * steps` environment steps"""
    decay_updates: Positive = 10_000
    """updates over which learning rate and entropy coefficient decay linearly to their final values"""
    steps: Positive = 512
    """rollout length: steps of each environment per update; the worker steps of the paper"""
    epochs: Positive = 3
    """epochs per update"""
    minibatches: Positive = 8
    """minibatches per epoch"""
    gamma: Share = 0.995
    """discount factor"""
    gae_lambda: Share = 0.95
    """lambda of generalised advantage estimation"""
    bootstrap_truncated: bool = False
    """where a time limit ends an episode (`truncated`), add the discounted value of its last observation to its last reward, as
    if it went on. By default such an end counts as any other, as in the paper"""
    clip_range: AboveZero = 0.1
    """clip range epsilon of the policy loss and of the value loss"""
    advantage_normalisation: Literal["none", "batch", "minibatch"] = "none"
    """normalise advantages over the whole batch, over each minibatch, or not at all"""
    value_coefficient: FromZero = 0.5
    """coefficient of the value loss"""
    learning_rate: FromZero = 2.75e-4
    """initial learning rate of AdamW"""
    final_learning_rate: FromZero = 1.0e-5
    """learning rate after its decay"""
    weight_decay: Literal["all", "matrices"] = "all"
    """weights that AdamW decays by 0.01 times the learning rate. all: all, as in the authors' trainer; matrices: neither biases
    nor the gains of norms. Those that a memory excludes, such as its rates of decay, never do"""
    entropy_coefficient: FromZero = 1.0e-4
    """initial coefficient of the entropy bonus"""
    final_entropy_coefficient: FromZero = 1.0e-6
    """coefficient of the entropy bonus after its decay"""
    reconstruction_coefficient: FromZero = 0.0
    """coefficient of the observation reconstruction loss; 0 for no reconstruction head. The paper uses 0.1"""
    ground_truth_coefficient: FromZero = 0.0
    """coefficient of the ground-truth estimation loss; 0 for no such head. The authors' configurations use 1. Only for
    environments with `ground_truth` in `info`"""
    max_gradient_norm: AboveZero = 0.25
    """gradient clipping: largest global norm of the gradients"""


@dataclass(frozen=True)
class Settings:
    """Train an agent with PPO on an environment of Memory Gym or POPGym, or one of your own."""

    env: str = DEFAULT_ENV_ID
    """environment id; `endless list` lists them"""
    agent: str = "gru"
    """gru, lstm, mingru, lru, mamba2, gated-deltanet, retnet, mlstm, ffm (Fast and Forgetful Memory), shm (Stable Hadamard
    Memory), trxl (Transformer-XL) or gtrxl (gated Transformer-XL); a baseline without memory: none, stack (stacked grey frames)
    or position (encoded step number as an observation); or a memory of your own: module:Class or file.py:Class, a class derived
    from `endless_gym_agents.memories.sequence_model.SequenceModel`, or one as
    `endless_gym_agents.memories.sequence_model.Cell` describes"""
    agent_option: tuple[str, ...] = ()
    """arguments of the agent's class, each as NAME=VALUE with a JSON value; not for gru, lstm, trxl, gtrxl and the baselines"""
    encoder: str = ""
    """encoder of your own: module:Class or file.py:Class, a class as `endless_gym_agents.agent.encoders.OwnEncoder` describes;
    empty for the paper's convolutional network"""
    encoder_option: tuple[str, ...] = ()
    """arguments of the class of an encoder of your own, as for `agent-option`"""
    preset: PresetName = "paper"
    """defaults of all other settings. paper: the final hyperparameters of the paper; old: those of its previous study;
    overnight: those of the paper for 8.2 million steps, as many as the first point of its curves; gpu: those of the paper with
    1,024 environments, rollouts of 128 steps, four times as many minibatches, twice the learning rate and bfloat16;
    quick: small networks and feature observations; takes minutes on two CPU cores, and stops when the task is learnt"""
    seed: Natural = 1
    """seed of the initial weights, the episode seeds and all sampling"""
    device: str = "auto"
    """`cpu`, `cuda`, `cuda:1`, ...; `auto` for CUDA if available, else the CPU"""
    threads: Natural = 0
    """CPU threads of PyTorch; 0 for PyTorch's default"""
    bind_cores: bool = False
    """bind each rank of a data-parallel run, with its environments, to its share of the machine's cores"""
    bf16: bool = False
    """bfloat16 autocast for the network; weights and losses stay float32. On the CPU, recurrent agents use it for the encoder and
    the embedding only"""
    run: str = ""
    """folder of the run; empty for runs/ENV/AGENT-SEED-TIME"""
    resume: str = ""
    """resume the run in this folder from its last checkpoint; its settings are the defaults of the other options"""
    init_from: str = ""
    """start from the weights of this checkpoint, or of the last one of the run in this folder, for transfer and curricula;
    weights whose shapes differ, as those of another action space, keep their initial values. The optimizer is new"""
    total_steps: Natural = 0
    """environment steps of the run, rounded up to a whole update; 0 for `--ppo.updates`, which it replaces"""
    checkpoint_interval: Positive = 100
    """updates between two checkpoints; the last update always writes a checkpoint"""
    checkpoint_minutes: FromZero = 10.0
    """largest number of minutes between two checkpoints; 0 for no limit"""
    keep_checkpoints: bool = False
    """keep all checkpoints, for evaluation, instead of only the last"""
    checkpoint_megabytes: FromZero = 0.0
    """divide checkpoints into files of at most this many megabytes; 0 for one file each"""
    on_engine_failure: Literal["restart", "save", "fail"] = "restart"
    """what to do when the engine process ends or does not answer. restart: start another one, which continues exactly; after
    three restarts without a completed update, as `save`. save: complete the update in this process, write a checkpoint and stop.
    fail: stop at once"""
    time_limit: FromZero = 0.0
    """minutes within which training stops with a checkpoint, by the time that updates and checkpoints took; 0 for no limit"""
    target_reward: Annotated[float | None, Range()] = None
    """stop when the mean reward of the last 100 episodes reaches this value"""
    stop_when_learnt: bool = False
    """stop when the last 100 episodes show that the task is learnt, as `endless list ID` defines it. A target reward replaces it.
    The default of `quick`"""
    wandb: bool = False
    """also log to Weights & Biases, if it is installed"""
    view: bool = False
    """show the environments in a browser, and print the address of the page; needs `--environment.engine process`"""
    environment: Environment = field(default_factory=Environment)
    recurrence: Recurrence = field(default_factory=Recurrence)
    transformer: Transformer = field(default_factory=Transformer)
    model: Model = field(default_factory=Model)
    ppo: PPO = field(default_factory=PPO)

    def options(self, of: str = "environment.option") -> dict[str, Any]:
        """The reset parameters, or the arguments of an agent or encoder of your own, by name.

        Args:
            of: Name of the setting that lists them as NAME=VALUE, such as `agent_option`.

        Raises:
            ValueError: An item is not NAME=VALUE, or its value is not JSON.
        """
        values = {}
        for given in value(self, of):
            name, equals, text = given.partition("=")
            try:
                values[name] = json.loads(text.lower() if text in ("True", "False") else text)
            except json.JSONDecodeError:
                equals = ""
            if not equals:
                raise ValueError(
                    f"--{of.replace('_', '-')} must be NAME=VALUE with a JSON value, such as {_EXAMPLES[of]}, got `{given}`"
                )
        return values

    @property
    def agent_class(self) -> str:
        """The agent's class as module:Class or file.py:Class; empty for those of the package that are not recurrent layers."""
        return self.agent if ":" in self.agent else MEMORIES.get(self.agent, "")

    @property
    def agent_name(self) -> str:
        """The agent's name in tables and folders: for one of your own, that of its class."""
        return self.agent.rpartition(":")[2]

    def validated(self) -> Settings:
        """These settings, validated, with the canonical environment id.

        Raises:
            ValueError: A value is out of range, or a combination is not supported.
        """
        env_spec = spec(self.env)
        self = dataclasses.replace(self, environment=self.environment.fitted(env_spec))
        ranges.check(self)
        env_spec.max_episode_steps(self.options())  # raises if the options are not valid
        if self.agent_class:
            own.load("--agent", self.agent_class, nn.Module)
        elif self.agent not in AGENTS:
            near = difflib.get_close_matches(self.agent, AGENTS, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            raise ValueError(
                f"--agent must be one of {', '.join(AGENTS)}, or module:Class or file.py:Class, got `{self.agent}`{hint}"
            )
        if self.options("agent_option") and not self.agent_class:
            classes = ", ".join(MEMORIES)
            raise ValueError(f"--agent-option is for {classes} and agents of your own, got --agent {self.agent}")
        if self.recurrence.match_gru and not (self.agent_class or self.agent in ("gru", "lstm")):
            raise ValueError(f"--recurrence.match-gru is for recurrent memories, got --agent {self.agent}")
        if self.encoder:
            own.load("--encoder", self.encoder, nn.Module)
        elif self.options("encoder_option"):
            raise ValueError("--encoder-option needs an encoder of your own, got no --encoder")
        for wrapper in self.environment.wrapper:
            own.load("--environment.wrapper", wrapper, VectorWrapper)
        environment, ppo, transformer = self.environment, self.ppo, self.transformer
        if environment.num_envs % environment.groups:
            raise ValueError(
                f"--environment.num-envs must be a multiple of --environment.groups, got {environment.num_envs} environments and "
                f"{environment.groups} groups"
            )
        if ppo.minibatches > environment.num_envs * ppo.steps:
            steps = environment.num_envs * ppo.steps
            raise ValueError(f"--ppo.minibatches must be 1 to {steps}, the steps of an update, got {ppo.minibatches}")
        if self.view and environment.engine != "process":
            raise ValueError(
                "--view needs environments in an engine process, got --environment.engine "
                f"{environment.engine}; add --environment.engine process"
            )
        if transformer.window == 1:
            raise ValueError(
                "--transformer.window must be 0 (automatic) or 2 or more, got 1: no past step to attend to"
            )
        if transformer.width % (2 * transformer.heads):
            raise ValueError(
                f"--transformer.width must be a multiple of twice --transformer.heads, got width {transformer.width} and "
                f"{transformer.heads} heads"
            )
        group = "transformer" if self.agent in ("trxl", "gtrxl") else "recurrence"
        length = getattr(self, group).sequence_length
        if self.agent not in BASELINES and ppo.steps % min(length, ppo.steps):
            raise ValueError(
                f"--ppo.steps must be a multiple of --{group}.sequence-length, got {ppo.steps} steps and sequences of {length}"
            )
        if self.environment.observation == "features" and self.ppo.reconstruction_coefficient:
            raise ValueError(
                "--ppo.reconstruction-coefficient needs frames, got --environment.observation features; "
                "use rgb or the coefficient 0"
            )
        if transformer.query_encoding and transformer.positional_encoding not in ("absolute", "learned"):
            raise ValueError(
                "--transformer.query-encoding needs --transformer.positional-encoding absolute or learned, got "
                f"{transformer.positional_encoding}"
            )
        # As many environment steps as the paper's run of this agent in this environment.
        steps = self.total_steps or paper_run_length(env_spec.id, self.agent) * PAPER_STEPS_PER_UPDATE
        updates = (0 if self.total_steps else ppo.updates) or -(-steps // (environment.num_envs * ppo.steps))
        settings = dataclasses.replace(self, env=env_spec.full_id, total_steps=0)
        return _replace(settings, ppo={"updates": updates}).resolved()

    def resolved(self) -> Settings:
        """These settings with absolute paths of the files with classes of your own, which hold in other working folders."""
        settings = dataclasses.replace(self, agent=own.resolved(self.agent), encoder=own.resolved(self.encoder))
        return _replace(settings, environment={"wrapper": tuple(map(own.resolved, self.environment.wrapper))})

    def positions(self) -> int:
        """Rows of the table of positional encodings, with the default resolved."""
        return self.transformer.positions or self._longest_episode() or 2048

    def window(self) -> int:
        """Length of the attention window, with the default resolved."""
        return self.transformer.window or max(2, self._longest_episode() or 256)

    def _longest_episode(self) -> int:
        """Longest possible episode in steps; 0 in endless environments and without a step limit."""
        described = spec(self.env)
        return max(0, described.max_episode_steps(self.options())) if described.learnt else 0


def value(settings: Settings, name: str) -> Any:
    """The value of a setting by its name, with underscores and a dot after its group."""
    return attrgetter(name)(settings)


def _replace(settings: Settings, **groups: dict[str, Any]) -> Settings:
    """Replace fields in groups of settings."""
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
    # As far as the first point of the published curves, which is therefore what to expect.
    overnight = _replace(dataclasses.replace(paper, preset="overnight"), ppo={"updates": 500})
    # Eight times the environment steps per update of `paper`. Of five choices, this one learnt most per step on the CPU, and more
    # than `paper` with the same ratios of batch to network (agents/benches/preset.py).
    gpu = _replace(
        dataclasses.replace(paper, preset="gpu", bf16=True),
        environment={"num_envs": 1024},
        ppo={
            "steps": 128,
            "minibatches": 32,
            "decay_updates": 1_250,
            "learning_rate": 5.5e-4,
            "final_learning_rate": 2.0e-5,
        },
        recurrence={"sequence_length": 128},
        transformer={"sequence_length": 64},
    )
    quick = _replace(
        dataclasses.replace(paper, preset="quick", checkpoint_interval=50, stop_when_learnt=True),
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
            "weight_decay": "matrices",
            "entropy_coefficient": 1.0e-2,
            "final_entropy_coefficient": 1.0e-3,
            "max_gradient_norm": 0.5,
        },
        recurrence={"hidden_size": 128, "sequence_length": 64},
        transformer={"layers": 2, "width": 64, "window": 64, "sequence_length": 32},
        model={"vector_width": 64, "head_width": 64, "value_gain": 0.05},
    )
    return {"paper": paper, "old": old, "overnight": overnight, "gpu": gpu, "quick": quick}


#: Default settings by preset name.
PRESETS = _presets()


def to_dict(settings: Settings) -> dict[str, Any]:
    """The settings as nested dicts of JSON-serialisable values."""
    return dataclasses.asdict(settings)


def from_dict(values: dict[str, Any]) -> Settings:
    """Convert what `to_dict` returned back to settings.

    Raises:
        TypeError: An unknown field.
    """
    values = dict(values)
    for part in dataclasses.fields(Settings):
        if dataclasses.is_dataclass(kind := part.default_factory):
            # A run of `endless learn` has only the settings that it uses.
            values[part.name] = kind(**values.get(part.name, {}))
    # JSON has lists for tuples.
    environment = values["environment"]
    values["environment"] = dataclasses.replace(
        environment, option=tuple(environment.option), wrapper=tuple(environment.wrapper)
    )
    return Settings(**values | {name: tuple(values.get(name, ())) for name in ("agent_option", "encoder_option")})
