"""Bayesian logistic regression of kernel weights.

    maximise  sum_n log p(y_n | f_n) - 1/2 sum_m (w_m - prior_mean_m)^2 / prior_var_m,    f_n = offset_n + sum_m w_m phi_m(x_n)

Newton steps whose linear systems are solved by conjugate gradients on sparse features. The prior stays fixed and every datum
counts once; the RSS 2020 code does neither, and its diagonal updates overshoot.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.numerics.fastexp import FAST
from potserver.numerics.kernel_index import SparseFeatures
from potserver.numerics.occupancy import sigmoid
from potserver.numerics.threads import parallel_map, spans

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


_BLOCKS = 4


class WeightPosterior(NamedTuple):
    """Gaussian over the weights at the maximum of the posterior (Laplace), and how the solve ended."""

    mean: Float32  # (K,) log-odds
    var: Float32  # (K,) log-odds^2: 1 / diagonal of the Hessian, the variance of each weight given the others
    n_newton: int
    n_conjugate_gradient: int
    gradient_norm: float  # when it was last looked at, relative to its norm at the start
    converged: bool


def fit_sparse(
    features: SparseFeatures,
    labels: NDArray[np.bool_],
    prior_mean: Float32,
    prior_var: Float32,
    *,
    offset: Float32 | None = None,
    sample_weight: Float32 | None = None,
    start: Float32 | None = None,
    tolerance: float = 1e-3,
    max_newton: int = 12,
    max_conjugate_gradient: int = 60,
    threads: int = 1,
) -> WeightPosterior:
    """Fit the weights of K kernels to N labelled points.

    Args:
        features: Rows of phi, N points by K kernels.
        labels: (N,) true = occupied, in the order of the points (not of `features.order`).
        prior_mean: (K,) log-odds.
        prior_var: (K,) log-odds^2, > 0.
        offset: (N,) latent that is already explained, log-odds, in the order of the points.
        sample_weight: (N,) how much each point counts; 1 by default.
        start: (K,) weights to begin with, if they are better than the prior's and than zero.
        tolerance: Gradient norm, relative to the start, at which Newton stops.
        max_newton: Newton steps at most.
        max_conjugate_gradient: Conjugate-gradient steps a Newton step at most.
        threads: Threads for the products with the features.
    """
    n, k = len(labels), len(prior_mean)
    order = features.order
    y = labels[order].astype(np.float32)
    base = np.zeros(n, np.float32) if offset is None else offset[order].astype(np.float32)
    count = np.ones(n, np.float32) if sample_weight is None else sample_weight[order].astype(np.float32)
    precision = (1.0 / prior_var).astype(np.float32)
    rows = spans(n, _BLOCKS)  # not `threads`: the sums, and so the map, must not depend on the machine

    def latent(weights: Float32) -> Float32:
        out = np.empty(n, np.float32)
        parallel_map(
            lambda s: rows_dot(features.indptr, features.indices, features.values, weights, s[0], s[1], out),
            rows,
            threads,
        )
        return out

    def transposed(vector: Float32, *, square: bool = False) -> Float32:
        parts = parallel_map(
            lambda s: _rows_scatter(
                features.indptr, features.indices, features.values, vector, s[0], s[1], k, square
            ),
            rows,
            threads,
        )
        return np.sum(parts, axis=0, dtype=np.float32) if parts else np.zeros(k, np.float32)

    def curvature_times(direction: Float32, curvature: Float32) -> Float32:
        parts = parallel_map(
            lambda s: _rows_normal(
                features.indptr, features.indices, features.values, curvature, direction, s[0], s[1]
            ),
            rows,
            threads,
        )
        return np.sum(parts, axis=0, dtype=np.float32) + precision * direction

    def objective(f: Float32, w: Float32) -> float:
        loss = np.logaddexp(0.0, f, dtype=np.float64) - y * f
        return float(
            (count * loss).sum() + 0.5 * (precision * np.square(w - prior_mean, dtype=np.float64)).sum()
        )

    # far from the optimum the curvature vanishes and Newton crawls: start from the best there is
    w, f, value = np.zeros(k, np.float32), base.copy(), math.inf
    for candidate in (np.zeros(k, np.float32), prior_mean, start):
        if candidate is None:
            continue
        candidate_f = base + latent(candidate) if candidate.any() else base.copy()
        if (at_candidate := objective(candidate_f, candidate)) < value:
            w, f, value = candidate.astype(np.float32), candidate_f, at_candidate
    start_norm, norm, n_newton, n_cg, converged = 0.0, 0.0, 0, 0, n == 0 or k == 0
    curvature = np.zeros(n, np.float32)
    while not converged:
        p = sigmoid(f)
        gradient = transposed(count * (p - y)) + precision * (w - prior_mean)
        norm = float(np.linalg.norm(gradient))
        start_norm = start_norm or norm
        curvature = count * np.maximum(p * (1.0 - p), np.float32(1e-7))
        if norm <= tolerance * start_norm:
            converged = True
            break
        if n_newton == max_newton:
            break
        diagonal = transposed(curvature, square=True) + precision
        # inexact Newton: far from the optimum a rough step is as good as an exact one
        forcing = min(0.1, math.sqrt(norm / start_norm))
        step, used = _conjugate_gradient(
            lambda d, curvature=curvature: curvature_times(d, curvature),
            -gradient,
            diagonal,
            forcing,
            max_conjugate_gradient,
        )
        n_newton += 1
        n_cg += used
        slope = float(gradient @ step)
        change = latent(step)
        size = 1.0
        for _ in range(20):
            trial = objective(f + np.float32(size) * change, w + np.float32(size) * step)
            if trial <= value + 1e-4 * size * slope:
                break
            size *= 0.5
        else:
            break  # float32 has nothing left to gain
        gain = value - trial
        w += np.float32(size) * step
        f += np.float32(size) * change
        value = trial
        if gain <= 1e-6 * max(1.0, abs(value)):
            converged = True
    if n and k:
        p = sigmoid(f)
        diagonal = transposed(count * p * (1.0 - p), square=True) + precision
    else:
        diagonal = precision
    return WeightPosterior(
        w, 1.0 / diagonal, n_newton, n_cg, norm / start_norm if start_norm else 0.0, bool(converged)
    )


def _conjugate_gradient(
    apply, rhs: Float32, diagonal: Float32, forcing: float, max_steps: int
) -> tuple[Float32, int]:
    """Solve A x = rhs with a Jacobi preconditioner until the residual has shrunk by `forcing`."""
    x = np.zeros_like(rhs)
    r = rhs.copy()
    z = r / diagonal
    d = z.copy()
    rz = float(r @ z)
    limit = (forcing**2) * rz
    for step in range(max_steps):
        q = apply(d)
        alpha = rz / float(d @ q)
        x += np.float32(alpha) * d
        r -= np.float32(alpha) * q
        z = r / diagonal
        rz_next = float(r @ z)
        if rz_next <= limit:
            return x, step + 1
        d = z + np.float32(rz_next / rz) * d
        rz = rz_next
    return x, max_steps


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def rows_dot(indptr, indices, values, w, first, last, out):
    for i in range(first, last):
        s = np.float32(0)
        for e in range(indptr[i], indptr[i + 1]):
            s += values[e] * w[indices[e]]
        out[i] = s


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _rows_scatter(indptr, indices, values, vector, first, last, k, square):
    out = np.zeros(k, np.float32)
    for i in range(first, last):
        c = vector[i]
        for e in range(indptr[i], indptr[i + 1]):
            a = values[e] * values[e] if square else values[e]
            out[indices[e]] += a * c
    return out


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _rows_normal(indptr, indices, values, curvature, direction, first, last):
    """Phi^T diag(curvature) Phi direction over some rows, in one pass."""
    out = np.zeros(len(direction), np.float32)
    for i in range(first, last):
        s = np.float32(0)
        for e in range(indptr[i], indptr[i + 1]):
            s += values[e] * direction[indices[e]]
        s *= curvature[i]
        for e in range(indptr[i], indptr[i + 1]):
            out[indices[e]] += values[e] * s
    return out
