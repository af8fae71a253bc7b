"""Asynchronous actors and one learner on one host, in the style of Sample Factory: recurrent PPO with V-trace in one file.

pip install ./bindings/python torch tyro
python asynchronous_actors.py --actors 2 --total-timesteps 400000
python asynchronous_actors.py --actors 2 --total-timesteps 400000 --service

Actors never wait for the learner's update, nor the learner for an actor that is in the middle of a trajectory:

    learner ── weights and their version, in shared memory ──> actor 0, actor 1, ...
            <── trajectories in slots of shared memory, their numbers through a pipe ──

* An actor copies the newest weights, plays one trajectory with them into a free slot, and sends the number of the slot.
* The learner copies trajectories into a batch, which frees their slots, learns from the batch and publishes new weights.
* A trajectory may come from an older policy than the one that learns from it. Its *policy lag* is the number of versions between
  them. A trajectory with a lag above `--max-policy-lag` is dropped; V-trace (Espeholt et al., 2018) corrects the value targets of
  the others, and the clipped probability ratio to the stored log-probabilities bounds the policy update.

The task is one command of Mortar Mayhem: an agent without memory earns 0.025 of at most 0.1.
"""

import json
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np
import torch
import torch.multiprocessing as mp
import tyro
from torch import nn
from torch.distributions import Categorical
from torch.nn.utils import parameters_to_vector, vector_to_parameters

import endless_gym

#: While an actor fills one slot, the learner may still read the other.
SLOTS_PER_ACTOR = 2
#: Seconds that actors have to close their environments before they are killed.
CLOSE_TIMEOUT = 5.0


@dataclass
class Args:
    env_id: str = "MortarMayhem-Grid-v0"
    """environment id"""
    options: str = '{"command_count": [1]}'
    """reset parameters, as JSON"""
    total_timesteps: int = 400_000
    """environment steps to learn from"""
    actors: int = 2
    """number of actor processes"""
    num_envs: int = 16
    """environments of each actor"""
    num_steps: int = 64
    """length of a trajectory"""
    service: bool = False
    """step the environments of each actor in a separate engine process, over shared memory, instead of in the actor"""
    batch_trajectories: int = 4
    """trajectories of one update"""
    max_policy_lag: int = 4
    """trajectories that are older than this number of versions are dropped"""
    num_minibatches: int = 4
    """minibatches per epoch; each contains the complete sequences of some environments"""
    update_epochs: int = 3
    """epochs per update"""
    learning_rate: float = 1e-3
    """learning rate of Adam"""
    gamma: float = 0.99
    """discount factor"""
    trace_lambda: float = 0.95
    """lambda of the traces"""
    clip_coef: float = 0.1
    """clip range of the probability ratio"""
    ent_coef: float = 1e-2
    """entropy coefficient"""
    vf_coef: float = 0.5
    """value loss coefficient"""
    max_grad_norm: float = 0.5
    """maximum gradient norm"""
    hidden_size: int = 128
    """hidden size of the GRU"""
    seed: int = 1
    """seed of the environments, the network and the minibatches; the order in which actors finish is not seeded"""
    cuda: bool = False
    """learn on a GPU; the actors use the CPU"""


class ActorLost(Exception):
    """An actor has ended."""


class Agent(nn.Module):
    """A GRU over the features, one policy head for each branch of the action space, and a value head."""

    def __init__(self, features: int, action_sizes: list[int], hidden_size: int) -> None:
        super().__init__()
        self.action_sizes = action_sizes
        self.encoder = nn.Sequential(nn.Linear(features, hidden_size), nn.ReLU())
        self.gru = nn.GRU(hidden_size, hidden_size)
        self.actor = nn.Sequential(nn.Linear(hidden_size, 64), nn.ReLU(), nn.Linear(64, sum(action_sizes)))
        self.critic = nn.Sequential(nn.Linear(hidden_size, 64), nn.ReLU(), nn.Linear(64, 1))
        for name, parameter in self.named_parameters():
            if "weight" in name:
                nn.init.orthogonal_(parameter, 1.0 if name.startswith("gru") else 2**0.5)
            else:
                nn.init.zeros_(parameter)
        # Rewards are small: it would take updates to unlearn large initial values.
        for head, gain in ((self.actor, 0.01), (self.critic, 0.05)):
            nn.init.orthogonal_(head[-1].weight, gain)

    def forward(
        self, obs: torch.Tensor, first: torch.Tensor, state: torch.Tensor
    ) -> tuple[list[Categorical], torch.Tensor, torch.Tensor]:
        """Policy of each branch and values (steps, envs), and the GRU's last state (1, envs, hidden_size).

        `obs` is (steps, envs, features). Where `first`, (steps, envs), is 1, an episode starts and the state is zeroed.
        """
        outputs = []
        for x, start in zip(self.encoder(obs), first, strict=True):
            x, state = self.gru(x.unsqueeze(0), state * (1.0 - start).view(1, -1, 1))
            outputs.append(x)
        hidden = torch.cat(outputs)
        heads = [Categorical(logits=logits) for logits in self.actor(hidden).split(self.action_sizes, dim=-1)]
        return heads, self.critic(hidden).squeeze(-1), state


