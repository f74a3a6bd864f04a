"""Automorphing Bayesian Hilbert maps (ABHM): weights, hinges and widths of K kernels learned from labelled points.

    y_n ~ Bernoulli(sigmoid(f(x_n))),   f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2)
    w_m ~ Normal(0, weight_var),   h_m ~ Normal(start, (hinge_reach ell)^2),   gamma_m ~ Gamma(gamma_shape, mean = start)

with ell = 1 / sqrt(2 gamma), the length scale a kernel starts with. Source: Senanayake, Tompkins, Ramos, CoRL 2018, and section
II-A of the RSS 2020 paper. Black-box variational inference over all ten numbers of a kernel at once is slow and ends worse than
fixed kernels with jointly solved weights, so the posterior q(w) q(h) q(gamma) is found in two stages:

1. *Means.* Given hinges and widths the weights are a convex problem that `warm_fit` solves jointly, so they are collapsed:
   each epoch improves them, then takes stochastic gradient steps (Adam, mini-batches) on h, log gamma and w together; the last
   one solves them to the end. Steps grow smaller along a half cosine, and at once after an epoch that gained nothing: noise of
   mini-batches can make steps small, and only what stays without a gain at small steps ends the means early.
2. *Dispersions.* With the means held, the variances of h and the shapes of gamma maximise the evidence lower bound by
   stochastic variational inference in torch: reparameterised samples of h and gamma, the exact KL divergence of each. They
   start at the Gauss-Newton curvature, and few epochs suffice.

Points lie in cubes that share a list of kernels (`feature_blocks`), and a mini-batch takes some points of every cube: less
noise than points drawn at random, and inner loops over dense memory.

Sampling in the first stage too was measured: the means then end near their start, and held-out NLL is half as large again.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray

from potschemas.answers import sigmoid
from potserver.errors import EmptyError, ShapeError, SolverError
from potserver.numerics.fastexp import FAST, exp32
from potserver.numerics.feature_blocks import feature_blocks, gradient_and_diagonal, product
from potserver.numerics.threads import parallel_map
from potserver.numerics.warm_fit import WarmFit, warm_fit

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_FEATURE_CUT = 3e-3  # activations below this are left out of an epoch
_EDGE_IN_LENGTHS = 1.0  # of the cubes that share a list of kernels
_NEGLIGIBLE = 1e-4  # points explained to this residual have no say in a gradient; for the smaller of 1 and the mean count
_NEWTON_STEPS, _GRADIENT_STEPS = (
    2,
    12,
)  # of the weights between epochs: Newton's, and conjugate gradients in each
_LEAST_CURVATURE = 1e-5  # of a point, for those steps
_COOLING, _COOLINGS = 0.4, 2  # an epoch without a gain makes steps smaller; so many times, then it is the end
_DISPERSION_RATE = 0.1  # of Adam, in log standard deviations and log shapes
_LEAST_GAMMA = 1e-20  # a sample of a wide Gamma may underflow


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class AbhmSettings:
    """How kernels are learned."""

    weight_var: float = 200.0  # log-odds^2, prior of the weights
    hinge_reach: float = 1.0  # prior standard deviation of a hinge about its start, in length scales
    gamma_shape: float = 2.0  # of gamma's prior, whose mean is the start
    max_epochs: int = 10  # of the means
    dispersion_epochs: int = 4
    steps: int = 60  # gradient steps an epoch
    batch: int = 2_000  # points a step
    learning_rate: float = 0.1  # of hinges (in length scales) and of log gamma; falls along a half cosine
    # an epoch that gains less than this share of the objective makes the steps smaller, the third one ends the means;
    # negative = never
    tolerance: float = 2e-3

    def __post_init__(self) -> None:
        for name in ("weight_var", "hinge_reach", "gamma_shape", "learning_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ShapeError(f"{name} must be > 0 and finite, got {getattr(self, name)}")
        for name in ("max_epochs", "dispersion_epochs"):
            if getattr(self, name) < 0:
                raise ShapeError(f"{name} must be >= 0, got {getattr(self, name)}")
        for name in ("steps", "batch"):
            if getattr(self, name) < 1:
                raise ShapeError(f"{name} must be at least 1, got {getattr(self, name)}")


class AbhmEpoch(NamedTuple):
    """Where learning stands after the weights of an epoch were solved."""

    epoch: int  # from 0; the last one comes after the last gradient step
    n_epochs: int  # at most
    objective: float  # nats a point: minus the log posterior of the means, prior constants left out
    hinge: Float64  # (K, 3) m
    gamma: Float64  # (K,) 1/m^2
    weight: Float32  # (K,) log-odds


class AbhmPosterior(NamedTuple):
    """Normal over weights and hinges, Gamma over widths; how learning ended."""

    weight_mean: Float32  # (K,) log-odds
    weight_var: Float32  # (K,) log-odds^2: given the other weights, at the mean hinges and widths
    hinge_mean: Float64  # (K, 3) m
    hinge_var: Float32  # (K, 3) m^2; 0 along an axis in which all points agree
    gamma_shape: Float32  # (K,)
    gamma_rate: Float32  # (K,) m^2; gamma's mean is shape / rate, 1/m^2
    objectives: list[float]  # of the means, one an epoch: nats a point
    elbos: list[
        float
    ]  # one an epoch of the dispersions: evidence lower bound, to second order in the weights; nats a point
    converged: (
        bool  # the means gained little in their last epochs, and their weights were solved to tolerance
    )


def fit_abhm(
    points: Float64,
    occupied: Bool,
    hinge: Float64,
    gamma: NDArray[np.floating],
    settings: AbhmSettings,
    *,
    sample_weight: Float32 | None = None,
    seed: int = 0,
    threads: int = 1,
    on_epoch: Callable[[AbhmEpoch], None] | None = None,
) -> AbhmPosterior:
    """Learn K kernels from N labelled points.

    Args:
        points: (N, 3) m. An axis in which all points agree (a planar scan's z) is left out of the hinges' freedom.
        occupied: (N,) labels.
        hinge: (K, 3) m, where kernels start, same frame.
        gamma: (K,) 1/m^2, > 0, what their widths start from.
        settings: How.
        sample_weight: (N,) how much each point counts; 1 by default.
        seed: Of mini-batches and samples; the same seed gives the same bits on the same machine and versions.
        threads: For the products with the features; the result does not depend on it.
        on_epoch: Called after each epoch of the means, e.g. to score held-out points and move a progress bar.
    Raises:
        EmptyError: no points or no kernels. ShapeError: arrays disagree, gamma is not positive, or the seed is negative.
        SolverError: the objective is no longer finite.
    """
    n = len(points)
    _check(points, occupied, hinge, gamma, sample_weight)
    if seed < 0:
        raise ShapeError(f"seed must be >= 0, got {seed}")
    count = np.ones(n, np.float32) if sample_weight is None else sample_weight.astype(np.float32)
    free_axes = (np.ptp(points, axis=0) > 0.0).astype(np.float32)
    problem = _Problem(points, occupied, count, settings, threads)
    start = _Start(hinge, np.asarray(gamma, np.float64), free_axes, settings)
    rng = np.random.default_rng(seed)

    means = _learn_means(problem, start, rng, on_epoch)
    with _one_torch_thread():
        hinge_sd, shape, elbos = _learn_dispersions(problem, start, means, rng)
    return AbhmPosterior(
        weight_mean=means.weights.mean,
        weight_var=means.weights.var,
        hinge_mean=means.hinge,
        hinge_var=np.square(hinge_sd).astype(np.float32),
        gamma_shape=shape.astype(np.float32),
        gamma_rate=(shape / means.gamma).astype(np.float32),
        objectives=means.objectives,
        elbos=elbos,
        converged=means.converged,
    )


def _check(points, occupied, hinge, gamma, sample_weight) -> None:
    n, k = len(points), len(hinge)
    if n == 0 or k == 0:
        raise EmptyError(f"nothing to learn: {n} points, {k} kernels")
    wanted = {"points": (n, 3), "occupied": (n,), "hinge": (k, 3), "gamma": (k,), "sample_weight": (n,)}
    given = {"points": points, "occupied": occupied, "hinge": hinge, "gamma": np.asarray(gamma)}
    if sample_weight is not None:
        given["sample_weight"] = sample_weight
    for name, array in given.items():
        if array.shape != wanted[name]:
            raise ShapeError(f"{name}: {array.shape}, need {wanted[name]}")
        if not np.isfinite(array).all():
            raise ShapeError(f"{name}: NaN or infinite values")
    if not (given["gamma"] > 0).all():
        raise ShapeError("gamma must be > 0")
    if sample_weight is not None and (sample_weight < 0).any():
        raise ShapeError("sample_weight must be >= 0")


class _Start:
    """The prior's centres, as float32 relative to which everything is learned."""

    def __init__(self, hinge: Float64, gamma: Float64, free_axes: Float32, settings: AbhmSettings) -> None:
        self.hinge, self.gamma, self.settings = hinge, gamma, settings
        self.length = 1.0 / np.sqrt(2.0 * gamma)
        self.free_axes = free_axes

    def hinge_at(self, shift: Float32) -> Float64:
        """Hinges for shifts given in length scales."""
        return self.hinge + self.length[:, None] * self.free_axes * shift

    def gamma_at(self, log_ratio: Float32) -> Float64:
        return self.gamma * np.exp(log_ratio.astype(np.float64))

    def penalty(self, shift: Float32, log_ratio: Float32) -> float:
        """Minus the log prior of hinges and gammas, constants left out, nats."""
        reach, shape = self.settings.hinge_reach, self.settings.gamma_shape
        moved = np.square(shift.astype(np.float64) * self.free_axes).sum() / (2.0 * reach**2)
        ratio = log_ratio.astype(np.float64)
        # the density of log gamma, so that the start is also the mode
        return float(moved + shape * (np.exp(ratio) - ratio - 1.0).sum())


class _Weights(NamedTuple):
    mean: Float32  # (K,) log-odds
    var: Float32  # (K,) log-odds^2
    converged: bool


class _Means(NamedTuple):
    hinge: Float64
    gamma: Float64
    weights: _Weights
    objectives: list[float]
    converged: bool


class _Problem:
    """The labelled points in cubes, each with the kernels that reach it; cut anew in every epoch."""

    def __init__(
        self, points: Float64, occupied: Bool, count: Float32, settings: AbhmSettings, threads: int
    ) -> None:
        self.points, self.occupied, self.count = points, occupied, count
        self.settings, self.threads = settings, threads
        self.n = len(points)
        self.n_batches = max(1, round(self.n / settings.batch))
        self.corner = points.min(axis=0)  # relative to it float32 has the digits that matter
        self.negligible = np.float32(_NEGLIGIBLE * min(1.0, float(count.mean(dtype=np.float64))))

    def gather(self, hinge: Float64, gamma: Float64) -> None:
        """Find which kernels reach which cubes."""
        edge_m = _EDGE_IN_LENGTHS * float(np.median(1.0 / np.sqrt(2.0 * gamma)))
        relative = self.points - self.corner
        self.blocks = feature_blocks(
            relative, hinge - self.corner, gamma, edge_m=edge_m, cut=_FEATURE_CUT, threads=self.threads
        )
        order = self.blocks.order
        self.x = np.ascontiguousarray(relative[order].T, np.float32)
        self.sorted_occupied, self.sorted_count = self.occupied[order], self.count[order]

    def improve(self, weight: Float32, *, n_newton: int, n_conjugate_gradient: int) -> WarmFit:
        """Better weights given the features, from where they are."""
        return warm_fit(
            self.blocks, self.occupied, self.count, np.zeros_like(weight),
            np.full(len(weight), self.settings.weight_var, np.float32), weight, n_newton=n_newton,
            n_conjugate_gradient=n_conjugate_gradient, least_curvature=_LEAST_CURVATURE, threads=self.threads,
        )  # fmt: skip

    def solve(self, weight: Float32) -> _Weights:
        """The best weights given the features, and their variances."""
        solved = self.improve(weight, n_newton=50, n_conjugate_gradient=200)
        p = sigmoid(product(self.blocks, solved.weights, threads=self.threads))
        _, diagonal = gradient_and_diagonal(
            self.blocks, np.zeros_like(p), self.sorted_count * p * (1.0 - p), threads=self.threads
        )
        var = 1.0 / (diagonal + np.float32(1.0 / self.settings.weight_var))
        return _Weights(solved.weights, var, solved.converged and solved.n_newton < 50)

    def batches(self, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
        """Endless passes over the points: of each cube a step sees every `n_batches`-th one, in turn."""
        n_cubes = sum(len(part.cuts) - 1 for part in self.blocks.parts)
        while True:
            first = rng.integers(self.n_batches, size=n_cubes)
            for turn in range(self.n_batches):
                yield (first + turn) % self.n_batches

    def log_likelihood(
        self, hinge: Float32, gamma: Float32, weight: Float32, first: NDArray[np.int64]
    ) -> tuple[float, Float32, Float32, Float32]:
        """Sum over the points of a batch times the number of batches, and its gradients; hinges relative to the corner."""
        kernels = np.concatenate([hinge.T, gamma[None], weight[None]])
        starts = np.cumsum([0, *(len(part.cuts) - 1 for part in self.blocks.parts)])
        parts = parallel_map(
            lambda i: _gradient(
                self.x, self.sorted_occupied, self.sorted_count, self.blocks.parts[i].cuts,
                self.blocks.parts[i].kernels, self.blocks.parts[i].numbers, kernels,
                first[starts[i] : starts[i + 1]], self.n_batches, self.negligible,
            ),
            range(len(self.blocks.parts)), self.threads,
        )  # fmt: skip
        total = sum(part[0] for part in parts) * self.n_batches
        gradient = np.sum([part[1] for part in parts], axis=0, dtype=np.float32) * np.float32(self.n_batches)
        return total, np.ascontiguousarray(gradient[:3].T), gradient[3], gradient[4]

    def curvatures(self, hinge: Float32, gamma: Float32, weight: Float32) -> tuple[Float32, Float32]:
        """Gauss-Newton curvature of the log-likelihood in hinges (K, 3), 1/m^2, and in log gammas (K,)."""
        columns = np.concatenate([hinge.T, gamma[None], weight[None]])
        total = np.zeros((4, len(gamma)), np.float32)
        for part in self.blocks.parts:
            total += _curvatures(self.x, self.sorted_count, part.cuts, part.kernels, part.numbers, columns)
        return np.ascontiguousarray(total[:3].T), total[3]

    def objective(self, weight: Float32) -> float:
        """Minus the log posterior of the weights, constants left out, nats."""
        f = product(self.blocks, weight, threads=self.threads)
        loss = np.logaddexp(0.0, f, dtype=np.float64) - self.sorted_occupied * f
        prior = np.square(weight, dtype=np.float64).sum() / (2.0 * self.settings.weight_var)
        return float((self.sorted_count * loss).sum() + prior)


def _learn_means(
    problem: _Problem,
    start: _Start,
    rng: np.random.Generator,
    on_epoch: Callable[[AbhmEpoch], None] | None,
) -> _Means:
    settings, k, n = start.settings, len(start.hinge), problem.n
    shift = np.zeros((k, 3), np.float32)  # of hinges, in length scales
    log_ratio = np.zeros(k, np.float32)  # of gammas to their start
    weight = np.zeros(k, np.float32)
    optimiser = _Adam([shift, log_ratio, weight])
    length, gamma_start = start.length.astype(np.float32)[:, None], start.gamma.astype(np.float32)
    total = settings.max_epochs * settings.steps
    objectives: list[float] = []
    best, n_coolings, taken = math.inf, 0, 0
    for epoch in range(settings.max_epochs + 1):
        hinge, gamma = start.hinge_at(shift), start.gamma_at(log_ratio)
        if not (np.isfinite(hinge).all() and np.isfinite(gamma).all() and (gamma > 0).all()):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        problem.gather(hinge, gamma)
        weight[:] = problem.improve(
            weight, n_newton=_NEWTON_STEPS, n_conjugate_gradient=_GRADIENT_STEPS
        ).weights
        objective = problem.objective(weight) + start.penalty(shift, log_ratio)
        n_coolings += epoch > 0 and best - objective < settings.tolerance * best
        best = min(best, objective)
        last = epoch == settings.max_epochs or n_coolings > _COOLINGS
        if last:
            weights = problem.solve(weight)
            objective = problem.objective(weights.mean) + start.penalty(shift, log_ratio)
            weight = weights.mean
        objectives.append(objective / n)
        if not np.isfinite(objective):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        if on_epoch:
            on_epoch(AbhmEpoch(epoch, settings.max_epochs, objectives[-1], hinge, gamma, weight.copy()))
        if last:
            break
        hinge_start = (start.hinge - problem.corner).astype(np.float32)
        for first in itertools.islice(problem.batches(rng), settings.steps):
            ratio = np.exp(log_ratio)
            gamma_now = gamma_start * ratio
            _, d_hinge, d_gamma, d_weight = problem.log_likelihood(
                hinge_start + length * start.free_axes * shift, gamma_now, weight, first
            )
            optimiser.step(
                [
                    start.free_axes * (shift / settings.hinge_reach**2 - length * d_hinge),
                    settings.gamma_shape * (ratio - 1.0) - gamma_now * d_gamma,
                    weight / settings.weight_var - d_weight,
                ],
                settings.learning_rate * min(_half_cosine(taken / total), _COOLING**n_coolings),
            )
            taken += 1
    # what the last epoch changed, up or down
    change = abs(objectives[-2] - objectives[-1]) if len(objectives) > 1 else math.inf
    settled = change <= 10.0 * settings.tolerance * objectives[-1]
    return _Means(hinge, gamma, weights, objectives, settled and weights.converged)


def _half_cosine(done: float) -> float:
    """The rate's share of its start when a share of the steps is done: from 1 to a twentieth."""
    return 0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * done))


