"""Weights of a map that is fitted again after every scan: a few Newton steps from where they are.

    minimise  sum_n c_n (log(1 + exp(f_n)) - y_n f_n) + 1/2 sum_m (w_m - prior_mean_m)^2 / prior_var_m,    f = offset + Phi w

The work is bounded, and the last weights are near the optimum but for where the world has changed. Plain Newton gets stuck
there: a row that is surely wrong has no curvature left, steps overshoot and every line search fails. Two things help. Rows on
the wrong side take the curvature of the quadratic bound of Jaakkola and Jordan (1997), with which no step overshoots. Every row
has a least curvature: a higher one makes shorter steps, and ends farther from the optimum. With a tiny least curvature and many
steps this is an ordinary Newton solver.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float32
from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.feature_blocks import Blocks, gradient_and_diagonal, normal_product, product

_SHRINK = 0.25  # by which the line search shortens a step that is too long
_TRIALS = 12  # of the line search, at most
_NO_GAIN = 1e-5  # relative gain of the objective that float32 cannot show
_AT_ONCE = 256  # rows whose losses are summed in float32
# log(1 + t) / t for t in [0, 1], least squares in Chebyshev's points: off by 2e-8 at most
_LOG1P = tuple(
    np.float32(a)
    for a in (
        0.99999997, -0.49999502, 0.33319271, -0.2484437, 0.19111431, -0.1367477, 0.078361668, -0.0295885074, 0.0052534578,
    )
)  # fmt: skip


class Prior(NamedTuple):
    """Independent normal distributions of K weights, and what N rows are expected to say."""

    mean: Float32  # (K,) log-odds
    var: Float32  # (K,) log-odds^2, > 0
    offset: Float32 | None = (
        None  # (N,) log-odds, in the order of the labels: what f is without any kernel; None: 0
    )


class Solver(NamedTuple):
    """How far and how cautiously to go."""

    n_newton: int = 2  # Newton steps at most
    n_conjugate_gradient: int = 4  # conjugate-gradient steps for each of them
    # A Newton step that lowers the objective is doubled up to this length, in Newton steps, while that lowers it further. Where
    # labels part cleanly the weights have far to go and Newton's steps are short; a trial costs no product with Phi.
    longest_step: float = 1.0
    least_curvature: float = 0.01  # of a row that counts once, > 0
    enough: float = 1e-5  # relative gain of the objective below which steps end


class WarmFit(NamedTuple):
    """Weights after some Newton steps, and how they ended."""

    weights: Float32  # (K,) log-odds
    var: Float32  # (K,) log-odds^2: 1 / diagonal of the Hessian at the last step, the variance given the other weights
    support: Float32  # (K,) what the data add to that diagonal
    objective: float
    objective_at_start: float
    n_newton: int
    converged: (
        bool  # false: the gradient promises a gain that no trial step found; the weights are the best found
    )


def warm_fit(
    blocks: Blocks,
    labels: Bool | Float32,
    counts: Float32,
    prior: Prior,
    start: Float32,
    solver: Solver | None = None,
    *,
    free: Bool | None = None,
    threads: int = 1,
) -> WarmFit:
    """Improve the weights of K kernels on N labelled rows.

    Args:
        blocks: Phi.
        labels: (N,) in [0, 1], or true = occupied, in the order of the points that the blocks were built from. One half says
            that nothing is known.
        counts: (N,) how much each row counts, >= 0, same order.
        prior: Of the weights.
        start: (K,) log-odds: the weights as they are.
        solver: How; two cautious steps by default.
        free: (K,) which weights may change; all by default. The others are held, and count in f.
        threads: Threads for the products with the features.
    """
    solver = solver or Solver()
    y = np.asarray(labels, np.float32)[blocks.order]
    c = np.ascontiguousarray(counts[blocks.order], np.float32)
    precision = (1.0 / prior.var).astype(np.float32)
    mask = np.ones(len(start), np.float32) if free is None else free.astype(np.float32)
    w = start.astype(np.float32)
    f = product(blocks, w, threads=threads)
    if prior.offset is not None:
        f = f + prior.offset[blocks.order]

    def objective(change: Float32, step: Float32, size: float) -> float:
        off = (w + np.float32(size) * step - prior.mean).astype(np.float64)
        return float(
            _loss(f, change, np.float32(size), y, c) + 0.5 * (precision * mask * np.square(off)).sum()
        )

    diagonal = precision
    value = at_start = objective(f, np.zeros_like(w), 0.0)
    steps, converged = 0, True
    while steps < solver.n_newton:
        residual, curvature = _terms(f, y, c, np.float32(solver.least_curvature))
        gradient, diagonal = gradient_and_diagonal(blocks, residual, curvature, threads=threads)
        diagonal = diagonal + precision
        gradient = (gradient + precision * (w - prior.mean)) * mask
        step = _conjugate_gradient(
            lambda d, curvature=curvature: (
                (normal_product(blocks, curvature, d, threads=threads) + precision * d) * mask
            ),
            -gradient, diagonal, solver.n_conjugate_gradient,
        )  # fmt: skip
        slope = float(gradient @ step)
        if slope >= 0.0:
            break  # nothing to gain
        steps += 1
        change = product(blocks, step, threads=threads)
        size, trial = _line_search(
            functools.partial(objective, change, step), value, slope, solver.longest_step
        )
        if size == 0.0:
            converged = -slope <= _NO_GAIN * max(1.0, abs(value))  # float32 has nothing left to gain
            break
        w = w + np.float32(size) * step
        f = f + np.float32(size) * change
        gain, value = value - trial, trial
        if gain <= solver.enough * max(1.0, abs(value)):
            break
    return WarmFit(w, 1.0 / diagonal, diagonal - precision, value, at_start, steps, converged)


def _line_search(
    objective: Callable[[float], float], value: float, slope: float, longest: float
) -> tuple[float, float]:
    """How far to go along a step, and the objective there; 0 and the old value if nothing better was found.

    Args:
        objective: Of the share of the step that is taken.
        value, slope: The objective and its derivative at a share of 0.
        longest: The largest share.
    """
    size = 1.0
    for _ in range(_TRIALS):
        trial = objective(size)
        if trial <= value + 1e-4 * size * slope:
            break
        size *= _SHRINK
    else:
        return 0.0, value
    while 1.0 <= size < longest:
        farther = objective(2.0 * size)
        if farther >= trial:
            break
        size, trial = 2.0 * size, farther
    return size, trial


def _conjugate_gradient(apply, rhs: Float32, diagonal: Float32, n_steps: int) -> Float32:
    """A few steps towards A x = rhs, with a Jacobi preconditioner; fewer once the residual has shrunk to a tenth."""
    x = np.zeros_like(rhs)
    r = rhs.copy()
    z = r / diagonal
    d = z.copy()
    rz = float(r @ z)
    limit = 0.01 * rz
    for _ in range(n_steps):
        if rz <= 0.0:
            break
        q = apply(d)
        alpha = rz / float(d @ q)
        x += np.float32(alpha) * d
        r -= np.float32(alpha) * q
        z = r / diagonal
        rz, last = float(r @ z), rz
        if rz <= limit:
            break
        d = z + np.float32(rz / last) * d
    return x


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _terms(f, y, c, least):
    """(N,) first derivative of each row's loss in f, and (N,) a curvature with which no step overshoots."""
    residual = np.empty(len(f), np.float32)
    curvature = np.empty(len(f), np.float32)
    _terms_of(f, y, c, least, residual, curvature)
    return residual, curvature


