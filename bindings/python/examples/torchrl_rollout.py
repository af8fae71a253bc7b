"""Collect rollouts from Endless Gym with TorchRL and a small policy without memory.

pip install ./bindings/python torchrl tensordict
python torchrl_rollout.py --env-id MysteryPath-Grid-v0 --num-envs 64 --total-timesteps 100000
python torchrl_rollout.py --env-id MysteryPath-Grid-v0 --num-workers 2
"""

import argparse
import functools
import math
import time
from collections.abc import Callable
from contextlib import closing

import torch
from tensordict.nn import InteractionType, TensorDictModule
from torch import nn
from torch.distributions import Categorical
from torchrl.collectors import BaseCollector, Collector, MultiCollector
from torchrl.envs import Compose, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import ProbabilisticActor

from endless_gym.torchrl import EndlessEnv


class Pixels(nn.Module):
    """Convert frames uint8 (..., 84, 84, 3) to float32 (..., 3, 84, 84) in the policy, so that stored frames stay uint8."""

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        return frames.movedim(-1, -3) / 255.0


def transformed(make: Callable[[], EndlessEnv]) -> TransformedEnv:
    return TransformedEnv(make(), Compose(StepCounter(), RewardSum()))


def make_policy(env: EndlessEnv) -> ProbabilisticActor:
    """A convolutional network that computes logits, (num_envs, 4) or (num_envs, 2, 3), and samples an action from them."""
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


def make_collector(args: argparse.Namespace) -> BaseCollector:
    """A collector in this process, or in several processes that each collect from their share of the environments."""
    sizes = {"frames_per_batch": args.num_envs * args.num_steps, "total_frames": args.total_timesteps}
    sizes["auto_register_policy_transforms"] = False  # the policy has no recurrent state to reset
    if not args.num_workers:
        env = EndlessEnv.make(args.env_id, args.num_envs, device=args.device, seed=args.seed)
        return Collector(transformed(lambda: env), make_policy(env), **sizes)
    makers = EndlessEnv.workers(args.env_id, args.num_envs, args.num_workers, args.device, seed=args.seed)
    with closing(EndlessEnv.make(args.env_id, args.num_envs // args.num_workers, device=args.device)) as env:
        policy = make_policy(env)
    makers = [functools.partial(transformed, make) for make in makers]
    return MultiCollector(makers, policy, sync=True, cat_results=0, **sizes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="Endless-MortarMayhem-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=64, help="number of environments of all workers")
    parser.add_argument(
        "--num-workers", type=int, default=0, help="processes, each with an engine; 0 to use this process without one"
    )
    parser.add_argument("--num-steps", type=int, default=32, help="rollout length: steps per environment and batch")
    parser.add_argument("--total-timesteps", type=int, default=100_000, help="environment steps in total")
    parser.add_argument("--seed", type=int, default=1, help="seed of the environments and the network")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", default=device, help="PyTorch device; by default CUDA if available")
    args = parser.parse_args()
    if "MortarMayhemB" in args.env_id:
        parser.error(f"{args.env_id} has dict observations, which the policy here does not support; choose another id")

    torch.manual_seed(args.seed)
    collector = make_collector(args)
    steps, returns = 0, []
    start = time.perf_counter()
    for data in collector:
        steps += data.numel()
        done = data["next", "done"]  # bool (num_envs, num_steps, 1)
        returns += data["next", "episode_reward"][done].tolist()
        # A loss module would use `data` here; its batch size is [num_envs, num_steps].
        print(
            f"batch={tuple(data.batch_size)} observation={tuple(data['observation'].shape)} episodes={int(done.sum())}"
        )
    seconds = time.perf_counter() - start

    mean = f"{sum(returns) / len(returns):.3f}" if returns else "none yet"
    print(f"steps={steps} steps_per_second={steps / seconds:.0f} episodes={len(returns)} mean_return={mean}")
    collector.shutdown()


if __name__ == "__main__":
    main()
