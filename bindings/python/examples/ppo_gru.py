"""Recurrent PPO with a GRU in one file, to be read from top to bottom and changed.

It learns from feature observations or frames, with either auto-reset mode, writes a log and a checkpoint, and resumes.

pip install ./bindings/python torch tyro
python ppo_gru.py --env-id MortarMayhem-Grid-v0 --option 'command_count=[1]' --total-timesteps 500000
python ppo_gru.py --resume --run runs/ppo_gru --total-timesteps 1000000
"""

import json
import math
import os
import time
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from torch import Tensor, nn

from endless_gym import make_vec, spec, torch_view


@dataclass
class Args:
    """The hyperparameters of `endless-train --preset quick`."""

    env_id: str = "MortarMayhem-Grid-v0"
    """environment id"""
    option: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """reset parameter as NAME=VALUE with a JSON value; may be repeated"""
    observation: Literal["features", "rgb"] = "features"
    """a vector that describes the frame, or the frame"""
    autoreset: Literal["same_step", "next_step"] = "same_step"
    """same_step: the step that ends an episode returns the first observation of the next one; next_step: it returns the last
    observation, and the next step, whose action is ignored, returns the first one"""
    run: Path = Path("runs/ppo_gru")
    """folder of the log and the checkpoint"""
    resume: bool = False
    """continue the run in that folder; its environments start new episodes"""
    total_timesteps: int = 2_000_000
    """environment steps in total"""
    num_envs: int = 64
    """number of environments"""
    num_steps: int = 64
    """steps of each environment in an update; gradients flow through as many"""
    num_minibatches: int = 4
    """minibatches per epoch; each has all steps of some environments"""
    update_epochs: int = 3
    """epochs per update"""
    decay_updates: int = 2_000
    """updates over which the learning rate and the entropy coefficient decay linearly"""
    learning_rate: tuple[float, float] = (1e-3, 1e-4)
    """learning rate of AdamW at the first update and after the decay"""
    ent_coef: tuple[float, float] = (1e-2, 1e-3)
    """entropy coefficient at the first update and after the decay"""
    gamma: float = 0.99
    """discount factor"""
    gae_lambda: float = 0.95
    """lambda of generalised advantage estimation"""
    clip_coef: float = 0.1
    """clip range of the probability ratio and of the value"""
    vf_coef: float = 0.5
    """value loss coefficient"""
    max_grad_norm: float = 0.5
    """largest norm of the gradient"""
    hidden_size: int = 128
    """size of the GRU's state"""
    head_size: int = 64
    """units of the encoder of vectors and of the hidden layers of the policy and the value"""
    checkpoint_every: int = 50
    """updates between two checkpoints"""
    seed: int = 1
    """seed of the network, the episodes and all sampling"""
    cuda: bool = True
    """use CUDA if available"""


def layer(inputs: int, outputs: int, gain: float = math.sqrt(2)) -> nn.Linear:
    """A fully connected layer with orthogonal weights."""
    made = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(made.weight, gain)
    return made