@inner_loop
def _terms_of(f, y, c, least, residual, curvature):
    one, half = np.float32(1), np.float32(0.5)
    for i in range(len(f)):
        x = f[i]
        e = exp32(-abs(x))
        s = one / (one + e)
        p = s if x >= 0 else e * s
        residual[i] = c[i] * (p - y[i])
        is_right = y[i] > half if x > 0 else y[i] < half
        is_far = abs(x) > np.float32(0.01)
        bound = (p - half) / (x if is_far else one)
        q = bound if is_far and not is_right else p * (one - p)
        curvature[i] = c[i] * max(q, least)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _loss(f, change, size, y, c):
    """Sum of the rows' losses at f + size * change, nats."""
    total = 0.0
    for i in range(0, len(f), _AT_ONCE):
        j = i + _AT_ONCE
        total += np.float64(_loss_of(f[i:j], change[i:j], size, y[i:j], c[i:j]))
    return total


@inner_loop
def _loss_of(f, change, size, y, c):
    total = np.float32(0)
    for i in range(len(f)):
        x = f[i] + size * change[i]
        t = exp32(-abs(x))
        log = _LOG1P[8]
        for k in range(7, -1, -1):
            log = log * t + _LOG1P[k]
        total += c[i] * (max(x, np.float32(0)) - y[i] * x + log * t)
    return total
