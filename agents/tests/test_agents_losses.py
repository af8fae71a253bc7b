"""Advantages and losses against values computed by a plain loop."""

import math
from dataclasses import replace

import pytest
import torch
from agents_helpers import BRANCHES, ends, loss_of, make, observations, segment_of, settings
from operations import Operations

from endless_gym_agents.agent.agent import Agent
from endless_gym_agents.agent.encoders import FRAME
from endless_gym_agents.memories.memory import MemoryState, Minibatch
from endless_gym_agents.settings import PPO, PRESETS
from endless_gym_agents.training import losses
from endless_gym_agents.training.ppo import learn, learning_rate_factor, linear_decay, make_optimizer, minibatch_loss
from endless_gym_agents.training.rollout import Segment

GAMMA, LAMBDA = 0.9, 0.8


@pytest.mark.parametrize("steps", [1, 2, 7, 8, 12])
def test_advantages_are_discounted_sums_of_td_errors(steps: int) -> None:
    """By definition: TD errors, discounted with gamma * lambda, up to the end of the episode or the segment."""
    envs = 4
    rewards, values, last = torch.randn(steps, envs), torch.randn(steps, envs), torch.randn(envs)
    dones = ends(steps, envs)
    advantages = losses.generalised_advantages(rewards, values, dones, last, GAMMA, LAMBDA)
    for env in range(envs):
        for start in range(steps):
            total, weight = 0.0, 1.0
            for t in range(start, steps):
                following = float(last[env] if t == steps - 1 else values[t + 1, env])
                following = 0.0 if dones[t, env] else following
                total += weight * (float(rewards[t, env]) + GAMMA * following - float(values[t, env]))
                weight *= GAMMA * LAMBDA
                if dones[t, env]:
                    break
            assert float(advantages[start, env]) == pytest.approx(total, abs=1e-5)


def test_one_advantage_is_not_normalised() -> None:
    one, two = torch.tensor([[3.0]]), torch.tensor([1.0, 3.0])
    assert losses.normalised(one).equal(one) and losses.normalised(two, one).equal(two)
    assert losses.normalised(two).tolist() == pytest.approx([-(0.5**0.5), 0.5**0.5])


def test_advantages_of_long_segments_take_few_operations() -> None:
    steps, envs = 512, 2
    rewards, values, last = torch.randn(steps, envs), torch.randn(steps, envs), torch.randn(envs)
    with Operations() as operations:
        losses.generalised_advantages(rewards, values, ends(steps, envs), last, 0.995, 0.95)
    assert operations.computed <= 40


def test_explained_variance_is_1_for_equal_values_and_nan_without_variance() -> None:
    returns = torch.tensor([0.0, 2.0, 4.0])
    assert losses.explained_variance(returns.clone(), returns) == 1.0
    assert losses.explained_variance(torch.zeros(3), returns) == 0.0
    assert losses.explained_variance(returns / 2, returns) == pytest.approx(0.75)
    assert math.isnan(losses.explained_variance(returns, torch.ones(3)))
    assert math.isnan(losses.explained_variance(returns[:1], returns[:1]))


def test_coefficients_decay_linearly_to_their_final_value() -> None:
    assert linear_decay(2.75e-4, 1e-5, 0, 10_000) == 2.75e-4
    assert linear_decay(2.75e-4, 1e-5, 5_000, 10_000) == pytest.approx((2.75e-4 + 1e-5) / 2)
    assert linear_decay(2.75e-4, 1e-5, 10_000, 10_000) == 1e-5
    assert linear_decay(2.75e-4, 1e-5, 99_999, 10_000) == 1e-5


def played(kind: str) -> tuple[Agent, Segment, MemoryState]:
    """A segment of 16 steps of 4 environments, and the memory's state after it."""
    agent = make(kind)
    memory = agent.initial_memory(4)
    segment = segment_of(agent, memory, {"features": observations(16, 4)}, 16, 4)
    return agent, segment, memory.state


