"""The agent's dense layers for acting, with weights laid out to need the fewest operations.

While acting, batches are small, so the number of operations determines the cost of a step. Each layer here is a single `addmm`
call on a transposed copy of the agent's parameters, and the policy and value heads are computed together. `Agent.refresh`
documents when `ActingWeights` are rebuilt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import torch
from torch import Tensor, nn

from endless_gym_agents.agent.heads import PolicyHead, ValueHead
from endless_gym_agents.memories.layers import Affine, linear_relu, transposed

#: Logit that pads branches with fewer choices than the largest. Finite, since infinity gives NaN.
NO_CHOICE = -1e9

_version = attrgetter("_version")


def weights_version(parameters: Sequence[Tensor]) -> int:
    """A number that rises with each in-place change of the parameters, except those by fused optimizer kernels."""
    return sum(map(_version, parameters))


@dataclass
class ActingWeights:
    """The layers after the memory, and the layer for vector observations.

    Attributes:
        version: `weights_version` of the parameters at the time of the copy.
        vector: Layer for vector observations; None if there are none.
        embedding: Layer before the memory; None if there is none.
        body: Layer after the memory.
        hidden: Hidden layers of the policy and value heads, concatenated.
        output: Output layers of both heads: the logits of all branches, each padded to the largest one, and the value.
        branches: Number of branches.
        choices: Choices of the largest branch.
    """

    version: int
    vector: Affine | None
    embedding: Affine | None
    body: Affine
    hidden: Affine
    output: Affine
    branches: int
    choices: int

    def heads(self, x: Tensor) -> Tensor:
        """Logits and value, float32 (n, branches * choices + 1), for outputs of the memory float (n, width)."""
        x = linear_relu(linear_relu(x, self.body), self.hidden)
        return torch.addmm(self.output[0], x, self.output[1]).float()

    def logits(self, outputs: Tensor) -> Tensor:
        """The logits, float32 (..., branches, choices), a view of what `heads` returned, float32 (..., outputs)."""
        logits = outputs.narrow(-1, 0, self.branches * self.choices)
        return logits.view(*outputs.shape[:-1], self.branches, self.choices)

    def log_prob(self, outputs: Tensor, actions: Tensor) -> Tensor:
        """Log-probabilities of actions int64 (..., branches), float32 (..., branches)."""
        log_probs: Tensor = self.logits(outputs).log_softmax(-1)
        return log_probs.gather(-1, actions.unsqueeze(-1)).squeeze(-1)


def acting_weights(
    version: int,
    dtype: torch.dtype,
    after: torch.dtype,
    vector: nn.Sequential | None,
    embedding: nn.Sequential | None,
    body: nn.Sequential,
    policy: PolicyHead,
    value: ValueHead,
) -> ActingWeights:
    """Make `ActingWeights` from the agent's layers, which compute in `dtype` up to the embedding, and in `after` beyond."""
    (policy_bias, policy_weight), (value_bias, value_weight) = (
        transposed(layer, after) for layer in (policy.hidden[0], value.layers[0])
    )
    branches = [transposed(layer, after) for layer in policy.branches]
    choices, width = max(len(bias) for bias, _ in branches), policy_weight.shape[1]
    outputs = len(branches) * choices + 1
    bias = policy_bias.new_full((outputs,), NO_CHOICE)
    weight = policy_weight.new_zeros(width + value_weight.shape[1], outputs)
    for number, (branch_bias, branch_weight) in enumerate(branches):
        columns = slice(number * choices, number * choices + len(branch_bias))
        bias[columns] = branch_bias
        weight[:width, columns] = branch_weight
    last_bias, last_weight = transposed(value.layers[2], after)
    bias[-1:] = last_bias
    weight[width:, -1:] = last_weight
    return ActingWeights(
        version=version,
        vector=None if vector is None else transposed(vector[0], dtype),
        embedding=None if embedding is None else transposed(embedding[0], dtype),
        body=transposed(body[0], after),
        hidden=(torch.cat([policy_bias, value_bias]), torch.cat([policy_weight, value_weight], dim=1)),
        output=(bias, weight),
        branches=len(branches),
        choices=choices,
    )