class Agent(nn.Module):
    """Encoder, GRU, and heads for the policy, with one branch for each part of the action, and for the value."""

    def __init__(self, shapes: dict[str, tuple[int, ...]], branches: tuple[int, ...], args: Args) -> None:
        super().__init__()
        self.hidden_size = args.hidden_size
        self.branches = branches
        self.vectors = [key for key, shape in shapes.items() if len(shape) == 1]
        self.convolutions: nn.Sequential | None = None
        width = args.head_size if self.vectors else 0
        if "visual_observation" in shapes:
            channels = shapes["visual_observation"][-1]
            self.convolutions = nn.Sequential(
                *(nn.Conv2d(channels, 32, 8, stride=4), nn.ReLU(), nn.Conv2d(32, 64, 4, stride=2), nn.ReLU()),
                *(nn.Conv2d(64, 64, 3, stride=1), nn.ReLU(), nn.Flatten()),
            )
            width += 64 * 7 * 7
        if self.vectors:
            self.vector = nn.Sequential(layer(sum(shapes[key][0] for key in self.vectors), args.head_size), nn.ReLU())
        self.embedding = nn.Sequential(layer(width, args.hidden_size), nn.ReLU())
        self.gru = nn.GRUCell(args.hidden_size, args.hidden_size)
        for name, parameter in self.gru.named_parameters():
            nn.init.orthogonal_(parameter, math.sqrt(2)) if "weight" in name else nn.init.zeros_(parameter)
        self.body = nn.Sequential(layer(args.hidden_size, args.hidden_size), nn.ReLU())
        head = args.head_size
        # Small weights make the first policy nearly uniform and the first values small.
        self.policy = nn.Sequential(layer(args.hidden_size, head), nn.ReLU(), layer(head, sum(branches), 0.1))
        self.value = nn.Sequential(layer(args.hidden_size, head), nn.ReLU(), layer(head, 1, 0.05))

    def encode(self, observation: dict[str, Tensor]) -> Tensor:
        """The GRU's inputs for n observations, float (n, hidden size)."""
        parts = []
        if self.convolutions is not None:
            frames = observation["visual_observation"].permute(0, 3, 1, 2).float() / 255.0
            parts.append(self.convolutions(frames))
        if self.vectors:
            parts.append(self.vector(torch.cat([observation[key] for key in self.vectors], dim=-1)))
        return self.embedding(torch.cat(parts, dim=-1))

    def heads(self, hidden: Tensor) -> tuple[list[Tensor], Tensor]:
        """The log-probabilities of each branch, (n, choices) each, and the values (n,)."""
        body = self.body(hidden)
        logits = self.policy(body).split(self.branches, dim=-1)
        return [each.log_softmax(-1) for each in logits], self.value(body).squeeze(-1)

    def sequences(self, observation: dict[str, Tensor], start: Tensor, hidden: Tensor) -> tuple[list[Tensor], Tensor]:
        """The heads' outputs for T steps of n environments, with gradients through time.

        Args:
            observation: Observations, (T, n, ...).
            start: Whether each observation is the first of an episode, bool (T, n).
            hidden: States before the first step, (n, hidden size).
        """
        steps, envs = start.shape
        encoded = self.encode({key: part.flatten(0, 1) for key, part in observation.items()}).view(steps, envs, -1)
        states = []
        for x, first in zip(encoded, start, strict=True):
            # What happened before an episode must not influence it.
            hidden = self.gru(x, hidden.masked_fill(first.unsqueeze(-1), 0.0))
            states.append(hidden)
        return self.heads(torch.stack(states).flatten(0, 1))


def chosen_log_probs(log_probs: list[Tensor], actions: Tensor) -> Tensor:
    """The log-probabilities of actions int64 (n, branches), (n, branches)."""
    return torch.cat([each.gather(1, actions[:, i : i + 1]) for i, each in enumerate(log_probs)], dim=1)


def advantages_of(reward: Tensor, value: Tensor, done: Tensor, valid: Tensor, last_value: Tensor, args: Args) -> Tensor:
    """Generalised advantage estimation over T steps, (T, n).

    The value after a step that ended an episode does not count: it belongs to the next episode, or with next-step auto-reset to
    the last observation. A step that only resets (`valid` is false) has no advantage, and no step before it looks beyond it,
    since that one ended its episode.
    """
    advantages, advantage, following = torch.zeros_like(reward), torch.zeros_like(last_value), last_value
    for t in reversed(range(len(reward))):
        continues = (~done[t]).float()
        delta = reward[t] + args.gamma * following * continues - value[t]
        advantage = (delta + args.gamma * args.gae_lambda * continues * advantage) * valid[t].float()
        advantages[t], following = advantage, value[t]
    return advantages


def decayed(ends: tuple[float, float], update: int, args: Args) -> float:
    """The value of a schedule at an update."""
    return ends[1] + (ends[0] - ends[1]) * max(0.0, 1.0 - update / args.decay_updates)


