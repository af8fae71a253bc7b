"""Behaviour cloning: a recurrent network learns to imitate the episodes of a Minari data set.

pip install "./bindings/python[minari]" torch tyro
endless record MortarMayhem-Grid-v0 --episodes 2000 --error-rate 0 0.1 --option "command_count=[3]" \\
    --observation features --name clone/mortar-v0
python behaviour_cloning.py --dataset clone/mortar-v0
"""

import time
from dataclasses import dataclass
from typing import Any

import minari
import numpy as np
import torch
import tyro
from torch import nn
from torch.nn.utils.rnn import pad_sequence

import endless_gym


@dataclass
class Args:
    dataset: str = "clone/mortar-v0"
    """id of a data set with feature observations"""
    updates: int = 1000
    """updates of the network"""
    batch_size: int = 64
    """episodes in each update"""
    hidden_size: int = 128
    """hidden size of the GRU"""
    learning_rate: float = 3e-3
    """learning rate of Adam, which falls to 0"""
    min_return: float | None = None
    """learn only from episodes with at least this return; all by default"""
    evaluation_episodes: int = 100
    """episodes with unseen seeds, from 200000 on"""
    seed: int = 1
    """seed of the network and the batches"""


class Policy(nn.Module):
    """A GRU over the features, and the logits of all branches of the action space."""

    def __init__(self, features: int, branches: list[int], hidden_size: int) -> None:
        super().__init__()
        self.branches = branches
        self.encoder = nn.Sequential(nn.Linear(features, hidden_size), nn.ReLU())
        self.gru = nn.GRU(hidden_size, hidden_size)
        self.head = nn.Sequential(nn.Linear(hidden_size, hidden_size), nn.ReLU(), nn.Linear(hidden_size, sum(branches)))

    def forward(
        self, features: torch.Tensor, state: torch.Tensor | None = None
    ) -> tuple[list[torch.Tensor], torch.Tensor]:
        """Features (steps, episodes, f) to the logits of each branch (steps, episodes, choices) and the GRU's last state."""
        output, state = self.gru(self.encoder(features), state)
        return list(self.head(output).split(self.branches, dim=-1)), state


@torch.no_grad()
def evaluate(policy: Policy | None, id: str, options: dict[str, Any], episodes: int) -> tuple[float, int]:
    """Mean return and number of steps of episodes with unseen seeds, with the most likely actions; random without a policy."""
    envs = endless_gym.make_vec(id, episodes, observation="features", options=options, autoreset="disabled")
    envs.action_space.seed(0)
    observation, _ = envs.reset(seed=200_000)
    returns, active, state, steps = np.zeros(episodes), np.ones(episodes, dtype=bool), None, 0
    while active.any():
        action = envs.action_space.sample()
        if policy is not None:
            logits, state = policy(torch.tensor(observation)[None], state)
            chosen = torch.stack([branch[0].argmax(-1) for branch in logits], dim=-1)
            action = chosen.numpy().reshape(action.shape)
        observation, reward, terminated, _, _ = envs.step(action)
        returns += np.where(active, reward, 0)
        steps += int(active.sum())
        active &= ~terminated
    envs.close()
    return float(returns.mean()), steps


def main(args: Args) -> None:
    torch.manual_seed(args.seed)
    generator = np.random.default_rng(args.seed)
    dataset = minari.load_dataset(args.dataset)
    id, options = dataset.env_spec.kwargs["env_id"], dataset.env_spec.kwargs.get("options", {})
    # The last observation of an episode has no action.
    episodes = [
        (torch.tensor(episode.observations[:-1]), torch.tensor(episode.actions).reshape(len(episode.actions), -1))
        for episode in dataset
        if args.min_return is None or episode.rewards.sum() >= args.min_return
    ]
    space = dataset.action_space
    branches = [int(number) for number in (space.nvec if hasattr(space, "nvec") else [space.n])]
    policy = Policy(episodes[0][0].shape[1], branches, args.hidden_size)
    optimizer = torch.optim.Adam(policy.parameters(), args.learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1, 0, args.updates)
    start, steps = time.perf_counter(), 0
    for update in range(1, args.updates + 1):
        batch = [episodes[i] for i in generator.integers(len(episodes), size=args.batch_size)]
        features = pad_sequence([features for features, _ in batch])
        # Padded steps have no action to learn.
        actions = pad_sequence([actions for _, actions in batch], padding_value=-100)
        logits, _ = policy(features)
        loss = sum(
            nn.functional.cross_entropy(branch.flatten(0, 1), actions[..., i].flatten(), ignore_index=-100)
            for i, branch in enumerate(logits)
        )
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        schedule.step()
        steps += sum(len(features) for features, _ in batch)
        if update % 50 == 0 or update == args.updates:
            print(f"update={update} loss={loss.item():.4f}", flush=True)
    seconds = time.perf_counter() - start
    random_return, _ = evaluate(None, id, options, args.evaluation_episodes)
    cloned_return, _ = evaluate(policy, id, options, args.evaluation_episodes)
    print(
        f"steps={steps} steps_per_second={steps / seconds:.0f} episodes={len(episodes)} random_return={random_return:.3f} "
        f"mean_return={cloned_return:.3f}"
    )


if __name__ == "__main__":
    main(tyro.cli(Args))
