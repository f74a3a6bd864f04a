"""Slow float64 references: the paper's equations as they are written, with nothing that makes them fast."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import ot
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, ndtri
from scipy.stats import rankdata

from potserver.domain.types import Atom, Float64, KernelSet, Sector, yaw_pose


class Latent(NamedTuple):
    """Sums of eq. 1 over all kernels."""

    mean: Float64
    var: Float64
    activation: Float64


def latent(
    points: ArrayLike,
    hinge: ArrayLike,
    gamma: ArrayLike,
    weight: ArrayLike,
    variance: ArrayLike,
    prior_var: float = 100.0,
) -> Latent:
    """Eq. 1 in float64: every kernel at every point; the activation by what is known of the weights."""
    arrays = (np.ascontiguousarray(a, np.float64) for a in (points, hinge, gamma, weight, variance))
    return Latent(*_latent(*arrays, prior_var))


@nb.njit(cache=True)
def _latent(points, hinge, gamma, weight, variance, prior_var):
    sums = np.zeros((3, len(points)))
    for i in range(len(points)):
        for m in range(len(hinge)):
            d2 = 0.0
            for c in range(points.shape[1]):
                d2 += (points[i, c] - hinge[m, c]) ** 2
            phi = np.exp(-gamma[m] * d2)
            sums[0, i] += weight[m] * phi
            sums[1, i] += variance[m] * phi * phi
            sums[2, i] += max(1.0 - variance[m] / prior_var, 0.0) * phi
    return sums


def moderated(mean: ArrayLike, var: ArrayLike) -> Float64:
    """Row A19: sigmoid(mu / sqrt(1 + pi s2 / 8))."""
    return expit(np.asarray(mean, np.float64) / np.sqrt(1.0 + math.pi / 8.0 * np.asarray(var, np.float64)))


def probability_moments(mean: float, var: float, n: int = 20_001) -> tuple[float, float]:
    """Mean and variance of sigmoid(f), f ~ Normal(mean, var), by equal slices of the normal's mass."""
    p = expit(mean + math.sqrt(var) * ndtri((np.arange(n) + 0.5) / n))
    return float(p.mean()), float(p.var())


def squared_distances(x: ArrayLike, y: ArrayLike) -> Float64:
    """D of eq. 3, m^2."""
    return np.square(np.asarray(x, np.float64)[:, None, :] - np.asarray(y, np.float64)[None]).sum(axis=2)


def sinkhorn_cost(x: ArrayLike, y: ArrayLike, reg: float) -> float:
    """<P, D> of eq. 4 by POT in float64; without entropy at a reg of 0."""
    if reg == 0.0:
        return exact_plan(x, y)[1]
    cost = squared_distances(x, y)
    plan = ot.sinkhorn([], [], cost, reg, stopThr=1e-9, numItermax=20_000)
    return float((plan * cost).sum())


def exact_plan(x: ArrayLike, y: ArrayLike) -> tuple[Float64, float]:
    """Eq. 4 without entropy, and <P, D>, by POT's linear program."""
    cost = squared_distances(x, y)
    plan = ot.emd([], [], cost)
    return plan, float((plan * cost).sum())


def rotated(points: ArrayLike, angle_rad: float) -> Float64:
    """Eq. 5 written out: x' = x cos - y sin, y' = x sin + y cos, z' = z."""
    p = np.asarray(points, np.float64)
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]], axis=1)


class Ranking(NamedTuple):
    """Eq. 6-7 over all candidates: atoms by rotations."""

    w2: Float64  # (A, R) m^2, hits plus free points
    normalised: Float64  # (A, R) rows A7-A9


def rank(atoms: list[Atom], rotations_rad: list[float], sector: Sector, reg: float) -> Ranking:
    """Brute force over every atom in every rotation."""

    def centre(thing: Atom | Sector, other: Atom | Sector) -> Float64:
        both = len(thing.hit_points) and len(other.hit_points)
        return (thing.hit_points if both else thing.free_points).astype(np.float64).mean(axis=0)

    costs = np.zeros((2, len(atoms), len(rotations_rad)))
    for label, name in enumerate(("hit_points", "free_points")):
        target = getattr(sector, name)
        for a, atom in enumerate(atoms):
            for r, angle in enumerate(rotations_rad):
                if len(target) == 0:
                    continue
                if len(getattr(atom, name)) == 0:
                    costs[label, a, r] = np.inf
                    continue
                source = rotated(getattr(atom, name) - centre(atom, sector), angle)
                costs[label, a, r] = sinkhorn_cost(source, target - centre(sector, atom), reg)
    largest = [c[np.isfinite(c)].max(initial=0.0) or 1.0 for c in costs]
    return Ranking(costs.sum(axis=0), costs[0] / largest[0] + costs[1] / largest[1])


class Scores(NamedTuple):
    """The paper's three measures."""

    accuracy: float
    auc: float
    nll: float


