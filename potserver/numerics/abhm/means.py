"""First stage of the ABHM learner: the means of hinges, gammas and weights."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from potserver.errors import SolverError
from potserver.numerics.abhm.problem import KernelPrior, Problem, Weights
from potserver.numerics.arrays import Float32, Float64

_COOLING = 0.4  # factor of the step size after an epoch without a gain
_COOLINGS = 2  # such epochs; one more ends the means


class AbhmEpoch(NamedTuple):
    """Where learning stands after the weights of an epoch were solved."""

    epoch: int  # from 0; the last one comes after the last gradient step
    n_epochs: int  # at most
    objective: float  # nats a point: minus the log posterior of the means, prior constants left out
    hinge: Float64  # (K, 3) m
    gamma: Float64  # (K,) 1/m^2
    weight: Float32  # (K,) log-odds


class Means(NamedTuple):
    """What the first stage found."""

    hinge: Float64  # (K, 3) m
    gamma: Float64  # (K,) 1/m^2
    weights: Weights
    objectives: list[float]  # nats a point, one an epoch
    converged: bool


class _Parameters(NamedTuple):
    """What gradient steps move, in place; of order one, but for the weights."""

    shift: Float32  # (K, 3) of hinges, in length scales
    log_ratio: Float32  # (K,) of gammas to their start
    weight: Float32  # (K,) log-odds


def learn_means(
    problem: Problem,
    prior: KernelPrior,
    rng: np.random.Generator,
    on_epoch: Callable[[AbhmEpoch], None] | None,
) -> Means:
    """The mode of the posterior of hinges, log gammas and weights.

    Args:
        problem: The labelled points.
        prior: Of hinges and gammas; its options say how to go.
        rng: Of the mini-batches.
        on_epoch: Called after each epoch.
    Raises:
        SolverError: the objective is no longer finite.
    """
    options, k, n = prior.options, len(prior.hinge), problem.n
    at = _Parameters(np.zeros((k, 3), np.float32), np.zeros(k, np.float32), np.zeros(k, np.float32))
    adam = _Adam(list(at))
    objectives: list[float] = []
    best, n_coolings = math.inf, 0
    for epoch in range(options.max_epochs + 1):
        hinge, gamma = prior.hinge_at(at.shift), prior.gamma_at(at.log_ratio)
        if not (np.isfinite(hinge).all() and np.isfinite(gamma).all() and (gamma > 0).all()):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        problem.gather(hinge, gamma)
        at.weight[:] = problem.improve(at.weight).weights
        penalty = prior.penalty(at.shift, at.log_ratio)
        objective = problem.objective(at.weight) + penalty
        n_coolings += epoch > 0 and best - objective < options.tolerance * best
        best = min(best, objective)
        last = epoch == options.max_epochs or n_coolings > _COOLINGS
        if last:
            weights = problem.solve(at.weight)
            objective = problem.objective(weights.mean) + penalty
        objectives.append(objective / n)
        if not np.isfinite(objective):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        if on_epoch:
            weight = weights.mean if last else at.weight
            on_epoch(AbhmEpoch(epoch, options.max_epochs, objectives[-1], hinge, gamma, weight.copy()))
        if last:
            break
        _descend(problem, prior, at, adam, rng, largest_rate=options.learning_rate * _COOLING**n_coolings)
    # what the last epoch changed, up or down
    change = abs(objectives[-2] - objectives[-1]) if len(objectives) > 1 else math.inf
    settled = change <= 10.0 * options.tolerance * objectives[-1]
    return Means(hinge, gamma, weights, objectives, settled and weights.converged)


def _descend(
    problem: Problem,
    prior: KernelPrior,
    at: _Parameters,
    adam: _Adam,
    rng: np.random.Generator,
    *,
    largest_rate: float,
) -> None:
    """The gradient steps of one epoch."""
    options = prior.options
    length, gamma_start = prior.length.astype(np.float32)[:, None], prior.gamma.astype(np.float32)
    hinge_start = (prior.hinge - problem.corner).astype(np.float32)
    total = options.max_epochs * options.steps
    for first in itertools.islice(problem.batches(rng), options.steps):
        ratio = np.exp(at.log_ratio)
        gamma = gamma_start * ratio
        hinge = hinge_start + length * prior.free_axes * at.shift
        _, d_hinge, d_gamma, d_weight = problem.log_likelihood(hinge, gamma, at.weight, first)
        adam.step(
            [
                prior.free_axes * (at.shift / options.hinge_reach**2 - length * d_hinge),
                options.gamma_shape * (ratio - 1.0) - gamma * d_gamma,
                at.weight / options.weight_var - d_weight,
            ],
            min(options.learning_rate * half_cosine(adam.taken / total), largest_rate),
        )


def half_cosine(done: float) -> float:
    """The share of the first step size when a share of the steps is done: from 1 down to a twentieth."""
    return 0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * done))


class _Adam:
    """Adam (Kingma, Ba, ICLR 2015) on arrays, in place. On arrays this small torch's own takes longer than the gradient."""

    def __init__(self, parameters: list[Float32]) -> None:
        self._parameters = parameters
        self._mean = [np.zeros_like(p) for p in parameters]
        self._square = [np.zeros_like(p) for p in parameters]
        self.taken = 0

    def step(self, gradients: list[Float32], rate: float) -> None:
        """One step down."""
        self.taken += 1
        size = np.float32(rate / (1.0 - 0.9**self.taken))
        root = np.float32(1.0 / math.sqrt(1.0 - 0.999**self.taken))
        for p, g, mean, square in zip(self._parameters, gradients, self._mean, self._square, strict=True):
            mean += np.float32(0.1) * (g - mean)
            square += np.float32(0.001) * (g * g - square)
            p -= size * mean / (root * np.sqrt(square) + np.float32(1e-8))