def log_prob_of(heads: list[Categorical], action: torch.Tensor) -> torch.Tensor:
    return sum(head.log_prob(action[..., i]) for i, head in enumerate(heads))


class Shared:
    """The memory that the processes share. PyTorch removes its names at once, so that no process can leave any behind."""

    def __init__(self, args: Args, features: int, branches: int, weights: torch.Tensor) -> None:
        slots, steps, envs = args.actors * SLOTS_PER_ACTOR, args.num_steps, args.num_envs
        # One more observation than steps: the last one is used only for the value estimate after the last step.
        self.slots = {
            "obs": torch.zeros(slots, steps + 1, envs, features),
            "first": torch.zeros(slots, steps + 1, envs),
            "action": torch.zeros(slots, steps, envs, branches, dtype=torch.long),
            "log_prob": torch.zeros(slots, steps, envs),
            "reward": torch.zeros(slots, steps, envs),
            "state": torch.zeros(slots, 1, envs, args.hidden_size),
            "version": torch.zeros(slots, dtype=torch.long),
        }
        self.weights, self.version = weights.detach().cpu().clone(), torch.zeros((), dtype=torch.long)
        for tensor in (*self.slots.values(), self.weights, self.version):
            tensor.share_memory_()


def publish(shared: Shared, agent: Agent, version: int) -> None:
    weights = parameters_to_vector(agent.parameters()).detach().cpu()
    shared.version.fill_(2 * version - 1)  # odd: being written
    shared.weights.copy_(weights)
    shared.version.fill_(2 * version)


def newest(shared: Shared) -> tuple[torch.Tensor, int]:
    """A copy of the newest weights, and their version.

    There is no lock, since a killed actor could hold it. The stored log-probabilities are always those of the weights that acted,
    so even a mixture of two versions would be a valid policy.
    """
    while True:
        before, weights, after = int(shared.version), shared.weights.clone(), int(shared.version)
        if before == after and before % 2 == 0:
            return weights, before // 2
        time.sleep(1e-4)


def act(number: int, args: Args, action_sizes: list[int], shared: Shared, pipe: Connection) -> None:
    """The process of an actor. It ends when the learner closes the pipe or has ended."""
    torch.set_num_threads(1)
    torch.manual_seed(args.seed * 1000 + number)
    make = endless_gym.serve if args.service else endless_gym.make_vec
    envs = make(
        args.env_id,
        args.num_envs,
        num_threads=1,
        seed=args.seed,
        # All actors together use the same seeds as one call with all environments.
        first_env=number * args.num_envs,
        total_envs=args.actors * args.num_envs,
        options=json.loads(args.options),
        observation="features",
        autoreset="same_step",
    )
    with envs, torch.no_grad():
        obs, _ = envs.reset()
        obs, first = torch.tensor(obs), torch.ones(args.num_envs)
        agent = Agent(obs.shape[1], action_sizes, args.hidden_size)
        state = torch.zeros(1, args.num_envs, args.hidden_size)
        try:
            while True:
                slot = pipe.recv()  # waits if the learner is slower
                to = {name: tensor[slot] for name, tensor in shared.slots.items()}
                weights, version = newest(shared)
                vector_to_parameters(weights, agent.parameters())
                to["version"].fill_(version)
                to["state"].copy_(state)
                returns: list[float] = []
                for step in range(args.num_steps):
                    to["obs"][step], to["first"][step] = obs, first
                    heads, _, state = agent(obs.unsqueeze(0), first.unsqueeze(0), state)
                    action = torch.stack([head.sample() for head in heads], dim=-1)
                    to["action"][step], to["log_prob"][step] = action[0], log_prob_of(heads, action)[0]
                    chosen = action[0] if len(action_sizes) > 1 else action[0, :, 0]
                    new, reward, terminated, truncated, info = envs.step(chosen.numpy())
                    to["reward"][step] = torch.tensor(reward)
                    obs, first = torch.tensor(new), torch.tensor(terminated | truncated, dtype=torch.float32)
                    if "final_info" in info:
                        returns += info["final_info"]["reward"][info["_final_info"]].tolist()
                to["obs"][-1], to["first"][-1] = obs, first
                pipe.send((slot, returns))
        except (EOFError, BrokenPipeError, ConnectionResetError):
            pass  # the learner has ended