@pytest.mark.parametrize("normalisation", ["none", "minibatch"])
@pytest.mark.parametrize("kind", ["none", "gru", "trxl"])
def test_minibatch_loss_is_the_weighted_sum(kind: str, normalisation: str) -> None:
    """The expected sum is computed from the outputs of the network in a loop over the steps."""
    ppo = {"ground_truth_coefficient": 0.3, "advantage_normalisation": normalisation, "clip_range": 0.1}
    given = settings(kind, ppo=ppo)
    torch.manual_seed(3)
    agent = Agent(given, {"features": (6,)}, BRANCHES, ground_truth=2)
    memory = agent.initial_memory(4)
    segment = segment_of(agent, memory, {"features": observations(16, 4)}, 16, 4)
    minibatch, *_ = agent.memory.minibatches([memory.state], segment.reset_mask, 3, torch.Generator().manual_seed(0))
    segment, advantages, returns = segment.flat(), torch.randn(64), torch.randn(64)
    loss, parts = minibatch_loss(agent, segment, minibatch, advantages, returns, given.ppo, 0.05)

    chosen = minibatch.indices.tolist()
    mean = sum(float(advantages[i]) for i in chosen) / len(chosen)
    deviation = math.sqrt(sum((float(advantages[i]) - mean) ** 2 for i in chosen) / (len(chosen) - 1))
    output = agent({"features": segment.observation["features"][minibatch.indices]}, minibatch)
    total = 0.0
    for row, i in enumerate(chosen):
        advantage = float(advantages[i])
        if normalisation == "minibatch":
            advantage = (advantage - mean) / deviation
        for branch, logits in enumerate(output.logits):
            p = torch.softmax(logits[row], 0)
            ratio = float(p[segment.action[i, branch]]) / math.exp(float(segment.log_prob[i, branch]))
            clipped = min(max(ratio, 0.9), 1.1)
            total -= min(ratio * advantage, clipped * advantage) / len(BRANCHES)
            total += 0.05 * float((p * p.log()).sum())
        v, old, target = float(output.value[row]), float(segment.value[i]), float(returns[i])
        v_clipped = min(max(v, old - 0.1), old + 0.1)
        total += 0.5 * max((v - target) ** 2, (v_clipped - target) ** 2)
        error = output.ground_truth[row] - segment.ground_truth[i]
        total += 0.3 * float((error**2).mean())
    assert float(loss) == pytest.approx(total / len(chosen), abs=1e-4)
    assert 0 < float(parts["clip_fraction"]) < 1
    assert float(parts["kl_divergence"]) > 0


def test_reconstruction_is_a_term_of_the_loss() -> None:
    """The coefficient adds its multiple of the mean binary cross-entropy to the loss."""
    shapes, frames = {FRAME: (84, 84, 3)}, torch.randint(0, 256, (4, 84, 84, 3), dtype=torch.uint8)
    given = settings("none", ppo={"reconstruction_coefficient": 0.1}, environment={"observation": "rgb"})
    torch.manual_seed(3)
    agent, numbers = Agent(given, shapes, BRANCHES), torch.zeros(4)
    action, done = torch.zeros(4, 2, dtype=torch.long), torch.zeros(4, dtype=torch.bool)
    segment = Segment({FRAME: frames}, done, action, torch.zeros(4, 2), numbers, numbers, done, None, torch.zeros(1))
    terms = []
    for coefficient in (0.1, 0.0):
        ppo = replace(given.ppo, reconstruction_coefficient=coefficient)
        loss, parts = minibatch_loss(
            agent, segment, Minibatch(torch.arange(4), torch.arange(4)), numbers, numbers, ppo, 0.05
        )
        terms.append(float(loss))
    output = agent({FRAME: frames}, Minibatch(torch.arange(4), torch.arange(4)))
    p = torch.sigmoid(output.frame.detach().double())
    target = frames.permute(0, 3, 1, 2).double() / 255.0
    entropy = float(-(target * p.log() + (1 - target) * (1 - p).log()).mean())
    assert float(parts["reconstruction_loss"]) == pytest.approx(entropy, rel=1e-4)
    assert terms[0] - terms[1] == pytest.approx(0.1 * entropy, rel=1e-3)


