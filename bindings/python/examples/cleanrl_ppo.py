"""Recurrent PPO in one file, in the style of CleanRL, on Endless Gym.

pip install ./bindings/python torch tyro
python cleanrl_ppo.py --env-id Endless-MortarMayhem-v0 --num-envs 64 --total-timesteps 1000000
"""

import time
from collections import deque
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch
import tyro
from torch import nn
from torch.distributions import Categorical

import endless_gym

State = tuple[torch.Tensor, torch.Tensor]


@dataclass
class Args:
    env_id: str = "Endless-MortarMayhem-v0"
    """environment id; ids with dict observations are not supported"""
    total_timesteps: int = 1_000_000
    """environment steps in total"""
    num_envs: int = 64
    """number of environments"""
    num_steps: int = 128
    """rollout length: steps per environment and update"""
    num_minibatches: int = 8
    """minibatches per epoch; each contains the complete sequences of some environments"""
    update_epochs: int = 3
    """epochs per update"""
    learning_rate: float = 2.75e-4
    """learning rate of Adam"""
    gamma: float = 0.995
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of generalised advantage estimation"""
    clip_coef: float = 0.1
    """clip range of the probability ratio"""
    ent_coef: float = 1e-4
    """entropy coefficient"""
    vf_coef: float = 0.5
    """value loss coefficient"""
    max_grad_norm: float = 0.25
    """maximum gradient norm"""
    hidden_size: int = 256
    """hidden size of the LSTM"""
    seed: int = 1
    """seed of the environments, the network and the minibatches"""
    cuda: bool = True
    """use CUDA if available"""


class Agent(nn.Module):
    """A convolutional encoder, an LSTM, one policy head for each branch of the action space, and a value head."""

    def __init__(self, action_sizes: list[int], hidden_size: int) -> None:
        super().__init__()
        self.action_sizes = action_sizes
        self.encoder = nn.Sequential(
            *(nn.Conv2d(3, 32, 8, stride=4), nn.ReLU(), nn.Conv2d(32, 64, 4, stride=2), nn.ReLU()),
            *(nn.Conv2d(64, 64, 3, stride=1), nn.ReLU(), nn.Flatten(), nn.Linear(64 * 7 * 7, hidden_size), nn.ReLU()),
        )
        self.lstm = nn.LSTM(hidden_size, hidden_size)
        self.actor = nn.Linear(hidden_size, sum(action_sizes))
        self.critic = nn.Linear(hidden_size, 1)
        nn.init.orthogonal_(self.actor.weight, 0.01)

    def encode(self, obs: torch.Tensor, state: State, done: torch.Tensor) -> tuple[torch.Tensor, State]:
        """Return the LSTM outputs, float32 (steps * envs, hidden_size), and the last state.

        `obs` is uint8 (steps * envs, 84, 84, 3). Where `done`, (steps * envs,), is 1, an episode starts and the state is zeroed.
        """
        envs = state[0].shape[1]
        features = self.encoder(obs.permute(0, 3, 1, 2).float() / 255.0)
        outputs = []
        for x, start in zip(features.reshape(-1, envs, features.shape[-1]), done.reshape(-1, envs), strict=True):
            keep = (1.0 - start).view(1, -1, 1)
            x, state = self.lstm(x.unsqueeze(0), (keep * state[0], keep * state[1]))
            outputs.append(x)
        return torch.cat(outputs).flatten(0, 1), state

    def get_value(self, obs: torch.Tensor, state: State, done: torch.Tensor) -> torch.Tensor:
        return self.critic(self.encode(obs, state, done)[0]).flatten()

    def get_action_and_value(
        self, obs: torch.Tensor, state: State, done: torch.Tensor, action: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, State]:
        hidden, state = self.encode(obs, state, done)
        heads = [Categorical(logits=logits) for logits in self.actor(hidden).split(self.action_sizes, dim=-1)]
        if action is None:
            action = torch.stack([head.sample() for head in heads], dim=-1)
        logprob = sum(head.log_prob(action[:, i]) for i, head in enumerate(heads))
        entropy = sum(head.entropy() for head in heads)
        return action, logprob, entropy, self.critic(hidden).flatten(), state


if __name__ == "__main__":
    args = tyro.cli(Args)
    batch_size = args.num_envs * args.num_steps
    if isinstance(endless_gym.spec(args.env_id).observation_space(), gym.spaces.Dict):
        raise SystemExit(f"{args.env_id} has dict observations, which this program does not support; choose another id")
    if args.total_timesteps < batch_size:
        raise SystemExit(f"--total-timesteps must be at least num_envs * num_steps, {batch_size}, for one update")
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)
    device = torch.device("cuda" if torch.cuda.is_available() and args.cuda else "cpu")

    envs = endless_gym.make_vec(args.env_id, num_envs=args.num_envs, autoreset="same_step")
    discrete = isinstance(envs.single_action_space, gym.spaces.Discrete)
    action_sizes = [int(envs.single_action_space.n)] if discrete else envs.single_action_space.nvec.tolist()
    agent = Agent(action_sizes, args.hidden_size).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)

    # Rollout storage. Frames are stored as uint8, a quarter of the memory of float32.
    shape = (args.num_steps, args.num_envs)
    obs = torch.zeros(shape + envs.single_observation_space.shape, dtype=torch.uint8, device=device)
    actions = torch.zeros((*shape, len(action_sizes)), dtype=torch.long, device=device)
    logprobs, rewards, dones, values = (torch.zeros(shape, device=device) for _ in range(4))

    next_obs, _ = envs.reset(seed=args.seed)
    next_obs = endless_gym.torch_view(next_obs).to(device)
    next_done = torch.zeros(args.num_envs, device=device)
    next_state = tuple(torch.zeros(1, args.num_envs, args.hidden_size, device=device) for _ in range(2))
    returns_of_episodes: deque[float] = deque(maxlen=100)
    start_time = time.time()

    for iteration in range(1, args.total_timesteps // batch_size + 1):
        initial_state = tuple(part.clone() for part in next_state)
        for step in range(args.num_steps):
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprob, _, value, next_state = agent.get_action_and_value(obs[step], next_state, next_done)
            actions[step], logprobs[step], values[step] = action, logprob, value

            action = action.squeeze(-1) if discrete else action
            next_obs, reward, terminated, truncated, info = envs.step(action.cpu().numpy())
            rewards[step] = torch.tensor(reward)
            next_obs = endless_gym.torch_view(next_obs).to(device)
            next_done = torch.tensor(terminated | truncated, dtype=torch.float32, device=device)
            if "final_info" in info:
                returns_of_episodes.extend(info["final_info"]["reward"][info["_final_info"]])

        # Generalised advantage estimation
        with torch.no_grad():
            next_value = agent.get_value(next_obs, next_state, next_done)
            advantages, last = torch.zeros_like(rewards), 0.0
            for t in reversed(range(args.num_steps)):
                following = (next_value, next_done) if t == args.num_steps - 1 else (values[t + 1], dones[t + 1])
                delta = rewards[t] + args.gamma * following[0] * (1.0 - following[1]) - values[t]
                advantages[t] = last = delta + args.gamma * args.gae_lambda * (1.0 - following[1]) * last
            returns = advantages + values

        # Update. Minibatches contain complete sequences, as the LSTM requires.
        for _ in range(args.update_epochs):
            for mb in torch.randperm(args.num_envs, device=device).chunk(args.num_minibatches):
                _, newlogprob, entropy, newvalue, _ = agent.get_action_and_value(
                    obs[:, mb].flatten(0, 1),
                    tuple(part[:, mb] for part in initial_state),
                    dones[:, mb].flatten(),
                    actions[:, mb].flatten(0, 1),
                )
                ratio = (newlogprob - logprobs[:, mb].flatten()).exp()
                mb_advantages = advantages[:, mb].flatten()
                if len(mb_advantages) > 1:  # one step has no standard deviation
                    mb_advantages = (mb_advantages - mb_advantages.mean()) / (mb_advantages.std() + 1e-8)
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                pg_loss = -torch.min(mb_advantages * ratio, mb_advantages * clipped).mean()
                v_loss = 0.5 * (newvalue - returns[:, mb].flatten()).square().mean()
                loss = pg_loss - args.ent_coef * entropy.mean() + args.vf_coef * v_loss
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()

        steps = iteration * batch_size
        mean = f"{np.mean(returns_of_episodes):.3f}" if returns_of_episodes else "none yet"
        sps = steps / (time.time() - start_time)
        print(f"steps={steps} steps_per_second={sps:.0f} mean_return={mean} loss={loss.item():.4f}", flush=True)
    envs.close()
