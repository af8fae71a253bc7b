"""Collect data from Endless Gym with TorchRL, with a small policy that acts on single frames.

pip install endless-gym torchrl tensordict
python torchrl_rollout.py --env-id MysteryPath-Grid-v0 --num-envs 64 --total-timesteps 100000
"""

import argparse
import math
import time

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import Collector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor

from endless_gym.torchrl import EndlessEnv


class Pixels(nn.Module):
    """Frames uint8 (..., 84, 84, 3) to float32 (..., 3, 84, 84); not in the environment, to keep the data small."""

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return frames.movedim(-1, -3) / 255.0


def make_policy(env: TransformedEnv) -> ProbabilisticActor:
    """A convolutional network from frames to logits, (num_envs, 4) or (num_envs, 2, 3), and an action drawn by them."""
    shape = (*env.action_spec.shape[1:], env.action_spec.space.n)
    network = nn.Sequential(
        Pixels(),
        nn.Conv2d(3, 16, 8, stride=4),
        nn.ReLU(),
        nn.Conv2d(16, 32, 4, stride=2),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(32 * 9 * 9, math.prod(shape)),
        nn.Unflatten(-1, shape),
    ).to(env.device)
    return ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["logits"]),
        in_keys=["logits"],
        spec=env.action_spec,
        distribution_class=Categorical,
        default_interaction_type=InteractionType.RANDOM,
        return_log_prob=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="Endless-MortarMayhem-v0")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=32, help="steps in each environment between two batches")
    parser.add_argument("--total-timesteps", type=int, default=100_000, help="steps in all environments together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    args = parser.parse_args()

    torch.manual_seed(args.seed)
    env = EndlessEnv.make(args.env_id, args.num_envs, device=args.device)
    env = TransformedEnv(env, Compose(StepCounter(), RewardSum()))
    env.set_seed(args.seed)
    collector = Collector(
        env,
        make_policy(env),
        frames_per_batch=args.num_envs * args.num_steps,
        total_frames=args.total_timesteps,
        auto_register_policy_transforms=False,  # the policy keeps no state that an episode's start would have to clear
    )
    steps, returns = 0, []
    start = time.perf_counter()
    for data in collector:
        steps += data.numel()
        done = data["next", "done"]  # bool (num_envs, num_steps, 1)
        returns += data["next", "episode_reward"][done].tolist()
        # Here a loss module would train on `data`, whose batch size is [num_envs, num_steps].
        print(
            f"batch={tuple(data.batch_size)} observation={tuple(data['observation'].shape)} episodes={int(done.sum())}"
        )
    seconds = time.perf_counter() - start

    mean = f"{sum(returns) / len(returns):.3f}" if returns else "none yet"
    print(f"steps={steps} steps_per_second={steps / seconds:.0f} episodes={len(returns)} mean_return={mean}")
    collector.shutdown()


if __name__ == "__main__":
    main()