@contextmanager
def actors_of(
    args: Args, action_sizes: list[int], shared: Shared, context: Any
) -> Iterator[tuple[list[Any], list[Connection]]]:
    """The processes of the actors, and the pipes to them."""
    pipes, processes = [], []
    # Ctrl-C reaches all processes of a terminal. The actors ignore it from their start; the learner ends them.
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        for number in range(args.actors):
            here, there = context.Pipe()
            process = context.Process(target=act, args=(number, args, action_sizes, shared, there), daemon=True)
            process.start()
            # Only the actor has the other end, so that the pipe closes when the actor ends.
            there.close()
            pipes.append(here)
            processes.append(process)
        signal.signal(signal.SIGINT, handler)
        yield processes, pipes
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        for pipe in pipes:
            pipe.close()
        deadline = time.monotonic() + CLOSE_TIMEOUT
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()


def free(pipe: Connection, slot: int) -> None:
    # If the actor has ended, `receive` reports it.
    with suppress(BrokenPipeError, ConnectionResetError):
        pipe.send(slot)


def receive(processes: list[Any], pipes: list[Connection]) -> list[tuple[Connection, int, list[float]]]:
    """At least one complete trajectory: for each, the actor's pipe, the slot, and the returns of ended episodes.

    Raises:
        ActorLost: An actor has ended.
    """
    ready = wait([*pipes, *(process.sentinel for process in processes)])
    for number, process in enumerate(processes):
        if process.sentinel in ready:
            process.join()
            raise ActorLost(f"actor {number} (process {process.pid}) has ended with exit code {process.exitcode}")
    received = []
    for number, pipe in enumerate(pipes):
        if pipe in ready:
            try:
                received.append((pipe, *pipe.recv()))
            except (EOFError, ConnectionResetError):
                raise ActorLost(f"actor {number} (process {processes[number].pid}) has ended") from None
    return received


def v_trace(
    values: torch.Tensor, reward: torch.Tensor, goes_on: torch.Tensor, ratio: torch.Tensor, args: Args
) -> tuple[torch.Tensor, torch.Tensor]:
    """Value targets and advantages, (steps, envs), of the current policy from the steps of an older one.

    `values` are (steps + 1, envs). `goes_on` is 0 where a step ends its episode. `ratio` is the probability of the actions under
    the current policy divided by that under the older one.
    """
    rho = ratio.clamp(max=1.0)
    targets, trace = values.clone(), torch.zeros_like(reward[0])
    for t in reversed(range(len(reward))):
        delta = rho[t] * (reward[t] + args.gamma * goes_on[t] * values[t + 1] - values[t])
        trace = delta + args.gamma * args.trace_lambda * goes_on[t] * rho[t] * trace
        targets[t] = values[t] + trace
    return targets[:-1], reward + args.gamma * goes_on * targets[1:] - values[:-1]


