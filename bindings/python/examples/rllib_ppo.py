"""Train RLlib's PPO with a memory, on RLlib's new API stack, to remember one command of Mortar Mayhem.

pip install ./bindings/python ./agents 'ray[rllib]'
python rllib_ppo.py                   # feature observations: learns the command in a few minutes on one core
python rllib_ppo.py --memory gru      # a custom module with the GRU of endless_gym_agents, in place of RLlib's LSTM
python rllib_ppo.py --memory none     # the baseline without memory, which cannot learn it
python rllib_ppo.py --env-id Endless-MortarMayhem-v0 --options '{}' --observation rgb --total-timesteps 10000000

All environments of an env runner form one vector environment, stepped by one call. RLlib's own Python loop over their episodes
takes most of the time.
"""

import argparse
import json
import time
from typing import Any

import gymnasium as gym
import numpy as np
import ray
import torch
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.connectors.common.add_observations_from_episodes_to_batch import AddObservationsFromEpisodesToBatch
from ray.rllib.connectors.connector_v2 import ConnectorV2
from ray.rllib.core.columns import Columns
from ray.rllib.core.distribution.torch.torch_distribution import TorchMultiCategorical
from ray.rllib.core.rl_module.apis.value_function_api import ValueFunctionAPI
from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig
from ray.rllib.core.rl_module.rl_module import RLModuleSpec
from ray.rllib.core.rl_module.torch import TorchRLModule

from endless_gym_agents.agent.encoders import FRAME, Encoder
from endless_gym_agents.agent.heads import PolicyHead, ValueHead
from endless_gym_agents.memories.recurrent import RecurrentMemory
from endless_gym_agents.settings import Recurrence