class Trainer:
    """The environments, the agent and the state of a run."""

    def __init__(self, args: Args) -> None:
        self.args = args
        torch.manual_seed(args.seed)
        self.device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
        described = spec(args.env_id)
        options = {name: json.loads(value) for name, _, value in (each.partition("=") for each in args.option)}
        self.envs = make_vec(
            args.env_id,
            args.num_envs,
            seed=args.seed,
            seeds=range(100_000),  # evaluate on other seeds
            options=options,
            observation=args.observation,
            autoreset=args.autoreset,
        )
        self.shape_actions = described.batched_actions
        observation, _ = self.envs.reset()
        self.observation = self.tensors(observation)
        shapes = {key: tuple(part.shape[1:]) for key, part in self.observation.items()}
        self.agent = Agent(shapes, tuple(described.branches), args).to(self.device)
        self.optimizer = torch.optim.AdamW(self.agent.parameters(), lr=args.learning_rate[0])
        self.hidden = torch.zeros(args.num_envs, args.hidden_size, device=self.device)
        #: Whether the current observation is the first of an episode, and whether the next action will be played.
        self.start = torch.ones(args.num_envs, dtype=torch.bool, device=self.device)
        self.valid = torch.ones(args.num_envs, dtype=torch.bool, device=self.device)
        self.update = self.steps = 0
        self.returns: deque[float] = deque(maxlen=100)

    def tensors(self, observation: Any) -> dict[str, Tensor]:
        """An observation by key, on the agent's device. A copy, since the environments reuse their memory."""
        key = "visual_observation" if self.args.observation == "rgb" else "features"
        parts = observation if isinstance(observation, dict) else {key: observation}
        return {key: torch_view(part).clone().to(self.device) for key, part in parts.items()}

    @torch.no_grad()
    def collect(self) -> dict[str, Any]:
        """Play `num_steps` steps; the tensors of the steps are (T, n, ...)."""
        rows: list[dict[str, Any]] = []
        first_hidden = self.hidden
        for _ in range(self.args.num_steps):
            self.hidden = self.hidden.masked_fill(self.start.unsqueeze(-1), 0.0)
            self.hidden = self.agent.gru(self.agent.encode(self.observation), self.hidden)
            log_probs, value = self.agent.heads(self.hidden)
            actions = torch.stack([torch.multinomial(each.exp(), 1).squeeze(-1) for each in log_probs], dim=-1)
            result = self.envs.step(self.shape_actions(actions.cpu().numpy()))
            observation, reward, terminated, truncated, info = result
            done = torch.from_numpy(terminated | truncated).to(self.device)
            rows.append(
                {
                    "observation": self.observation,
                    "start": self.start,
                    "valid": self.valid,
                    "actions": actions,
                    "log_prob": chosen_log_probs(log_probs, actions),
                    "value": value,
                    "reward": torch.from_numpy(reward).float().to(self.device),
                    "done": done,
                }
            )
            final = info.get("final_info", info)
            self.returns.extend(final["reward"][final["_reward"]].tolist() if "reward" in final else [])
            if self.args.autoreset == "same_step":
                self.start = done
            else:
                # After an end, one action is ignored; the observation that it returns starts the episode.
                self.start, self.valid = ~self.valid, ~done
            self.observation = self.tensors(observation)
        hidden = self.hidden.masked_fill(self.start.unsqueeze(-1), 0.0)
        last_value = self.agent.heads(self.agent.gru(self.agent.encode(self.observation), hidden))[1]
        batch = {name: torch.stack([row[name] for row in rows]) for name in rows[0] if name != "observation"}
        batch["observation"] = {key: torch.stack([row["observation"][key] for row in rows]) for key in self.observation}
        return batch | {"hidden": first_hidden, "last_value": last_value}

    def learn(self, batch: dict[str, Any]) -> dict[str, float]:
        """Optimise the agent on a batch; returns means over the minibatches."""
        args, n = self.args, self.args.num_envs
        entropy_coefficient = decayed(args.ent_coef, self.update, args)
        for group in self.optimizer.param_groups:
            group["lr"] = decayed(args.learning_rate, self.update, args)
        names = ("reward", "value", "done", "valid", "last_value")
        advantages = advantages_of(*(batch[name] for name in names), args)
        returns = advantages + batch["value"]
        logged: list[dict[str, float]] = []
        for _ in range(args.update_epochs):
            for envs in torch.randperm(n, device=self.device).chunk(args.num_minibatches):
                observation = {key: part[:, envs] for key, part in batch["observation"].items()}
                log_probs, value = self.agent.sequences(observation, batch["start"][:, envs], batch["hidden"][envs])
                # Steps that only reset an environment are computed, for the GRU, but not learnt from.
                valid = batch["valid"][:, envs].flatten()
                old = {name: batch[name][:, envs].flatten(0, 1)[valid] for name in ("actions", "log_prob", "value")}
                log_probs, value = [each[valid] for each in log_probs], value[valid]
                advantage, target = (each[:, envs].flatten()[valid] for each in (advantages, returns))
                if len(advantage) > 1:  # one step has no standard deviation
                    advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                advantage = advantage.unsqueeze(1)
                ratio = (chosen_log_probs(log_probs, old["actions"]) - old["log_prob"]).exp()
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                policy_loss = -torch.min(ratio * advantage, clipped * advantage).mean()
                near = old["value"] + (value - old["value"]).clamp(-args.clip_coef, args.clip_coef)
                value_loss = torch.max((value - target) ** 2, (near - target) ** 2).mean()
                entropy = torch.stack([-(each.exp() * each).sum(-1) for each in log_probs]).sum(0).mean()
                loss = policy_loss + args.vf_coef * value_loss - entropy_coefficient * entropy
                self.optimizer.zero_grad()
                loss.backward()
                norm = nn.utils.clip_grad_norm_(self.agent.parameters(), args.max_grad_norm)
                if not torch.isfinite(loss + norm):
                    raise SystemExit(f"update {self.update + 1} diverged; try a smaller --learning-rate")
                self.optimizer.step()
                terms = {"loss": loss, "policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
                logged.append({name: term.item() for name, term in terms.items()})
        return {name: float(np.mean([each[name] for each in logged])) for name in logged[0]}

    def save(self) -> None:
        """Write the checkpoint atomically."""
        state = {"agent": self.agent.state_dict(), "optimizer": self.optimizer.state_dict()}
        torch.save(state | {"update": self.update, "steps": self.steps}, self.args.run / "last.pt.new")
        os.replace(self.args.run / "last.pt.new", self.args.run / "last.pt")

    def load(self) -> None:
        """Continue from the checkpoint, with new episodes."""
        state = torch.load(self.args.run / "last.pt", map_location=self.device, weights_only=True)
        self.agent.load_state_dict(state["agent"])
        self.optimizer.load_state_dict(state["optimizer"])
        self.update, self.steps = state["update"], state["steps"]
        torch.manual_seed(self.args.seed + self.update)

    def train(self) -> None:
        """Train until `total_timesteps`."""
        per_update = self.args.num_envs * self.args.num_steps
        began, first = time.perf_counter(), self.steps
        with (self.args.run / "log.jsonl").open("a") as log:
            while self.steps < self.args.total_timesteps:
                metrics = self.learn(self.collect())
                self.update, self.steps = self.update + 1, self.steps + per_update
                mean = float(np.mean(self.returns)) if self.returns else None
                log.write(
                    json.dumps({"update": self.update, "steps": self.steps, "mean_return": mean} | metrics) + "\n"
                )
                log.flush()
                if self.update % self.args.checkpoint_every == 0 or self.steps >= self.args.total_timesteps:
                    self.save()
                speed = (self.steps - first) / (time.perf_counter() - began)
                shown = "none yet" if mean is None else f"{mean:.4f}"
                print(f"steps={self.steps} steps_per_second={speed:.0f} mean_return={shown} loss={metrics['loss']:.4f}")
        self.envs.close()


def main() -> None:
    args = tyro.cli(Args)
    args.run.mkdir(parents=True, exist_ok=True)
    if not args.resume and (args.run / "last.pt").exists():
        raise SystemExit(f"{args.run} has a run; add --resume, or choose another --run")
    if args.num_steps < 2 and args.autoreset == "next_step":
        raise SystemExit("--num-steps must be at least 2, since one step may only reset an environment")
    trainer = Trainer(args)
    if args.resume:
        trainer.load()
    (args.run / "settings.json").write_text(json.dumps(asdict(args), indent=1, default=str) + "\n")
    trainer.train()


if __name__ == "__main__":
    main()
