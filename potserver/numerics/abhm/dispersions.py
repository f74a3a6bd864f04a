"""Second stage of the ABHM learner: the variances of hinges and the shapes of gammas, with the means held."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch

from potserver.errors import SolverError
from potserver.numerics.abhm.means import Means, half_cosine
from potserver.numerics.abhm.problem import KernelPrior, Problem, Weights
from potserver.numerics.arrays import Float64, Int64

_RATE = 0.1  # of Adam, in log standard deviations and log shapes
_LEAST_GAMMA = 1e-20  # a sample of a wide Gamma may underflow


class Dispersions(NamedTuple):
    """What the second stage found."""

    hinge_sd: Float64  # (K, 3) m
    gamma_shape: Float64  # (K,)
    elbos: list[float]  # evidence lower bound, nats a point, one an epoch


def learn_dispersions(
    problem: Problem, prior: KernelPrior, means: Means, rng: np.random.Generator
) -> Dispersions:
    """Standard deviations of hinges and shapes of gammas that maximise the evidence lower bound.

    Args:
        problem: The labelled points, gathered at the means.
        prior: Of hinges and gammas; its options say how to go.
        means: Of the first stage.
        rng: Of mini-batches and samples.
    Raises:
        SolverError: the dispersions are no longer finite.
    """
    options, n, k = prior.options, problem.n, len(means.gamma)
    free_axes, length = torch.from_numpy(prior.free_axes), _tensor(prior.length)
    hinge, gamma = _tensor(means.hinge - problem.corner), _tensor(means.gamma)
    weight = torch.from_numpy(means.weights.mean)
    curvature_h, curvature_g = problem.curvatures(hinge.numpy(), gamma.numpy(), means.weights.mean)
    # in length scales and as log shapes: both of order one
    precision = torch.from_numpy(curvature_h) * length[:, None].square() + 1.0 / options.hinge_reach**2
    log_sd = (-0.5 * precision.log()).requires_grad_()
    log_shape = (torch.from_numpy(curvature_g) + options.gamma_shape).log().requires_grad_()
    prior_h = torch.distributions.Normal(0.0, options.hinge_reach)
    prior_g = torch.distributions.Gamma(
        torch.full((k,), options.gamma_shape), options.gamma_shape / _tensor(prior.gamma)
    )
    shift = (_tensor(means.hinge - prior.hinge) / length[:, None]) * free_axes
    optimiser = torch.optim.Adam([log_sd, log_shape])
    # of this fit's own: others in this process draw from torch's global one
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    elbos: list[float] = []
    weight_cost = weight_divergence(means.weights, options.weight_var) + _weight_noise(
        means.weights, options.weight_var
    )
    total = options.dispersion_epochs * options.steps
    for epoch in range(options.dispersion_epochs):
        elbo = 0.0
        for step, first in enumerate(itertools.islice(problem.batches(rng), options.steps)):
            done = (epoch * options.steps + step) / total
            optimiser.param_groups[0]["lr"] = _RATE * half_cosine(done)
            optimiser.zero_grad()
            q_h = torch.distributions.Normal(shift, log_sd.exp())
            q_g = torch.distributions.Gamma(log_shape.exp(), log_shape.exp() / gamma)
            moved = q_h.scale * torch.randn((k, 3), generator=generator) * length[:, None] * free_axes
            # what q_g.rsample() does, with a generator of our own; its gradient in the shape is implicit (Figurnov et al. 2018)
            drawn = torch._standard_gamma(q_g.concentration, generator=generator) / q_g.rate
            fit = log_likelihood(problem, hinge + moved, drawn.clamp_min(_LEAST_GAMMA), weight, first)
            divergence = (torch.distributions.kl_divergence(q_h, prior_h) * free_axes).sum()
            divergence = divergence + torch.distributions.kl_divergence(q_g, prior_g).sum()
            bound = (fit - divergence) / n
            (-bound).backward()
            optimiser.step()
            elbo += float(bound.detach())
        elbos.append(elbo / options.steps - weight_cost / n)
    with torch.no_grad():
        sd = (log_sd.exp() * length[:, None] * free_axes).double().numpy()
        shape = log_shape.double().exp().numpy()
    if not (np.isfinite(sd).all() and np.isfinite(shape).all()):
        raise SolverError(f"the dispersions of {k} kernels on {n} points diverged")
    return Dispersions(sd, shape, elbos)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Torch on one thread: on arrays of K numbers its threads wait for each other longer than the work takes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def weight_divergence(weights: Weights, prior_var: float) -> float:
    """KL of the weights' posterior from their prior, nats."""
    ratio = weights.var.astype(np.float64) / prior_var
    return float(
        0.5 * (ratio + np.square(weights.mean, dtype=np.float64) / prior_var - 1.0 - np.log(ratio)).sum()
    )


def _weight_noise(weights: Weights, prior_var: float) -> float:
    """By how much the weights' variance lowers the expected log-likelihood, to second order, nats.

    1 / var is the curvature of likelihood and prior together, so the likelihood's share of it is 1 - var / prior_var.
    """
    return float(0.5 * (1.0 - weights.var.astype(np.float64) / prior_var).sum())


class _LogLikelihood(torch.autograd.Function):
    """Sum of log-likelihoods over some rows; differentiable in hinges, gammas and weights."""

    @staticmethod
    def forward(ctx: Any, problem: Any, hinge: Any, gamma: Any, weight: Any, first: Any) -> Any:
        total, *gradients = problem.log_likelihood(
            hinge.detach().numpy(), gamma.detach().numpy(), weight.detach().numpy(), first
        )
        ctx.save_for_backward(*map(torch.from_numpy, gradients))
        return hinge.new_tensor(total)

    @staticmethod
    def backward(ctx: Any, *upstream: Any) -> Any:
        d_hinge, d_gamma, d_weight = ctx.saved_tensors
        return None, d_hinge * upstream[0], d_gamma * upstream[0], d_weight * upstream[0], None


def log_likelihood(
    problem: Problem,
    hinge: torch.Tensor,
    gamma: torch.Tensor,
    weight: torch.Tensor,
    first: Int64,
) -> torch.Tensor:
    """Log-likelihood of a batch times the number of batches, nats; see `Problem.log_likelihood`. Torch can differentiate it."""
    return _LogLikelihood.apply(problem, hinge, gamma, weight, first)


def _tensor(array: Float64) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))