def score(p: ArrayLike, occupied: ArrayLike, clip: float) -> Scores:
    """ACC at 0.5, AUC with ties half, NLL in natural logarithms."""
    q, y = np.asarray(p, np.float64), np.asarray(occupied, bool)
    n1, n0 = int(y.sum()), int((~y).sum())
    auc = (rankdata(q)[y].sum() - n1 * (n1 + 1) / 2) / (n1 * n0)
    c = np.clip(q, clip, 1.0 - clip)
    return Scores(
        float(((q >= 0.5) == y).mean()), float(auc), float(-np.where(y, np.log(c), np.log(1 - c)).mean())
    )


def spaced(
    rng: np.random.Generator, n: int, low: ArrayLike, high: ArrayLike, gap_m: float
) -> NDArray[np.float32]:
    """At most n random points in a box, no two nearer than `gap_m`: no voxel filter of a smaller diagonal drops one."""
    kept = np.empty((0, 3))
    for point in rng.uniform(low, high, (40 * n, 3)):
        if len(kept) < n and (np.square(kept - point).sum(axis=1) >= gap_m**2).all():
            kept = np.concatenate([kept, point[None]])
    return kept.astype(np.float32)


def kernels_at(points: ArrayLike, rng: np.random.Generator) -> KernelSet:
    """Kernels with all ten numbers different, so that a dropped or mixed-up one shows."""
    hinge = np.asarray(points, np.float64)
    k = len(hinge)
    return KernelSet(
        hinge_mean=hinge,
        hinge_var=rng.uniform(0.01, 0.5, (k, 3)).astype(np.float32),
        gamma_shape=rng.uniform(1.0, 50.0, k).astype(np.float32),
        gamma_rate=rng.uniform(1.0, 50.0, k).astype(np.float32),
        weight_mean=rng.permutation(np.linspace(-8.0, 8.0, k)).astype(np.float32),
        weight_var=rng.uniform(0.1, 9.0, k).astype(np.float32),
    )


def atom(
    atom_id: str, hits: ArrayLike, free: ArrayLike, kernels: KernelSet | None = None, *, dims: int = 3
) -> Atom:
    """An atom of the given points."""
    return Atom(
        atom_id=atom_id,
        dims=dims,
        hit_points=np.asarray(hits, np.float32).reshape(-1, 3),
        free_points=np.asarray(free, np.float32).reshape(-1, 3),
        kernels=KernelSet.empty() if kernels is None else kernels,
        radius_m=20.0,
        azimuth_width_rad=math.radians(72.0),
        provenance={},
    )


def sector(
    hits: ArrayLike, free: ArrayLike, *, half_width_deg: float = 36.0, radius_m: float = 20.0
) -> Sector:
    """A sector about the map's x axis with the given points."""
    return Sector(
        azimuth_min_rad=-math.radians(half_width_deg),
        azimuth_max_rad=math.radians(half_width_deg),
        radius_m=radius_m,
        hit_points=np.asarray(hits, np.float32).reshape(-1, 3),
        free_points=np.asarray(free, np.float32).reshape(-1, 3),
        T_map_sector=yaw_pose(0.0, 0.0, 0.0),
    )


class Dense(NamedTuple):
    """Laplace approximation of K weights."""

    mean: Float64  # (K,) log-odds
    var: Float64  # (K,) log-odds^2: 1 / diagonal of the Hessian


def fit_dense(
    features: Float64,
    labels: ArrayLike,
    prior_mean: ArrayLike,
    prior_var: ArrayLike,
    *,
    tolerance: float = 1e-14,
    max_newton: int = 500,
) -> Dense:
    """Bayesian logistic regression of weights by Newton's method with a dense Hessian; MacKay 1992.

    Args:
        features: (N, K) phi.
        labels: (N,) true = occupied.
        prior_mean: (K,) log-odds.
        prior_var: (K,) log-odds^2, > 0.
        tolerance: Newton decrement, per datum, at which it stops.
        max_newton: Newton steps at most; an assertion fails when they are not enough.
    """
    y, mean = np.asarray(labels, np.float64), np.asarray(prior_mean, np.float64)
    precision = 1.0 / np.asarray(prior_var, np.float64)

    def objective(w: Float64) -> float:
        f = features @ w
        return float((np.logaddexp(0.0, f) - y * f).sum() + 0.5 * (precision * np.square(w - mean)).sum())

    w = mean.copy()
    for _ in range(max_newton):
        p = expit(features @ w)
        gradient = features.T @ (p - y) + precision * (w - mean)
        hessian = (features * (p * (1.0 - p))[:, None]).T @ features + np.diag(precision)
        step = -np.linalg.solve(hessian, gradient)
        decrement = -float(gradient @ step)
        if decrement <= tolerance * max(1, len(y)):
            return Dense(w, 1.0 / hessian.diagonal())
        size = 1.0
        while size > 1e-6 and objective(w + size * step) > objective(w) - 1e-4 * size * decrement:
            size *= 0.5
        w = w + size * step
    raise AssertionError(f"no optimum in {max_newton} Newton steps")
