"""Training: the loop, rollouts, PPO, checkpoints, logs."""