def test_learning_is_adamw_on_clipped_gradients() -> None:
    """One epoch of one minibatch, against the same optimizer step computed by hand."""
    agent, segment, state = played("gru")
    ppo = PPO(epochs=1, minibatches=1, steps=16, max_gradient_norm=0.01, decay_updates=10)
    other = make("gru")
    other.load_state_dict(agent.state_dict())
    optimizer = torch.optim.AdamW(agent.parameters(), lr=1.0)
    measures = learn(agent, optimizer, segment, [state], 5, ppo, torch.Generator().manual_seed(0))
    assert measures["learning_rate"] == pytest.approx((2.75e-4 + 1e-5) / 2)
    assert measures["gradient_norm"] > 0.01

    loss_of(other, segment, state, ppo, measures["entropy_coefficient"]).backward()
    norm = math.sqrt(sum(float(p.grad.square().sum()) for p in other.parameters() if p.grad is not None))
    assert measures["gradient_norm"] == pytest.approx(norm, rel=1e-4)
    rate = measures["learning_rate"]
    for (name, learned), before in zip(agent.named_parameters(), other.parameters(), strict=True):
        gradient = before.grad * (0.01 / (norm + 1e-6))
        # First step of AdamW: weight decay of 0.01, then the gradient divided by its absolute value.
        expected = before * (1 - rate * 0.01) - rate * gradient / (gradient.abs() + 1e-8)
        torch.testing.assert_close(learned, expected, rtol=1e-4, atol=1e-6, msg=name)


def test_batch_normalisation_is_over_the_whole_segment() -> None:
    """With one minibatch both kinds are equal; with several they differ."""
    results = {}
    for kind in ("batch", "minibatch", "none"):
        for minibatches in (1, 4):
            agent, segment, state = played("none")
            ppo = PPO(epochs=1, minibatches=minibatches, steps=16, advantage_normalisation=kind)
            optimizer = torch.optim.AdamW(agent.parameters(), lr=1e-3)
            learn(agent, optimizer, segment, [state], 0, ppo, torch.Generator().manual_seed(0))
            results[kind, minibatches] = torch.cat([parameter.flatten() for parameter in agent.parameters()])
    torch.testing.assert_close(results["batch", 1], results["minibatch", 1])
    assert not torch.allclose(results["batch", 4], results["minibatch", 4])
    assert not torch.allclose(results["batch", 1], results["none", 1])


def test_the_presets_of_the_paper_decay_all_weights_as_its_authors_do() -> None:
    """neroRL (commit 0057ee4) makes AdamW of all parameters, with PyTorch's defaults."""
    for name in ("paper", "old", "overnight"):
        for kind in ("gru", "trxl", "gtrxl"):
            agent = make(kind, ppo={"weight_decay": PRESETS[name].ppo.weight_decay})
            (group,) = make_optimizer(agent, 1e-3).param_groups
            assert group["params"] == list(agent.parameters())
            assert group["weight_decay"] == torch.optim.AdamW(agent.parameters()).defaults["weight_decay"] == 0.01


@pytest.mark.parametrize("decayed", ["all", "matrices"])
def test_biases_norms_and_marked_weights_do_not_decay(decayed: str) -> None:
    agent = make("ffm", ppo={"weight_decay": decayed})
    mixing = agent.get_parameter("memory.cell.layers.0.mix.weight")
    mixing._learning_rate_factor = 0.25  # type: ignore[attr-defined]
    optimizer = make_optimizer(agent, 0.1)
    before = {name: weight.detach().clone() for name, weight in agent.named_parameters()}
    # With a gradient of 0, a step is the decay alone.
    sum(weight.sum() for weight in agent.parameters()).mul(0).backward()
    for group in optimizer.param_groups:
        group["lr"] = 0.1 * learning_rate_factor(group["params"][0])
    optimizer.step()
    for name, weight in agent.named_parameters():
        is_marked = name in ("memory.cell.layers.0.a", "memory.cell.layers.0.b")
        decays = not is_marked and (decayed == "all" or weight.dim() > 1)
        rate = 0.1 * (0.25 if weight is mixing else 1.0)
        expected = before[name] * (1 - rate * 0.01 if decays else 1.0)
        torch.testing.assert_close(weight.detach(), expected, rtol=1e-6, atol=0, msg=name)


def test_a_factor_multiplies_the_learning_rate() -> None:
    agent, segment, state = played("ffm")
    mixing = agent.get_parameter("memory.cell.layers.0.mix.weight")
    mixing._learning_rate_factor = 0.25  # type: ignore[attr-defined]
    optimizer, before = make_optimizer(agent, 1.0), [weight.detach().clone() for weight in agent.parameters()]
    ppo = PPO(epochs=1, minibatches=1, steps=16, learning_rate=1e-3)
    learn(agent, optimizer, segment, [state], 0, ppo, torch.Generator().manual_seed(0))
    for (name, weight), old in zip(agent.named_parameters(), before, strict=True):
        # The first step of AdamW is as long as the learning rate.
        expected = 1e-3 * (0.25 if weight is mixing else 1.0)
        assert float((weight - old).abs().max()) == pytest.approx(expected, rel=0.05), name
