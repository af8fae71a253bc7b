"""Train Stable-Baselines3's recurrent PPO on Endless Gym.

pip install ./bindings/python stable-baselines3 sb3-contrib
python sb3_recurrent_ppo.py --env-id Endless-MortarMayhem-v0 --num-envs 64 --total-timesteps 1000000
"""

import argparse
import time

from sb3_contrib import RecurrentPPO

from endless_gym.sb3 import EndlessVecEnv


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env-id", default="Endless-MortarMayhem-v0", help="environment id")
    parser.add_argument("--num-envs", type=int, default=16, help="number of environments")
    parser.add_argument("--num-steps", type=int, default=64, help="rollout length: steps per environment and update")
    parser.add_argument("--total-timesteps", type=int, default=100_000, help="environment steps in total")
    parser.add_argument("--hidden-size", type=int, default=128, help="hidden size of the LSTM")
    parser.add_argument("--seed", type=int, default=1, help="seed of the environments and the network")
    parser.add_argument("--device", default="auto", help="PyTorch device; auto uses CUDA if available")
    args = parser.parse_args()

    venv = EndlessVecEnv.make(args.env_id, num_envs=args.num_envs)
    # The observations of the MortarMayhemB ids are dicts of a frame and a vector.
    policy = "MultiInputLstmPolicy" if hasattr(venv.observation_space, "spaces") else "CnnLstmPolicy"
    model = RecurrentPPO(
        policy,
        venv,
        n_steps=args.num_steps,
        batch_size=args.num_steps * args.num_envs // 4,
        n_epochs=3,
        learning_rate=2.75e-4,
        gamma=0.995,
        clip_range=0.1,
        ent_coef=1e-4,
        max_grad_norm=0.25,
        policy_kwargs={"lstm_hidden_size": args.hidden_size},
        stats_window_size=100,
        seed=args.seed,
        device=args.device,
        verbose=1,
    )
    start = time.perf_counter()
    model.learn(args.total_timesteps, log_interval=1)
    seconds = time.perf_counter() - start

    episodes = [episode["r"] for episode in model.ep_info_buffer]
    mean = f"{sum(episodes) / len(episodes):.3f}" if episodes else "none yet"
    print(f"steps={model.num_timesteps} steps_per_second={model.num_timesteps / seconds:.0f}", end=" ")
    print(f"last_episodes={len(episodes)} mean_return={mean}")
    venv.close()


if __name__ == "__main__":
    main()
