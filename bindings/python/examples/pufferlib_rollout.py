"""Step Endless Gym through PufferLib, with random actions.

pip install ./bindings/python torch psutil setuptools wheel gym-notices
pip install --no-deps gym==0.26.2 pettingzoo shimmy
pip install --no-deps --no-build-isolation pufferlib==3.0.0
python pufferlib_rollout.py --env-id MysteryPath-Grid-v0 --num-envs 1024

--no-deps is needed because PufferLib 3.0.0 requires NumPy 1 and Gymnasium 0.29, although it works with the current versions. Its
setup compiles its own games from sources that it downloads from GitHub. To skip them, install it with NO_OCEAN=1 NO_TRAIN=1 and
with a folder on the PYTHONPATH that contains a file `sitecustomize.py` with the line:
import builtins; builtins.c_extension_paths = []
"""

import argparse
import time

import numpy as np
import pufferlib.vector

from endless_gym.pufferlib import EndlessPufferEnv


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="Endless-MortarMayhem-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=256, help="number of environments")
    parser.add_argument("--total-timesteps", type=int, default=500_000, help="environment steps in total")
    backends = ["PufferEnv", "Serial", "Multiprocessing"]
    parser.add_argument("--backend", choices=backends, default="PufferEnv", help="vectorisation backend of PufferLib")
    parser.add_argument("--seed", type=int, default=1, help="seed of the environments and the actions")
    args = parser.parse_args()

    # The native backend uses one batch in this process. The other backends use two, each with half of the environments.
    batches = 1 if args.backend == "PufferEnv" else 2
    vecenv = pufferlib.vector.make(
        EndlessPufferEnv,
        env_kwargs={"env_id": args.env_id, "num_envs": args.num_envs // batches},
        num_envs=batches,
        backend=args.backend,
    )
    rng = np.random.default_rng(args.seed)
    # Number of choices, for each branch of MultiDiscrete.
    space = vecenv.single_action_space
    choices = np.broadcast_to(space.nvec if hasattr(space, "nvec") else space.n, vecenv.action_space.shape)

    vecenv.async_reset(args.seed)
    steps, returns = 0, []
    start = time.perf_counter()
    while steps < args.total_timesteps:
        observations, rewards, _terminals, _truncations, infos, _env_ids, _masks = vecenv.recv()
        for info in infos:
            returns += info["episode_return"]
        vecenv.send(rng.integers(0, choices, dtype=np.int32))
        steps += len(rewards)
    seconds = time.perf_counter() - start

    mean = f"{sum(returns) / len(returns):.3f}" if returns else "none yet"
    print(f"observations={observations.shape} {observations.dtype}")
    print(f"steps={steps} steps_per_second={steps / seconds:.0f} episodes={len(returns)} mean_return={mean}")
    vecenv.close()


if __name__ == "__main__":
    main()