def learn(agent: Agent, optimizer: torch.optim.Optimizer, batch: dict[str, torch.Tensor], args: Args) -> float:
    """One update, and the loss of its last minibatch."""
    obs, first, state = batch["obs"], batch["first"], batch["state"]
    goes_on = 1.0 - first[1:]
    with torch.no_grad():
        heads, values, _ = agent(obs, first, state)
        current = log_prob_of([Categorical(logits=head.logits[:-1]) for head in heads], batch["action"])
        ratio = (current - batch["log_prob"]).exp()
        targets, advantages = v_trace(values, batch["reward"], goes_on, ratio, args)
        if advantages.numel() > 1:  # one step has no standard deviation
            advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    for _ in range(args.update_epochs):
        for mb in torch.randperm(obs.shape[1], device=obs.device).chunk(args.num_minibatches):
            heads, newvalue, _ = agent(obs[:-1, mb], first[:-1, mb], state[:, mb])
            ratio = (log_prob_of(heads, batch["action"][:, mb]) - batch["log_prob"][:, mb]).exp()
            clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
            pg_loss = -torch.min(advantages[:, mb] * ratio, advantages[:, mb] * clipped).mean()
            v_loss = 0.5 * (newvalue - targets[:, mb]).square().mean()
            entropy = sum(head.entropy() for head in heads).mean()
            loss = pg_loss - args.ent_coef * entropy + args.vf_coef * v_loss
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
            optimizer.step()
    return loss.item()


def main() -> None:
    args = tyro.cli(Args)
    per_update = args.batch_trajectories * args.num_steps * args.num_envs
    if args.total_timesteps < per_update:
        raise SystemExit(f"--total-timesteps must be at least those of one update, {per_update}")
    if args.actors < 1 or args.max_policy_lag < 0:
        raise SystemExit("--actors must be 1 or more, and --max-policy-lag 0 or more")
    torch.manual_seed(args.seed)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")

    spec = endless_gym.spec(args.env_id)
    with endless_gym.make_vec(args.env_id, 1, options=json.loads(args.options), observation="features") as envs:
        features = envs.single_observation_space.shape[0]
    agent = Agent(features, list(spec.branches), args.hidden_size).to(device)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate)
    # A forked process would share the learner's threads and the ends of all pipes.
    context = mp.get_context("spawn")
    shared = Shared(args, features, len(spec.branches), parameters_to_vector(agent.parameters()))

    returns_of_episodes: deque[float] = deque(maxlen=200)
    trajectories: list[dict[str, torch.Tensor]] = []
    lags: list[int] = []
    version, steps, dropped, largest_lag, start_time = 0, 0, 0, 0, time.time()
    try:
        with actors_of(args, list(spec.branches), shared, context) as (processes, pipes):
            print(f"learner={os.getpid()} actors={','.join(str(process.pid) for process in processes)}", flush=True)
            for number, pipe in enumerate(pipes):
                for slot in range(SLOTS_PER_ACTOR):
                    free(pipe, number * SLOTS_PER_ACTOR + slot)
            while steps + per_update <= args.total_timesteps:
                for pipe, slot, returns in receive(processes, pipes):
                    trajectories.append({name: tensor[slot].clone() for name, tensor in shared.slots.items()})
                    free(pipe, slot)
                    returns_of_episodes.extend(returns)
                # The lag is measured at the update, for which a trajectory may have waited.
                fresh = [each for each in trajectories if version - int(each["version"]) <= args.max_policy_lag]
                dropped += len(trajectories) - len(fresh)
                batch, trajectories = fresh[: args.batch_trajectories], fresh[args.batch_trajectories :]
                if len(batch) < args.batch_trajectories:
                    trajectories = batch
                    continue
                lags += [version - int(each.pop("version")) for each in batch]
                largest_lag = max(largest_lag, *lags)
                joined = {name: torch.cat([each[name] for each in batch], dim=1).to(device) for name in batch[0]}
                loss = learn(agent, optimizer, joined, args)
                version, steps = version + 1, steps + per_update
                publish(shared, agent, version)
                if version % 5 == 0 or steps + per_update > args.total_timesteps:
                    mean = f"{np.mean(returns_of_episodes):.3f}" if returns_of_episodes else "none yet"
                    lag = f"policy_lag={np.mean(lags):.2f} largest_lag={largest_lag} dropped={dropped}"
                    sps = steps / (time.time() - start_time)
                    print(
                        f"steps={steps} steps_per_second={sps:.0f} {lag} mean_return={mean} loss={loss:.4f}", flush=True
                    )
                    lags.clear()
    except KeyboardInterrupt:
        sys.exit(f"stopped by Ctrl-C after {steps} steps")
    except ActorLost as error:
        sys.exit(f"stopped after {steps} steps: {error}")


if __name__ == "__main__":
    main()
