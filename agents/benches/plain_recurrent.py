"""Plain recurrent PPO on the original environments: the baseline of `speed.py` for `endless-train --agent gru`.

It is structured like the authors' training code: one process and pipe per environment, float frames, and one sequence per
episode, padded to the longest sequence. Padding passes through the whole network and is masked out before the losses. Model
and hyperparameters are those of the preset `paper`.

It needs the original (memory-gym 1.0.2) and torch. It prints the number of environment steps so far after each update.
"""

import argparse
import multiprocessing
import os
from multiprocessing.connection import Connection

import numpy as np
import torch
from torch import nn

os.environ["SDL_VIDEODRIVER"] = "dummy"


def worker(pipe: Connection, env_id: str) -> None:
    """Step one environment on request, until the pipe is closed."""
    import gymnasium
    import memory_gym  # noqa: F401

    env = gymnasium.make(env_id, disable_env_checker=True, render_mode="debug_rgb_array")

    def frame(observation: np.ndarray) -> np.ndarray:
        return (observation / 255.0).astype(np.float32).transpose(2, 0, 1)

    while True:
        action = pipe.recv()
        if action is None:
            pipe.send(frame(env.reset(seed=int(np.random.randint(0, 100_000)))[0]))
        else:
            observation, reward, done, truncated, _ = env.step(action)
            pipe.send((frame(observation), reward, done or truncated))


def padded(data: np.ndarray | torch.Tensor, sequences: list[tuple[int, int, int]]) -> torch.Tensor:
    """Zero-pad sequences (environment, start, stop) of data (n, steps, ...) to (sequences, longest, ...)."""
    data, longest = torch.as_tensor(data), max(b - a for _, a, b in sequences)
    out = torch.zeros((len(sequences), longest, *data.shape[2:]), dtype=data.dtype)
    for i, (env, a, b) in enumerate(sequences):
        out[i, : b - a] = data[env, a:b]
    return out


class Agent(nn.Module):
    """The GRU agent of the paper."""

    def __init__(self, branches: list[int], hidden: int) -> None:
        super().__init__()
        self.cnn = nn.Sequential(
            *(nn.Conv2d(3, 32, 8, 4), nn.ReLU(), nn.Conv2d(32, 64, 4, 2), nn.ReLU(), nn.Conv2d(64, 64, 3), nn.ReLU()),
            *(nn.Flatten(), nn.Linear(3136, hidden), nn.ReLU()),
        )
        self.gru = nn.GRU(hidden, hidden, batch_first=True)
        self.body = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU())
        self.policy = nn.Sequential(nn.Linear(hidden, 512), nn.ReLU())
        self.branches = nn.ModuleList(nn.Linear(512, choices) for choices in branches)
        self.value = nn.Sequential(nn.Linear(hidden, 512), nn.ReLU(), nn.Linear(512, 1))

    def forward(
        self, frames: torch.Tensor, hidden: torch.Tensor, length: int
    ) -> tuple[list[torch.distributions.Categorical], torch.Tensor, torch.Tensor]:
        """Action distributions per branch, values, and final hidden states of sequences of `length` frames each."""
        x = self.cnn(frames)
        x, hidden = self.gru(x.view(-1, length, x.shape[-1]), hidden)
        x = self.body(x.flatten(0, 1))
        policy = self.policy(x)
        distributions = [torch.distributions.Categorical(logits=branch(policy)) for branch in self.branches]
        return distributions, self.value(x).squeeze(-1), hidden


