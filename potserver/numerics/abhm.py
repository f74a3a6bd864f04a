"""Automorphing Bayesian Hilbert maps (ABHM): weights, hinges and widths of K kernels learned from labelled points.

    y_n ~ Bernoulli(sigmoid(f(x_n))),   f(x) = sum_m w_m exp(-gamma_m |x - h_m|^2)
    w_m ~ Normal(0, weight_var),   h_m ~ Normal(start, (hinge_reach ell)^2),   gamma_m ~ Gamma(gamma_shape, mean = start)

with ell = 1 / sqrt(2 gamma), the length scale a kernel starts with. Source: Senanayake, Tompkins, Ramos, CoRL 2018, and section
II-A of the RSS 2020 paper. Black-box variational inference over all ten numbers of a kernel at once is slow and ends worse than
fixed kernels with jointly solved weights, so the posterior q(w) q(h) q(gamma) is found in two stages:

1. *Means.* Given hinges and widths the weights are a convex problem that `fit_sparse` solves jointly, so they are collapsed:
   each epoch solves them, then takes stochastic gradient steps (Adam, mini-batches) on h, log gamma and w together.
2. *Dispersions.* With the means held, the variances of h and the shapes of gamma maximise the evidence lower bound by
   stochastic variational inference: reparameterised samples of h and gamma, the exact KL divergence of each. They start at the
   Gauss-Newton curvature, and few epochs suffice.

Sampling in the first stage too was measured: the means then end near their start, and held-out NLL is half as large again.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numba as nb
import numpy as np
import torch
from numpy.typing import NDArray

from potserver.errors import EmptyError, ShapeError, SolverError
from potserver.numerics.fastexp import FAST, exp32
from potserver.numerics.kernel_index import sparse_features
from potserver.numerics.logistic import WeightPosterior, fit_sparse, rows_dot
from potserver.numerics.threads import parallel_map, spans

Bool = NDArray[np.bool_]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

_BLOCKS = 4  # fixed: the sums, and so the kernels, must not depend on the number of threads
_FEATURE_CUT = 3e-3  # activations below this are left out of an epoch
_NEGLIGIBLE = np.float32(1e-4)  # points explained to this residual have no say in a gradient


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
    tolerance: float = 2e-3  # two epochs that each gain less than this share of the objective end the means; negative = never

    def __post_init__(self) -> None:
        for name in ("weight_var", "hinge_reach", "gamma_shape", "learning_rate"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ShapeError(f"{name} must be > 0 and finite, got {getattr(self, name)}")
        for name in ("max_epochs", "dispersion_epochs"):
            if getattr(self, name) < 0:
                raise ShapeError(f"{name} must be >= 0, got {getattr(self, name)}")
        if self.steps < 1 or self.batch < 1:
            raise ShapeError("steps and batch must be at least 1")


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
        EmptyError: no points or no kernels. ShapeError: arrays disagree, or gamma is not positive.
        SolverError: the objective is no longer finite.
    """
    n = len(points)
    _check(points, occupied, hinge, gamma, sample_weight)
    count = np.ones(n, np.float32) if sample_weight is None else sample_weight.astype(np.float32)
    free_axes = (np.ptp(points, axis=0) > 0.0).astype(np.float32)
    problem = _Problem(points, occupied, count, settings, threads)
    start = _Start(hinge, np.asarray(gamma, np.float64), free_axes, settings)
    rng = np.random.default_rng(seed)

    means = _learn_means(problem, start, rng, on_epoch)
    hinge_sd, shape, elbos = _learn_dispersions(problem, start, means, rng, seed)
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


class _Means(NamedTuple):
    hinge: Float64
    gamma: Float64
    weights: WeightPosterior
    objectives: list[float]
    converged: bool


