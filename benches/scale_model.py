"""A model of data-parallel training by `torchrun`: what an update of N ranks costs, from the costs of one rank. See `scale.py`.

An update is a rollout, which all ranks begin and end together, and `epochs * minibatches` minibatches, each with an all-reduce of
the gradients. Every rank has the same number of environments, so that N ranks collect N times the steps of one. Times are in
seconds, sizes in bytes.

What the model leaves out: memory bandwidth that ranks of one machine share, congestion of the network, and the writing of logs
and checkpoints. Computation and communication do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Exchanges of small data in an update, beside the gradients: reset mask, values, advantages, metrics, episodes, the end.
EXCHANGES = 6
#: What the ranks send each other of each environment step: a flag, a value and an advantage.
BYTES_PER_STEP = 9


@dataclass(frozen=True)
class RankCosts:
    """Costs of one rank on cores of its own."""

    #: Environment steps of this rank in an update.
    steps: int
    #: Waiting for the environments, in an update.
    environment: float
    #: Computing actions, in an update.
    inference: float
    #: Forward and backward pass of all steps of an update once, without what each minibatch costs.
    epoch: float
    #: What a minibatch costs whatever its size, the optimizer's step among it.
    minibatch: float
    #: Per update, for each further rank: every rank draws the noise of all and divides the steps of all into minibatches.
    other_rank: float
    epochs: int
    minibatches: int
    #: What is divided among the minibatches: the sequences of this rank in an update; steps for an agent without memory.
    sequences: int
    gradient_bytes: int
    cores: int = 1
    #: Standard deviation of the time of an update, as a share of its mean.
    spread: float = 0.0

    @property
    def learning(self) -> float:
        """Forward and backward passes of an update."""
        return self.epochs * (self.epoch + self.minibatches * self.minibatch)

    @property
    def seconds(self) -> float:
        """An update of one rank alone."""
        return self.environment + self.inference + self.learning


@dataclass(frozen=True)
class Link:
    """What connects neighbours of the ring. The zero values are those of a perfect one."""

    #: Seconds of a message without content.
    latency: float = 0.0
    #: Bytes per second.
    bandwidth: float = float("inf")

    def all_reduce(self, ranks: int, size: int) -> float:
        """Seconds of a ring all-reduce: 2 (N - 1) messages, each of an N-th of the data."""
        return 2 * (ranks - 1) * (self.latency + size / ranks / self.bandwidth)

    def all_gather(self, ranks: int, size: int) -> float:
        """Seconds of a ring all-gather of `size` bytes of each rank: N - 1 messages."""
        return (ranks - 1) * (self.latency + size / self.bandwidth)


@dataclass(frozen=True)
class Cluster:
    """Machines of one kind."""

    #: Between ranks of one machine.
    within: Link = Link()
    #: Between machines.
    between: Link = Link()
    ranks_per_machine: int = 1
    #: Cores of a machine; ranks that need more share them. 0 for enough.
    cores: int = 0

    def link(self, ranks: int) -> Link:
        """What limits the ring: the slowest of its links."""
        if ranks <= self.ranks_per_machine:
            return self.within
        if self.ranks_per_machine == 1:
            return self.between
        links = (self.within, self.between)
        return Link(max(link.latency for link in links), min(link.bandwidth for link in links))

    def stretch(self, rank: RankCosts, ranks: int) -> float:
        """How much longer a rank computes because others share its cores."""
        wanted = min(ranks, self.ranks_per_machine) * rank.cores
        return max(1.0, wanted / self.cores) if self.cores else 1.0


@dataclass(frozen=True)
class Prediction:
    """An update of N ranks."""

    ranks: int
    #: Environment steps of all ranks.
    steps: int
    #: Seconds by what they are spent on; they add up to those of the update.
    seconds: dict[str, float]
    #: Steps per second, as a share of N times those of one rank alone.
    efficiency: float

    @property
    def total(self) -> float:
        return sum(self.seconds.values())

    @property
    def steps_per_second(self) -> float:
        return self.steps / self.total

    @property
    def limit(self) -> str:
        """What takes the largest part of the update."""
        return max(self.seconds, key=self.seconds.__getitem__)


def predict(rank: RankCosts, cluster: Cluster, ranks: int, seed: int = 0, updates: int = 32) -> Prediction:
    """What an update costs on average.

    Two kinds of waiting are simulated. The sequences of all ranks are shuffled into minibatches, so that a rank has more of one
    than of another, and all wait for the one that has most. And a rank is slower in one update than in another, by `rank.spread`.

    Args:
        rank: Costs of each rank.
        cluster: Where the ranks run.
        ranks: Number of ranks.
        seed: Seed of the random numbers. The first N of more ranks have the same spread.
        updates: Number of simulated updates.
    """
    stretch, link = cluster.stretch(rank, ranks), cluster.link(ranks)
    slowness = _slowness(rank.spread, ranks, updates, seed)
    slowest = float(slowness.max(axis=1).mean())
    shares = _shares(rank, ranks, updates * rank.minibatches, seed)
    # The ranks that are slow in an update are so in all its minibatches.
    costs = rank.minibatch + shares * rank.epoch
    even = rank.epochs * rank.minibatches * float(costs.mean())
    uneven = rank.epochs * rank.minibatches * float(costs.max(axis=1).mean())
    both = (
        rank.epochs * rank.minibatches * float((costs * slowness.repeat(rank.minibatches, axis=0)).max(axis=1).mean())
    )
    rollout = rank.environment + rank.inference
    reductions = rank.epochs * rank.minibatches * link.all_reduce(ranks, rank.gradient_bytes)
    exchanges = EXCHANGES * link.all_gather(ranks, 0) + link.all_gather(ranks, BYTES_PER_STEP * rank.steps)
    seconds = {
        "environment": rank.environment,
        "inference": rank.inference,
        "learning": rank.learning,
        "other ranks' steps": (ranks - 1) * rank.other_rank,
        "uneven minibatches": uneven - even,
        "slowest rank": rollout * (slowest - 1.0) + max(0.0, both - uneven),
    }
    seconds["shared cores"] = (stretch - 1.0) * sum(seconds.values())
    seconds["all-reduce"] = reductions + exchanges
    steps = ranks * rank.steps
    alone = rank.steps / rank.seconds
    return Prediction(ranks, steps, seconds, steps / sum(seconds.values()) / (ranks * alone))


def scaling(rank: RankCosts, cluster: Cluster, numbers: Sequence[int], seed: int = 0) -> list[Prediction]:
    """The predictions for several numbers of ranks."""
    return [predict(rank, cluster, number, seed) for number in numbers]


def fitted_link(ranks: int, small: float, large: float, size: int) -> Link:
    """The link that a measured all-reduce implies.

    Args:
        ranks: Number of ranks, 2 or more.
        small: Seconds for a few bytes.
        large: Seconds for `size` bytes.
        size: Bytes of the large one.
    """
    moved = 2 * (ranks - 1) * size / ranks
    return Link(small / (2 * (ranks - 1)), moved / (large - small) if large > small else float("inf"))


def fitted_learning(few: float, many: float, minibatches: int, factor: int) -> tuple[float, float]:
    """Seconds of an epoch's steps, and of each minibatch, from two measured epochs.

    Args:
        few: Seconds of an epoch of `minibatches` minibatches.
        many: Seconds of an epoch of `factor` times as many.
        minibatches: Number of minibatches.
        factor: At least 2.
    """
    each = min(max(0.0, (many - few) / (minibatches * (factor - 1))), few / minibatches)
    return few - minibatches * each, each


def _slowness(spread: float, ranks: int, updates: int, seed: int) -> np.ndarray:
    """Factors of the times of each rank in each update, (updates, ranks); those of a rank have the mean 1."""
    # A log-normal distribution with the mean 1; a generator for each rank, so that more ranks do not change the first ones.
    sigma = float(np.sqrt(np.log1p(spread * spread)))
    drawn = np.stack([np.random.default_rng((seed, rank)).standard_normal(updates) for rank in range(ranks)], axis=1)
    factors = np.exp(sigma * drawn)
    return factors / factors.mean(axis=0)


def _shares(rank: RankCosts, ranks: int, draws: int, seed: int) -> np.ndarray:
    """Shares of a rank's sequences in drawn minibatches, (draws, ranks)."""
    if ranks == 1:
        return np.full((draws, 1), 1.0 / rank.minibatches)
    everywhere = ranks * rank.sequences
    # In an epoch the sizes of the minibatches differ by one sequence at most.
    sizes = np.diff(np.arange(rank.minibatches + 1) * everywhere // rank.minibatches)
    generator = np.random.default_rng((seed, ranks))
    counts = [
        generator.multivariate_hypergeometric(
            [rank.sequences] * ranks, int(sizes[draw % len(sizes)]), method="marginals"
        )
        for draw in range(draws)
    ]
    return np.stack(counts) / rank.sequences