def main() -> None:
    """Train, and print the number of steps after each update."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Endless-MortarMayhem-v0", help="environment id (default: %(default)s)")
    parser.add_argument("--num-envs", type=int, default=8, help="number of environments (default: %(default)s)")
    parser.add_argument(
        "--steps", type=int, default=128, help="rollout length: steps per environment and update (default: %(default)s)"
    )
    parser.add_argument("--updates", type=int, default=3, help="number of updates (default: %(default)s)")
    parser.add_argument("--minibatches", type=int, default=8, help="minibatches per epoch (default: %(default)s)")
    parser.add_argument("--branches", default="3,3", help="numbers of choices of the branches (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="CPU threads of PyTorch (default: %(default)s)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    n, steps, branches = args.num_envs, args.steps, [int(choices) for choices in args.branches.split(",")]
    agent = Agent(branches, 512)
    optimizer = torch.optim.AdamW(agent.parameters(), lr=2.75e-4)
    pipes, processes = [], []
    for _ in range(n):
        here, there = multiprocessing.Pipe()
        processes.append(multiprocessing.Process(target=worker, args=(there, args.env), daemon=True))
        processes[-1].start()
        there.close()  # so that the end of a worker closes the pipe
        pipes.append(here)

    def reset(env: int) -> np.ndarray:
        pipes[env].send(None)
        return pipes[env].recv()

    now = np.stack([reset(env) for env in range(n)])
    hidden = torch.zeros(1, n, 512)
    for update in range(args.updates):
        frames = np.zeros((n, steps, 3, 84, 84), np.float32)
        rewards, dones = np.zeros((n, steps), np.float32), np.zeros((n, steps), bool)
        values, log_probs = torch.zeros(n, steps), torch.zeros(n, steps, len(branches))
        actions, states = torch.zeros(n, steps, len(branches), dtype=torch.long), torch.zeros(n, steps, 512)
        with torch.no_grad():
            for t in range(steps):
                frames[:, t], states[:, t] = now, hidden[0]
                policy, values[:, t], hidden = agent(torch.tensor(now), hidden, 1)
                chosen = [branch.sample() for branch in policy]
                actions[:, t] = torch.stack(chosen, 1)
                log_probs[:, t] = torch.stack([branch.log_prob(c) for branch, c in zip(policy, chosen, strict=True)], 1)
                for env in range(n):
                    action = actions[env, t].numpy()
                    pipes[env].send(int(action[0]) if len(branches) == 1 else action)
                for env in range(n):
                    now[env], rewards[env, t], dones[env, t] = pipes[env].recv()
                    if dones[env, t]:
                        now[env] = reset(env)
                        hidden[:, env] = 0
            next_value, last = agent(torch.tensor(now), hidden, 1)[1], torch.zeros(n)
            advantages = torch.zeros(n, steps)
            for t in reversed(range(steps)):
                on = torch.tensor(~dones[:, t]).float()
                delta = torch.tensor(rewards[:, t]) + 0.995 * next_value * on - values[:, t]
                advantages[:, t] = last = delta + 0.995 * 0.95 * on * last
                next_value = values[:, t]
        # One sequence per episode, padded to the longest.
        sequences = []
        for env in range(n):
            starts = [0, *(np.flatnonzero(dones[env, :-1]) + 1)]
            sequences += [(env, a, b) for a, b in zip(starts, [*starts[1:], steps], strict=True)]
        longest = max(b - a for _, a, b in sequences)

        batch = {"frames": frames, "actions": actions, "log_probs": log_probs, "values": values}
        batch["advantages"] = advantages
        batch = {name: padded(data, sequences) for name, data in batch.items()}
        mask = padded(torch.ones(n, steps, dtype=torch.bool), sequences)
        start = torch.stack([states[env, a] for env, a, _ in sequences])
        for _ in range(3):
            for chosen in torch.randperm(len(sequences)).chunk(args.minibatches):
                real = mask[chosen].flatten()
                part = {name: data[chosen].flatten(0, 1) for name, data in batch.items()}
                policy, value, _ = agent(part["frames"], start[chosen].unsqueeze(0), longest)
                taken, advantage = part["actions"], part["advantages"][real].unsqueeze(1)
                log_prob = torch.stack([branch.log_prob(taken[:, i]) for i, branch in enumerate(policy)], 1)[real]
                entropy = torch.stack([branch.entropy() for branch in policy], 1).sum(1)[real]
                ratio = (log_prob - part["log_probs"][real]).exp()
                surrogate = torch.min(ratio * advantage, ratio.clamp(0.9, 1.1) * advantage).mean()
                old, target = part["values"][real], (part["values"] + part["advantages"])[real]
                clipped = old + (value[real] - old).clamp(-0.1, 0.1)
                value_loss = torch.max((value[real] - target) ** 2, (clipped - target) ** 2).mean()
                loss = -surrogate + 0.5 * value_loss - 1e-4 * entropy.mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.25)
                optimizer.step()
        print(f"steps={(update + 1) * n * steps}", flush=True)
    for process in processes:
        process.kill()


if __name__ == "__main__":
    main()