class _Problem:
    """The labelled points, sorted so that those near each other share kernels; rebuilt features an epoch."""

    def __init__(
        self, points: Float64, occupied: Bool, count: Float32, settings: AbhmSettings, threads: int
    ) -> None:
        self.points, self.occupied, self.count = points, occupied, count
        self.settings, self.threads = settings, threads
        self.n = len(points)

    def gather(self, hinge: Float64, gamma: Float64) -> None:
        """Find which kernels reach which points."""
        self.features = sparse_features(self.points, hinge, gamma, cut=_FEATURE_CUT, threads=self.threads)
        order = self.features.order
        # relative to one corner: float32 then has the digits that matter
        self.corner = self.points.min(axis=0)
        self.sorted_points = (self.points[order] - self.corner).astype(np.float32)
        self.sorted_occupied, self.sorted_count = self.occupied[order], self.count[order]

    def solve(self, n_kernels: int, start: Float32 | None, *, rough: bool) -> WeightPosterior:
        """The weights given the features; roughly where gradient steps follow."""
        return fit_sparse(
            self.features, self.occupied,
            np.zeros(n_kernels, np.float32), np.full(n_kernels, self.settings.weight_var, np.float32),
            sample_weight=self.count, start=start,
            tolerance=3e-2 if rough else 1e-3, max_newton=2 if rough else 30,
            max_conjugate_gradient=20 if rough else 200, threads=self.threads,
        )  # fmt: skip

    def batches(self, rng: np.random.Generator) -> NDArray[np.int64]:
        """(B,) rows for one step; in order, for the cache's sake."""
        size = self.settings.batch
        return np.arange(self.n) if size >= self.n else np.sort(rng.choice(self.n, size, replace=False))

    def log_likelihood(
        self, hinge: Float32, gamma: Float32, weight: Float32, rows: NDArray[np.int64]
    ) -> tuple[float, Float32, Float32, Float32]:
        """Sum over rows, and its gradients; hinges relative to the corner."""
        parts = parallel_map(
            lambda span: _rows_gradient(
                self.sorted_points, self.sorted_occupied, self.sorted_count, rows[span[0] : span[1]],
                self.features.indptr, self.features.indices, hinge, gamma, weight,
            ),
            spans(len(rows), _BLOCKS), self.threads,
        )  # fmt: skip
        total, d_hinge, d_gamma, d_weight = parts[0]
        for part in parts[1:]:
            total += part[0]
            d_hinge += part[1]
            d_gamma += part[2]
            d_weight += part[3]
        return total, d_hinge, d_gamma, d_weight


def _learn_means(
    problem: _Problem,
    start: _Start,
    rng: np.random.Generator,
    on_epoch: Callable[[AbhmEpoch], None] | None,
) -> _Means:
    settings, k, n = start.settings, len(start.hinge), problem.n
    shift = torch.zeros((k, 3), requires_grad=True)  # of hinges, in length scales
    log_ratio = torch.zeros(k, requires_grad=True)  # of gammas to their start
    weight = torch.zeros(k, requires_grad=True)
    optimiser = torch.optim.Adam([shift, log_ratio, weight], lr=settings.learning_rate)
    free_axes = torch.from_numpy(start.free_axes)
    length, gamma_start = _tensor(start.length), _tensor(start.gamma)
    total = settings.max_epochs * settings.steps
    objectives: list[float] = []
    n_still, taken = 0, 0
    warm: Float32 | None = None
    for epoch in range(settings.max_epochs + 1):
        hinge, gamma = start.hinge_at(shift.detach().numpy()), start.gamma_at(log_ratio.detach().numpy())
        if not (np.isfinite(hinge).all() and np.isfinite(gamma).all() and (gamma > 0).all()):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        problem.gather(hinge, gamma)
        last = epoch == settings.max_epochs or n_still == 2
        weights = problem.solve(k, warm, rough=not last)
        objective = _objective(problem, weights.mean) + start.penalty(
            shift.detach().numpy(), log_ratio.detach().numpy()
        )
        objectives.append(objective / n)
        if not np.isfinite(objective):
            raise SolverError(f"learning {k} kernels on {n} points diverged in epoch {epoch}")
        if on_epoch:
            on_epoch(AbhmEpoch(epoch, settings.max_epochs, objectives[-1], hinge, gamma, weights.mean.copy()))
        if last:
            break
        with torch.no_grad():
            weight.copy_(torch.from_numpy(weights.mean))
        hinge_start = _tensor(start.hinge - problem.corner)
        for _ in range(settings.steps):
            rate = 0.05 + 0.95 * 0.5 * (1.0 + math.cos(math.pi * taken / total))
            optimiser.param_groups[0]["lr"] = settings.learning_rate * rate
            optimiser.zero_grad()
            rows = problem.batches(rng)
            fit = _log_likelihood(
                problem,
                hinge_start + length[:, None] * free_axes * shift,
                gamma_start * log_ratio.exp(),
                weight,
                rows,
            )
            prior = (
                (shift * free_axes).square().sum() / (2.0 * settings.hinge_reach**2)
                + settings.gamma_shape * (log_ratio.exp() - log_ratio).sum()
                + weight.square().sum() / (2.0 * settings.weight_var)
            )
            (prior / n - fit / len(rows)).backward()
            optimiser.step()
            taken += 1
        warm = weight.detach().numpy().copy()
        gain = _relative(objectives[-2] - objectives[-1], objectives[-2]) if len(objectives) > 1 else 1.0
        n_still = n_still + 1 if gain < settings.tolerance else 0
    # what the last epoch changed, up or down
    change = (
        _relative(abs(objectives[-2] - objectives[-1]), objectives[-2]) if len(objectives) > 1 else math.inf
    )
    settled = change < 10.0 * settings.tolerance
    return _Means(hinge, gamma, weights, objectives, settled and weights.converged)