class _Adam:
    """Adam (Kingma, Ba, ICLR 2015) on arrays in place: on arrays as small as these torch's takes longer than the gradient."""

    def __init__(self, parameters: list[Float32]) -> None:
        self._parameters = parameters
        self._mean = [np.zeros_like(p) for p in parameters]
        self._square = [np.zeros_like(p) for p in parameters]
        self._taken = 0

    def step(self, gradients: list[Float32], rate: float) -> None:
        """One step down."""
        self._taken += 1
        size = np.float32(rate / (1.0 - 0.9**self._taken))
        root = np.float32(1.0 / math.sqrt(1.0 - 0.999**self._taken))
        for p, g, mean, square in zip(self._parameters, gradients, self._mean, self._square, strict=True):
            mean += np.float32(0.1) * (g - mean)
            square += np.float32(0.001) * (g * g - square)
            p -= size * mean / (root * np.sqrt(square) + np.float32(1e-8))


def _learn_dispersions(
    problem: _Problem, start: _Start, means: _Means, rng: np.random.Generator
) -> tuple[Float64, Float64, list[float]]:
    """Standard deviations of hinges (K, 3), m, and shapes of gammas (K,), that maximise the evidence lower bound."""
    settings, n, k = start.settings, problem.n, len(means.gamma)
    free_axes, length = torch.from_numpy(start.free_axes), _tensor(start.length)
    hinge, gamma = _tensor(means.hinge - problem.corner), _tensor(means.gamma)
    weight = torch.from_numpy(means.weights.mean)
    curvature_h, curvature_g = problem.curvatures(hinge.numpy(), gamma.numpy(), means.weights.mean)
    # in length scales and as log shapes: both of order one
    precision = torch.from_numpy(curvature_h) * length[:, None].square() + 1.0 / settings.hinge_reach**2
    log_sd = (-0.5 * precision.log()).requires_grad_()
    log_shape = (torch.from_numpy(curvature_g) + settings.gamma_shape).log().requires_grad_()
    prior_h = torch.distributions.Normal(0.0, settings.hinge_reach)
    prior_g = torch.distributions.Gamma(
        torch.full((k,), settings.gamma_shape), settings.gamma_shape / _tensor(start.gamma)
    )
    shift = (_tensor(means.hinge - start.hinge) / length[:, None]) * free_axes
    optimiser = torch.optim.Adam([log_sd, log_shape])
    # of this fit's own: others in this process draw from torch's global one
    generator = torch.Generator().manual_seed(int(rng.integers(2**63)))
    elbos: list[float] = []
    weight_cost = _weight_divergence(means.weights, settings.weight_var) + _weight_noise(
        means.weights, settings.weight_var
    )
    total = settings.dispersion_epochs * settings.steps
    for epoch in range(settings.dispersion_epochs):
        elbo = 0.0
        for step, first in enumerate(itertools.islice(problem.batches(rng), settings.steps)):
            done = (epoch * settings.steps + step) / total
            optimiser.param_groups[0]["lr"] = _DISPERSION_RATE * _half_cosine(done)
            optimiser.zero_grad()
            q_h = torch.distributions.Normal(shift, log_sd.exp())
            q_g = torch.distributions.Gamma(log_shape.exp(), log_shape.exp() / gamma)
            moved = q_h.scale * torch.randn((k, 3), generator=generator) * length[:, None] * free_axes
            # what q_g.rsample() does, with a generator of our own; its gradient in the shape is implicit (Figurnov et al. 2018)
            drawn = torch._standard_gamma(q_g.concentration, generator=generator) / q_g.rate
            fit = _log_likelihood(problem, hinge + moved, drawn.clamp_min(_LEAST_GAMMA), weight, first)
            divergence = (torch.distributions.kl_divergence(q_h, prior_h) * free_axes).sum()
            divergence = divergence + torch.distributions.kl_divergence(q_g, prior_g).sum()
            bound = (fit - divergence) / n
            (-bound).backward()
            optimiser.step()
            elbo += float(bound.detach())
        elbos.append(elbo / settings.steps - weight_cost / n)
    with torch.no_grad():
        sd = (log_sd.exp() * length[:, None] * free_axes).double().numpy()
        shape = log_shape.double().exp().numpy()
    if not (np.isfinite(sd).all() and np.isfinite(shape).all()):
        raise SolverError(f"the dispersions of {k} kernels on {n} points diverged")
    return sd, shape, elbos


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Arrays of K numbers are too small to share: torch's threads would wait for each other, longer than the work takes."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _weight_divergence(weights: _Weights, prior_var: float) -> float:
    """KL of the weights' posterior from their prior, nats."""
    ratio = weights.var.astype(np.float64) / prior_var
    return float(
        0.5 * (ratio + np.square(weights.mean, dtype=np.float64) / prior_var - 1.0 - np.log(ratio)).sum()
    )


