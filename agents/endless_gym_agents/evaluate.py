"""Evaluation in a program: `evaluate` and `mean`."""

from endless_gym_agents.evaluation.evaluate import evaluate, mean

__all__ = ["evaluate", "mean"]