def _relative(change: float, whole: float) -> float:
    """0 where there is nothing to explain."""
    return change / whole if whole > 0.0 else 0.0


def _objective(problem: _Problem, weight: Float32) -> float:
    """Minus the log posterior of the weights, constants left out, nats."""
    f = np.empty(problem.n, np.float32)
    rows_dot(
        problem.features.indptr, problem.features.indices, problem.features.values, weight, 0, problem.n, f
    )
    loss = np.logaddexp(0.0, f, dtype=np.float64) - problem.sorted_occupied * f
    prior = np.square(weight, dtype=np.float64).sum() / (2.0 * problem.settings.weight_var)
    return float((problem.sorted_count * loss).sum() + prior)


def _learn_dispersions(
    problem: _Problem, start: _Start, means: _Means, rng: np.random.Generator, seed: int
) -> tuple[Float64, Float64, list[float]]:
    """Standard deviations of hinges (K, 3), m, and shapes of gammas (K,), that maximise the evidence lower bound."""
    settings, n, k = start.settings, problem.n, len(means.gamma)
    free_axes, length = torch.from_numpy(start.free_axes), _tensor(start.length)
    hinge, gamma = _tensor(means.hinge - problem.corner), _tensor(means.gamma)
    weight = torch.from_numpy(means.weights.mean)
    curvature_h, curvature_g = _curvatures(
        problem.sorted_points, problem.sorted_count, problem.features.indptr, problem.features.indices,
        hinge.numpy(), gamma.numpy(), means.weights.mean,
    )  # fmt: skip
    # in length scales and as log shapes: both of order one
    precision = torch.from_numpy(curvature_h) * length[:, None].square() + 1.0 / settings.hinge_reach**2
    log_sd = (-0.5 * precision.log()).requires_grad_()
    log_shape = (torch.from_numpy(curvature_g) + settings.gamma_shape).log().requires_grad_()
    prior_h = torch.distributions.Normal(0.0, settings.hinge_reach)
    prior_g = torch.distributions.Gamma(
        torch.full((k,), settings.gamma_shape), settings.gamma_shape / _tensor(start.gamma)
    )
    shift = (_tensor(means.hinge - start.hinge) / length[:, None]) * free_axes
    optimiser = torch.optim.Adam([log_sd, log_shape], lr=0.05)
    elbos: list[float] = []
    weight_cost = _weight_divergence(means.weights, settings.weight_var) + _weight_noise(
        means.weights, settings.weight_var
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for _ in range(settings.dispersion_epochs):
            elbo = 0.0
            for _ in range(settings.steps):
                optimiser.zero_grad()
                rows = problem.batches(rng)
                q_h = torch.distributions.Normal(shift, log_sd.exp())
                q_g = torch.distributions.Gamma(log_shape.exp(), log_shape.exp() / gamma)
                moved = (q_h.rsample() - shift) * length[:, None] * free_axes
                fit = _log_likelihood(problem, hinge + moved, q_g.rsample(), weight, rows)
                divergence = (torch.distributions.kl_divergence(q_h, prior_h) * free_axes).sum()
                divergence = divergence + torch.distributions.kl_divergence(q_g, prior_g).sum()
                bound = fit / len(rows) - divergence / n
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


def _weight_divergence(weights: WeightPosterior, prior_var: float) -> float:
    """KL of the weights' posterior from their prior, nats."""
    ratio = weights.var.astype(np.float64) / prior_var
    return float(
        0.5 * (ratio + np.square(weights.mean, dtype=np.float64) / prior_var - 1.0 - np.log(ratio)).sum()
    )


def _weight_noise(weights: WeightPosterior, prior_var: float) -> float:
    """What the weights' variance takes from the expected log-likelihood, to second order, nats.

    1 / var is the curvature of likelihood and prior together, so the likelihood's share of it is 1 - var / prior_var.
    """
    return float(0.5 * (1.0 - weights.var.astype(np.float64) / prior_var).sum())


class _LogLikelihood(torch.autograd.Function):
    """Sum of log-likelihoods over some rows; differentiable in hinges, gammas and weights."""

    @staticmethod
    def forward(ctx: Any, problem: Any, hinge: Any, gamma: Any, weight: Any, rows: Any) -> Any:
        total, *gradients = problem.log_likelihood(
            hinge.detach().numpy(), gamma.detach().numpy(), weight.detach().numpy(), rows
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
    rows: NDArray[np.int64],
) -> torch.Tensor:
    return _LogLikelihood.apply(problem, hinge, gamma, weight, rows)


def _tensor(array: Float64) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _rows_gradient(points, occupied, count, rows, indptr, indices, hinge, gamma, weight):
    """Sum of count * log-likelihood over some rows, and its gradients, in one pass: a row's activations stay in cache."""
    width = 0
    for r in rows:
        width = max(width, indptr[r + 1] - indptr[r])
    phi, d2 = np.empty(width, np.float32), np.empty(width, np.float32)
    d_hinge = np.zeros(hinge.shape, np.float32)
    d_gamma, d_weight = np.zeros(len(gamma), np.float32), np.zeros(len(gamma), np.float32)
    total = 0.0
    for r in rows:
        first, last = indptr[r], indptr[r + 1]
        x, y, z = points[r, 0], points[r, 1], points[r, 2]
        f = np.float32(0)
        for e in range(first, last):
            m = indices[e]
            dx, dy, dz = x - hinge[m, 0], y - hinge[m, 1], z - hinge[m, 2]
            q = dx * dx + dy * dy + dz * dz
            d2[e - first] = q
            phi[e - first] = exp32(-gamma[m] * q)
            f += weight[m] * phi[e - first]
        margin = f if occupied[r] else -f
        small = exp32(-abs(margin))
        total += count[r] * (min(margin, np.float32(0)) - np.log1p(small))
        wrong = small / (np.float32(1) + small) if margin > 0 else np.float32(1) / (np.float32(1) + small)
        residual = count[r] * (wrong if occupied[r] else -wrong)
        if abs(residual) < _NEGLIGIBLE:
            continue
        for e in range(first, last):
            m = indices[e]
            t = residual * phi[e - first]
            d_weight[m] += t
            t *= weight[m]
            d_gamma[m] -= t * d2[e - first]
            t *= np.float32(2) * gamma[m]
            d_hinge[m, 0] += t * (x - hinge[m, 0])
            d_hinge[m, 1] += t * (y - hinge[m, 1])
            d_hinge[m, 2] += t * (z - hinge[m, 2])
    return total, d_hinge, d_gamma, d_weight


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _curvatures(points, count, indptr, indices, hinge, gamma, weight):
    """Gauss-Newton curvature of the log-likelihood: in each hinge coordinate (K, 3), 1/m^2, and in each log gamma (K,)."""
    by_hinge, by_gamma = np.zeros(hinge.shape, np.float32), np.zeros(len(gamma), np.float32)
    for r in range(len(points)):
        first, last = indptr[r], indptr[r + 1]
        f = np.float32(0)
        for turn in range(2):
            p = np.float32(1) / (np.float32(1) + exp32(-f))
            curvature = count[r] * p * (np.float32(1) - p)
            for e in range(first, last):
                m = indices[e]
                d2 = np.float32(0)
                for c in range(3):
                    d = points[r, c] - hinge[m, c]
                    d2 += d * d
                t = weight[m] * exp32(-gamma[m] * d2)
                if turn == 0:
                    f += t
                    continue
                t *= gamma[m]
                by_gamma[m] += curvature * t * t * d2 * d2
                for c in range(3):
                    slope = np.float32(2) * t * (points[r, c] - hinge[m, c])
                    by_hinge[m, c] += curvature * slope * slope
    return by_hinge, by_gamma