class GRUModule(TorchRLModule, ValueFunctionAPI):
    """The paper's GRU agent as an RLModule: encoder, fully connected layer, GRU, policy and value.

    RLlib cuts the episodes into sequences of `max_seq_len` steps, which start from the states that were stored while acting, and
    pads them with zeros.
    """

    def setup(self) -> None:
        hidden, shape = self.model_config["hidden_size"], self.observation_space.shape
        actions = self.action_space
        branches = actions.nvec.tolist() if isinstance(actions, gym.spaces.MultiDiscrete) else [int(actions.n)]
        if len(branches) > 1:  # RLlib has a default for one branch only
            self.action_dist_cls = TorchMultiCategorical.get_partial_dist_cls(space=actions, input_lens=branches)
        self.key = FRAME if len(shape) == 3 else "features"
        self.encoder = Encoder({self.key: shape}, 64)
        recurrence = Recurrence(hidden_size=hidden)
        self.memory = RecurrentMemory("gru", self.encoder.width, recurrence, torch.device("cpu"))
        self.policy = PolicyHead(hidden, 64, branches)
        self.value = ValueHead(hidden, 64, gain=0.05)

    def get_initial_state(self) -> dict[str, np.ndarray]:
        return {"hidden": np.zeros(self.memory.width, np.float32)}

    def _forward(self, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        remembered = self._remember(batch)  # (B, T, hidden size)
        logits = torch.cat(self.policy(remembered), -1)
        return {
            Columns.ACTION_DIST_INPUTS: logits,
            Columns.STATE_OUT: {"hidden": remembered[:, -1]},
            Columns.EMBEDDINGS: remembered,
        }

    def compute_values(self, batch: dict[str, Any], embeddings: torch.Tensor | None = None) -> torch.Tensor:
        return self.value(self._remember(batch) if embeddings is None else embeddings)

    def _remember(self, batch: dict[str, Any]) -> torch.Tensor:
        """The outputs of the GRU, float32 (B, T, hidden size), for observations (B, T, ...)."""
        observed, hidden = batch[Columns.OBS], batch[Columns.STATE_IN]["hidden"]
        sequences, steps = observed.shape[:2]
        encoded = self.memory.embedding(self.encoder({self.key: observed.transpose(0, 1).flatten(0, 1)}))
        no_resets = torch.zeros(steps, sequences, dtype=torch.bool)
        outputs, _ = self.memory.model.sequence(encoded.unflatten(0, (steps, sequences)), {"h0": hidden}, no_resets)
        return outputs.transpose(0, 1)


class ScaleFrames(ConnectorV2):
    """Convert frames uint8 (84, 84, 3) in a batch to float32 in [0, 1]. The episodes keep them as uint8, a quarter of the memory.

    RLlib's convolutions do not accept uint8; those of `GRUModule` do. Feature observations, which are float32, are unchanged.
    """

    def recompute_output_observation_space(self, input_observation_space: Any, input_action_space: Any) -> gym.Space:
        space = input_observation_space
        return gym.spaces.Box(0.0, 1.0, space.shape, np.float32) if space.dtype == np.uint8 else space

    def __call__(self, *, batch: dict[str, Any], **kwargs: Any) -> dict[str, Any]:
        def scale(observation: np.ndarray, *_: Any) -> np.ndarray:
            is_frame = observation.dtype == np.uint8
            return np.divide(observation, 255, dtype=np.float32) if is_frame else observation

        self.foreach_batch_item_change_in_place(batch, Columns.OBS, scale)
        return batch


def make_config(args: argparse.Namespace) -> PPOConfig:
    if args.memory == "gru":
        sizes = {"hidden_size": 128, "max_seq_len": args.max_seq_len}
        model = {"rl_module_spec": RLModuleSpec(module_class=GRUModule, model_config=sizes)}
    else:
        config = DefaultModelConfig(
            fcnet_hiddens=[64],
            fcnet_activation="relu",
            conv_filters=[[32, 8, 4], [64, 4, 2], [64, 3, 1]] if args.observation == "rgb" else None,
            head_fcnet_hiddens=[64],
            use_lstm=args.memory == "lstm",
            lstm_cell_size=128,
            max_seq_len=args.max_seq_len,
        )
        model = {"model_config": config}
    scale = [] if args.memory == "gru" else [ScaleFrames()]
    return (
        PPOConfig()
        .environment(
            # The part before the colon is imported first, in every env runner, and registers the ids.
            f"endless_gym:EndlessGym/{args.env_id}",
            env_config={"options": json.loads(args.options), "observation": args.observation},  # of `make_vec`
        )
        .env_runners(
            num_env_runners=args.num_env_runners,  # 0: in this process
            num_envs_per_env_runner=args.num_envs,
            gym_env_vectorize_mode="vector_entry_point",
            rollout_fragment_length=args.num_steps,
            # RLlib adds its own connectors after these, except for observations, which are already in the batch.
            env_to_module_connector=lambda env, spaces, device: [AddObservationsFromEpisodesToBatch(), *scale],
        )
        .learners(
            learner_connector=lambda observation_space, action_space: [
                AddObservationsFromEpisodesToBatch(as_learner_connector=True),
                *scale,
            ]
        )
        .rl_module(**model)
        .training(
            train_batch_size_per_learner=args.num_steps * args.num_envs * max(1, args.num_env_runners),
            minibatch_size=args.num_steps * args.num_envs * max(1, args.num_env_runners) // 4,
            num_epochs=3,
            lr=args.learning_rate,
            gamma=0.99,
            lambda_=0.95,
            clip_param=0.1,
            vf_loss_coeff=0.5,
            entropy_coeff=0.01,
            grad_clip=0.5,
            use_kl_loss=False,
        )
        .debugging(seed=args.seed, log_level="ERROR")
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="MortarMayhem-Grid-v0", help="environment id")
    parser.add_argument("--options", default='{"command_count": [1]}', help="reset parameters as JSON")
    parser.add_argument("--observation", choices=["features", "rgb"], default="features", help="what the agent sees")
    memories = "lstm: RLlib's; gru: a module with the GRU of endless_gym_agents; none: the baseline"
    parser.add_argument("--memory", choices=["lstm", "gru", "none"], default="lstm", help=memories)
    parser.add_argument("--max-seq-len", type=int, default=16, help="steps of truncated backpropagation through time")
    parser.add_argument("--num-env-runners", type=int, default=0, help="worker processes; 0 samples in this process")
    parser.add_argument("--num-envs", type=int, default=64, help="number of environments of each env runner")
    parser.add_argument("--num-steps", type=int, default=64, help="rollout length: steps per environment and update")
    parser.add_argument("--total-timesteps", type=int, default=250_000, help="environment steps in total")
    parser.add_argument("--learning-rate", type=float, default=1e-3, help="learning rate of Adam")
    parser.add_argument("--seed", type=int, default=1, help="seed of the environments and the network")
    args = parser.parse_args()
    if "MortarMayhemB" in args.env_id:
        parser.error(f"{args.env_id} has dict observations, which the network here does not support; choose another id")

    # Do not join a cluster that happens to run on this machine.
    ray.init("local", num_cpus=args.num_env_runners + 1, include_dashboard=False, log_to_driver=False)
    algorithm = make_config(args).build_algo()
    steps, mean = 0, "none yet"
    start = time.perf_counter()
    while steps < args.total_timesteps:
        sampled = algorithm.train()["env_runners"]
        steps = int(sampled["num_env_steps_sampled_lifetime"])
        if "episode_return_mean" in sampled:  # over the last 100 episodes
            mean = f"{sampled['episode_return_mean']:.3f}"
        rate = steps / (time.perf_counter() - start)
        print(f"steps={steps} steps_per_second={rate:.0f} mean_return={mean}", flush=True)
    algorithm.stop()
    ray.shutdown()


if __name__ == "__main__":
    main()
