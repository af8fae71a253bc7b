"""Advantages and losses against values computed by hand or by a plain loop."""

import math
from dataclasses import replace

import pytest
import torch
from agents_helpers import BRANCHES, ends, make, observations, play, settings
from operations import Operations

from endless_gym_agents import losses
from endless_gym_agents.agent import Agent, AgentOutput
from endless_gym_agents.encoders import FRAME
from endless_gym_agents.memory import Minibatch
from endless_gym_agents.ppo import learn, linear_decay, minibatch_loss
from endless_gym_agents.rollout import Segment
from endless_gym_agents.settings import PPO, Environment

GAMMA, LAMBDA = 0.9, 0.8


def test_advantages_by_hand() -> None:
    """Three steps; the second one ends its episode."""
    rewards, values = torch.tensor([[1.0], [2.0], [4.0]]), torch.tensor([[0.5], [1.0], [3.0]])
    dones = torch.tensor([[False], [True], [False]])
    advantages = losses.generalised_advantages(rewards, values, dones, torch.tensor([10.0]), GAMMA, LAMBDA)
    third = 4.0 + 0.9 * 10.0 - 3.0  # 10
    second = 2.0 - 1.0  # end of the episode: no bootstrapping
    first = 1.0 + 0.9 * 1.0 - 0.5 + 0.9 * 0.8 * second  # 2.12
    torch.testing.assert_close(advantages.flatten(), torch.tensor([first, second, third]))


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


def test_advantages_of_long_segments_take_few_operations() -> None:
    steps, envs = 512, 2
    rewards, values, last = torch.randn(steps, envs), torch.randn(steps, envs), torch.randn(envs)
    with Operations() as operations:
        losses.generalised_advantages(rewards, values, ends(steps, envs), last, 0.995, 0.95)
    assert operations.computed <= 40


@pytest.mark.parametrize(
    ("ratio", "advantage", "expected"),
    [
        (1.0, 2.0, -2.0),
        (1.5, 2.0, -2.2),  # clipped to 1.1
        (0.5, 2.0, -1.0),  # not clipped
        (1.5, -2.0, 3.0),  # not clipped
        (0.5, -2.0, 1.8),  # clipped to 0.9
    ],
)
def test_policy_loss_clips_the_ratio_of_one_branch(ratio: float, advantage: float, expected: float) -> None:
    new, old = torch.tensor([[math.log(0.4 * ratio)]]), torch.tensor([[math.log(0.4)]])
    assert float(losses.policy_loss(new, old, torch.tensor([advantage]), 0.1)) == pytest.approx(expected, abs=1e-6)


def test_policy_loss_clips_each_branch_and_takes_the_mean() -> None:
    """The ratios 1.5 and 0.5, with the product 0.75, are clipped separately: (1.1 + 0.5) / 2."""
    new, old = torch.tensor([[1.5, 0.5]]).log(), torch.zeros(1, 2)
    assert float(losses.policy_loss(new, old, torch.tensor([1.0]), 0.1)) == pytest.approx(-0.8, abs=1e-6)


@pytest.mark.parametrize(
    ("value", "old", "target", "expected"),
    [
        (1.0, 1.0, 3.0, 4.0),
        (2.0, 1.0, 3.0, 1.9**2),  # clipped to 1.1, which has the larger error
        (5.0, 1.0, 1.0, 16.0),  # clipped to 1.1, which has the smaller error
        (1.05, 1.0, 0.0, 1.05**2),  # within the range
    ],
)
def test_value_loss_takes_the_larger_of_both_errors(value: float, old: float, target: float, expected: float) -> None:
    loss = losses.value_loss(torch.tensor([value]), torch.tensor([old]), torch.tensor([target]), 0.1)
    assert float(loss) == pytest.approx(expected, abs=1e-5)


def test_losses_are_means() -> None:
    zeros = torch.zeros(2)
    assert float(losses.value_loss(torch.tensor([0.0, 2.0]), zeros, zeros, 10.0)) == pytest.approx(2.0)
    assert float(losses.ground_truth_loss(torch.tensor([[1.0, 2.0]]), torch.tensor([[0.0, 4.0]]))) == pytest.approx(2.5)


def test_entropy_and_log_prob_by_hand() -> None:
    """Two branches: entropies are summed, log-probabilities are returned per branch."""
    logits = [torch.tensor([[0.5, 0.25, 0.25]]).log(), torch.tensor([[0.9, 0.1]]).log()]
    output = AgentOutput(logits, torch.zeros(1), None, None)
    one = -(0.5 * math.log(0.5) + 0.5 * math.log(0.25))
    two = -(0.9 * math.log(0.9) + 0.1 * math.log(0.1))
    assert float(output.entropy()) == pytest.approx(one + two, abs=1e-6)
    chosen = output.log_prob(torch.tensor([[2, 1]]))
    torch.testing.assert_close(chosen, torch.tensor([[math.log(0.25), math.log(0.1)]]))


def test_reconstruction_loss_is_binary_cross_entropy() -> None:
    """-[o log p + (1 - o) log(1 - p)] for each number of the frame; frame and logits have different axis orders."""
    frames = torch.randint(0, 256, (2, 84, 84, 3), dtype=torch.uint8)
    logits = torch.randn(2, 3, 84, 84, dtype=torch.float64)
    total = 0.0
    for n, x, y, c in torch.randint(0, 1 << 30, (500, 4)).tolist():
        n, x, y, c = n % 2, x % 84, y % 84, c % 3
        single, o = logits[n, c, x, y], float(frames[n, x, y, c]) / 255
        p = 1 / (1 + math.exp(-float(single)))
        expected = -(o * math.log(p) + (1 - o) * math.log(1 - p))
        patched = torch.zeros(1, 3, 84, 84, dtype=torch.float64)
        patched[0, c, x, y] = single
        # All other numbers have p = 1/2 and contribute log 2 each.
        others = torch.full((1, 84, 84, 3), 0, dtype=torch.uint8)
        others[0, x, y, c] = frames[n, x, y, c]
        loss = float(losses.reconstruction_loss(patched, others)) * 84 * 84 * 3 - (84 * 84 * 3 - 1) * math.log(2)
        assert loss == pytest.approx(expected, abs=1e-6)
        total += expected
    assert total > 100