def _weight_noise(weights: _Weights, prior_var: float) -> float:
    """What the weights' variance takes from the expected log-likelihood, to second order, nats.

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


def _log_likelihood(
    problem: _Problem,
    hinge: torch.Tensor,
    gamma: torch.Tensor,
    weight: torch.Tensor,
    first: NDArray[np.int64],
) -> torch.Tensor:
    return _LogLikelihood.apply(problem, hinge, gamma, weight, first)


def _tensor(array: Float64) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))


# The inner loops get slices, so that the compiler makes SIMD code of them; see feature_blocks.py.
@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _forward(x, y, z, hx, hy, hz, g, w, phi, d2):
    for i in range(len(phi)):
        dx, dy, dz = x - hx[i], y - hy[i], z - hz[i]
        q = dx * dx + dy * dy + dz * dz
        d2[i] = q
        phi[i] = exp32(-g[i] * q)
    # A loop of its own, which stores nothing: the compiler guards loops that store by a check for overlapping memory, and the
    # guarded ones add in another order. Where arrays happen to lie must not change the last bit of a sum.
    f = np.float32(0)
    for i in range(len(phi)):
        f += w[i] * phi[i]
    return f


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _backward(residual, x, y, z, hx, hy, hz, g, w, phi, d2, by_x, by_y, by_z, by_g, by_w):
    for i in range(len(phi)):
        t = residual * phi[i]
        by_w[i] += t
        t *= w[i]
        by_g[i] -= t * d2[i]
        t *= np.float32(2) * g[i]
        by_x[i] += t * (x - hx[i])
        by_y[i] += t * (y - hy[i])
        by_z[i] += t * (z - hz[i])


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _gradient(x, occupied, count, cuts, kernels, numbers, columns, first, stride, negligible):
    """Sum of count * log-likelihood over every `stride`-th point of each cube, and its gradient (5, K) in `columns`."""
    out = np.zeros(columns.shape, np.float32)
    widest = 0
    for c in range(len(cuts) - 1):
        widest = max(widest, kernels[c + 1] - kernels[c])
    near, by = np.empty((5, widest), np.float32), np.empty((5, widest), np.float32)
    phi_of, d2_of = np.empty(widest, np.float32), np.empty(widest, np.float32)
    total = 0.0
    for c in range(len(cuts) - 1):
        if cuts[c] + first[c] >= cuts[c + 1]:
            continue
        at, n = kernels[c], kernels[c + 1] - kernels[c]
        for i in range(n):
            m = numbers[at + i]
            for row in range(5):
                near[row, i] = columns[row, m]
        by[:, :n] = 0
        hx, hy, hz, g, w = near[0, :n], near[1, :n], near[2, :n], near[3, :n], near[4, :n]
        phi, d2 = phi_of[:n], d2_of[:n]
        for r in range(cuts[c] + first[c], cuts[c + 1], stride):
            f = _forward(x[0, r], x[1, r], x[2, r], hx, hy, hz, g, w, phi, d2)
            margin = f if occupied[r] else -f
            small = exp32(-abs(margin))
            total += count[r] * (min(margin, np.float32(0)) - np.log1p(small))
            wrong = small / (np.float32(1) + small) if margin > 0 else np.float32(1) / (np.float32(1) + small)
            residual = count[r] * (wrong if occupied[r] else -wrong)
            if abs(residual) >= negligible:
                _backward(
                    residual, x[0, r], x[1, r], x[2, r], hx, hy, hz, g, w, phi, d2,
                    by[0, :n], by[1, :n], by[2, :n], by[3, :n], by[4, :n],
                )  # fmt: skip
        for i in range(n):
            m = numbers[at + i]
            for row in range(5):
                out[row, m] += by[row, i]
    return total, out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _curvatures(x, count, cuts, kernels, numbers, columns):
    """Gauss-Newton curvature (4, K) of the log-likelihood: in each hinge coordinate, 1/m^2, and in each log gamma."""
    out = np.zeros((4, columns.shape[1]), np.float32)
    for c in range(len(cuts) - 1):
        at, n = kernels[c], kernels[c + 1] - kernels[c]
        near = np.empty((5, n), np.float32)
        for i in range(n):
            for row in range(5):
                near[row, i] = columns[row, numbers[at + i]]
        phi, d2 = np.empty(n, np.float32), np.empty(n, np.float32)
        for r in range(cuts[c], cuts[c + 1]):
            f = _forward(x[0, r], x[1, r], x[2, r], near[0], near[1], near[2], near[3], near[4], phi, d2)
            small = exp32(-abs(f))
            curvature = count[r] * small / np.square(np.float32(1) + small)
            for i in range(n):
                t = near[4, i] * phi[i] * near[3, i]
                m = numbers[at + i]
                for axis in range(3):
                    slope = np.float32(2) * t * (x[axis, r] - near[axis, i])
                    out[axis, m] += curvature * slope * slope
                out[3, m] += curvature * t * t * d2[i] * d2[i]
    return out