def test_normalised_advantages_have_mean_0_and_deviation_1() -> None:
    advantages = losses.normalised(torch.tensor([1.0, 2.0, 3.0]))
    torch.testing.assert_close(advantages, torch.tensor([-1.0, 0.0, 1.0]))


def test_explained_variance_is_1_for_equal_values_and_nan_without_variance() -> None:
    returns = torch.tensor([0.0, 2.0, 4.0])
    assert losses.explained_variance(returns.clone(), returns) == 1.0
    assert losses.explained_variance(torch.zeros(3), returns) == 0.0
    assert losses.explained_variance(returns / 2, returns) == pytest.approx(0.75)
    assert math.isnan(losses.explained_variance(returns, torch.ones(3)))


def test_coefficients_decay_linearly_to_their_final_value() -> None:
    assert linear_decay(2.75e-4, 1e-5, 0, 10_000) == 2.75e-4
    assert linear_decay(2.75e-4, 1e-5, 5_000, 10_000) == pytest.approx((2.75e-4 + 1e-5) / 2)
    assert linear_decay(2.75e-4, 1e-5, 10_000, 10_000) == 1e-5
    assert linear_decay(2.75e-4, 1e-5, 99_999, 10_000) == 1e-5


def played(kind: str, **changes: object) -> tuple[Agent, Segment, object]:
    """A segment collected by the agent, with random rewards and ground truths."""
    steps, envs = 16, 4
    agent = make(kind, **changes)
    memory, observed, done = agent.initial_memory(envs), observations(steps, envs), ends(steps, envs)
    reset_mask, action, log_prob, value = play(agent, memory, observed, done)
    draws = torch.Generator().manual_seed(2)
    segment = Segment(
        observation={"features": observed},
        reset_mask=reset_mask,
        action=action,
        # Perturbed, as in a later epoch.
        log_prob=log_prob + 0.2 * torch.randn(log_prob.shape, generator=draws),
        value=value + 0.2 * torch.randn(value.shape, generator=draws),
        reward=torch.randn(steps, envs, generator=draws),
        done=done,
        ground_truth=torch.randn(steps, envs, 2, generator=draws) if agent.ground_truth else None,
        last_value=torch.randn(envs, generator=draws),
    )
    return agent, segment, memory.state


@pytest.mark.parametrize("normalisation", ["none", "minibatch"])
@pytest.mark.parametrize("kind", ["none", "gru", "trxl"])
def test_minibatch_loss_is_the_weighted_sum(kind: str, normalisation: str) -> None:
    """Computed in a loop over the steps from the outputs of the network."""
    ppo = replace(
        settings(kind).ppo, ground_truth_coefficient=0.3, advantage_normalisation=normalisation, clip_range=0.1
    )
    torch.manual_seed(3)
    agent = Agent(settings(kind, ppo=ppo), {"features": (6,)}, BRANCHES, ground_truth=2)
    steps, envs = 16, 4
    memory, observed, done = agent.initial_memory(envs), observations(steps, envs), ends(steps, envs)
    reset_mask, action, log_prob, value = play(agent, memory, observed, done)
    old_log_prob, old_value = log_prob + 0.2 * torch.randn_like(log_prob), value + 0.2 * torch.randn_like(value)
    truth = torch.randn(steps, envs, 2)
    none = torch.zeros(steps, envs)
    segment = Segment(
        {"features": observed}, reset_mask, action, old_log_prob, old_value, none, done, truth, torch.zeros(envs)
    ).flat()
    advantages, returns = torch.randn(steps * envs), torch.randn(steps * envs)
    minibatch = agent.memory.minibatches([memory.state], reset_mask, 3, torch.Generator().manual_seed(0))[1]
    loss, parts = minibatch_loss(agent, segment, minibatch, advantages, returns, ppo, 0.05)

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
    given = settings("none")
    given = replace(
        given, ppo=replace(given.ppo, reconstruction_coefficient=0.1), environment=Environment(observation="rgb")
    )
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

    advantages = losses.generalised_advantages(
        segment.reward, segment.value, segment.done, segment.last_value, ppo.gamma, ppo.gae_lambda
    )
    (minibatch,) = other.memory.minibatches([state], segment.reset_mask, 1, torch.Generator().manual_seed(0))
    returns = (advantages + segment.value).flatten()
    loss, _ = minibatch_loss(
        other, segment.flat(), minibatch, advantages.flatten(), returns, ppo, measures["entropy_coefficient"]
    )
    loss.backward()
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


def test_loss_does_not_depend_on_the_order_of_steps() -> None:
    """Without memory, the loss of a minibatch is invariant to a permutation of its steps."""
    agent, segment, _ = played("none")
    flat, numbers = segment.flat(), torch.arange(64)
    arguments = (torch.randn(64), torch.randn(64), PPO(), 0.01)
    one, _ = minibatch_loss(agent, flat, Minibatch(numbers, numbers), *arguments)
    two, _ = minibatch_loss(agent, flat, Minibatch(numbers.flip(0), numbers), *arguments)
    torch.testing.assert_close(one, two)
