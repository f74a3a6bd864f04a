"""Entropic optimal transport between point sets (paper eq. 3-4), many ragged problems at once.

    P* = argmin_P  <P, D> - reg * r(P),   D_ij = |x_i - y_j|^2,   rows of P sum to 1/n, columns to 1/m

(the paper's lambda is 1/reg). Sinkhorn scaling in float32, stabilised: the potentials are kept apart from the scalings and
absorbed whenever those grow, reg is reached from above in halvings, and the final level is over-relaxed with a factor taken
from its own measured contraction. A solve says how it ended; the caller decides what to do with one that did not converge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.errors import EmptyError, ShapeError
from potserver.numerics.fastexp import FAST, exp32
from potserver.numerics.threads import parallel_map

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

_CHECK_EVERY = 5
_PLAIN_ITERATIONS = 15  # at the final level, before the contraction is measured
_SWEEPS_PER_LEVEL = 4
_FIRST_LEVEL = np.float32(0.02)  # of the largest cost: where the regularisation starts
_ABSORB_ABOVE = np.float32(1e12)
_MOST_LEVELS = 60  # halvings of reg on the way to its value


class Ragged(NamedTuple):
    """Point sets of unequal size, one after the other."""

    points: Float32  # (sum of sizes, 3) m
    offsets: Int64  # (n_sets + 1,)

    @staticmethod
    def of(sets: list[Float32]) -> Ragged:
        """Pack point sets.

        Raises:
            ShapeError: a set is not (N, 3).
            EmptyError: a set has no points; a coupling of nothing does not exist.
        """
        for points in sets:
            if points.ndim != 2 or points.shape[1] != 3:
                raise ShapeError(f"a point set has shape {points.shape}, need (N, 3)")
            if len(points) == 0:
                raise EmptyError("a point set is empty: it has no coupling")
        offsets = np.concatenate([[0], np.cumsum([len(p) for p in sets])]).astype(np.int64)
        packed = np.concatenate(sets) if sets else np.zeros((0, 3))
        return Ragged(np.ascontiguousarray(packed, np.float32), offsets)

    def __len__(self) -> int:  # number of sets, not of fields
        return len(self.offsets) - 1

    def set(self, i: int) -> Float32:
        """(N_i, 3) m: one of the sets, a view."""
        return self.points[self.offsets[i] : self.offsets[i + 1]]


class CouplingCosts(NamedTuple):
    """How each problem of a batch ended."""

    cost: Float32  # (P,) <P, D>, m^2: the squared 2-Wasserstein distance under the entropic plan
    marginal_error: Float32  # (P,) L1 distance of the column sums from 1/m (row sums are exact)
    n_iterations: Int64  # (P,)
    converged: NDArray[np.bool_]  # (P,) marginal_error <= tolerance within max_iterations


class Coupling(NamedTuple):
    """One solved problem with its plan."""

    plan: Float32  # (n, m), sums to 1
    cost: float  # <P, D>, m^2
    source_potential: Float32  # (n,) m^2, dual f: P_ij = exp((f_i + g_j - D_ij) / reg) / (n m)
    target_potential: Float32  # (m,) m^2, dual g
    reg: float  # m^2, the regularisation that was used
    marginal_error: float
    n_iterations: int
    converged: bool


def coupling_costs(
    sources: Ragged,
    targets: Ragged,
    pairs: Int64,
    *,
    reg: float,
    relative: bool = False,
    tolerance: float = 1e-5,
    max_iterations: int = 1000,
    threads: int = 1,
) -> CouplingCosts:
    """Solve eq. 4 for many (source, target) pairs; the plans are not kept.

    Args:
        sources: S point sets, m.
        targets: T point sets, m, in the same frame.
        pairs: (P, 2) int64, source and target numbers.
        reg: Weight of the entropy, m^2; a fraction of each problem's largest cost if `relative`.
        relative: See `reg`.
        tolerance: L1 marginal error at which a solve counts as converged.
        max_iterations: Scaling iterations at most.
        threads: Threads to spread the problems over.
    Returns:
        Costs in m^2, with the way each solve ended.
    Raises:
        ValueError: reg is not positive.
        ShapeError: pairs is not (P, 2) or names a set that is not there.
    Source: paper eq. 3-4 and 6; Cuturi 2013.
    """
    _check_reg(reg)
    pairs = np.ascontiguousarray(pairs, np.int64)
    if pairs.ndim != 2 or pairs.shape[1] != 2:
        raise ShapeError(f"pairs: {pairs.shape}, need (P, 2)")
    if len(pairs) and (
        pairs.min() < 0 or pairs[:, 0].max() >= len(sources) or pairs[:, 1].max() >= len(targets)
    ):
        raise ShapeError(f"pairs names a set beyond {len(sources)} sources or {len(targets)} targets")
    n = len(pairs)
    cost, error = np.empty(n, np.float32), np.empty(n, np.float32)
    iterations, converged = np.empty(n, np.int64), np.empty(n, np.bool_)

    def run(start: int) -> None:
        _solve_pairs(
            sources.points, sources.offsets, targets.points, targets.offsets, pairs, start, stride,
            np.float32(reg), relative, np.float32(tolerance), max_iterations, cost, error, iterations, converged,
        )  # fmt: skip

    stride = max(1, min(n, 8 * threads))
    parallel_map(run, range(stride if n else 0), threads)
    # asked here once more: compiled with fast-math, the solver itself may take a NaN for a number
    converged &= np.isfinite(cost) & np.isfinite(error)
    return CouplingCosts(cost, error, iterations, converged)


def couple(
    source: Float32,
    target: Float32,
    *,
    reg: float,
    relative: bool = True,
    tolerance: float = 1e-4,
    max_iterations: int = 2000,
) -> Coupling:
    """Solve eq. 4 once and keep the plan and its dual potentials.

    Args:
        source: (n, 3) m.
        target: (m, 3) m, same frame.
        reg: Weight of the entropy, as a fraction of the largest cost; m^2 unless `relative`.
        relative: See `reg`.
        tolerance: L1 marginal error at which the solve counts as converged.
        max_iterations: Scaling iterations at most.
    Raises:
        ValueError: reg is not positive.
        ShapeError, EmptyError: a set is not (N, 3) or has no points.
    Source: paper eq. 3-4; Cuturi 2013; over-relaxation: Lehmann et al. 2021.
    """
    _check_reg(reg)
    x, y = Ragged.of([source]).points, Ragged.of([target]).points
    kernel = np.empty((len(x), len(y)), np.float32)
    f, g = np.empty(len(x), np.float32), np.empty(len(y), np.float32)
    u, v, t = np.empty(len(x), np.float32), np.empty(len(y), np.float32), np.empty(len(y), np.float32)
    eps, cost, error, iterations, converged = _sinkhorn(
        x, y, np.float32(reg), relative, np.float32(tolerance), max_iterations, kernel, f, g, u, v, t
    )
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of a solve that failed
        kernel *= u[:, None] / np.float32(len(x))
        kernel *= v[None, :] / np.float32(len(y))
        f += eps * np.log(u)
        g += eps * np.log(v)
    # asked here once more: compiled with fast-math, the solver itself may take a NaN for a number
    converged = converged and all(bool(np.isfinite(a).all()) for a in (cost, error, f, g, kernel))
    return Coupling(kernel, float(cost), f, g, float(eps), float(error), int(iterations), bool(converged))


def _check_reg(reg: float) -> None:
    if not (reg > 0 and math.isfinite(reg)):
        raise ValueError(f"reg is {reg}, need a positive number")


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _solve_pairs(
    xs, x_offsets, ys, y_offsets, pairs, start, stride, reg, relative, tol, max_iter, cost, error, its, ok
):
    n_max = 0
    m_max = 0
    for p in range(start, len(pairs), stride):
        n_max = max(n_max, x_offsets[pairs[p, 0] + 1] - x_offsets[pairs[p, 0]])
        m_max = max(m_max, y_offsets[pairs[p, 1] + 1] - y_offsets[pairs[p, 1]])
    store = np.empty(n_max * m_max, np.float32)
    f = np.empty(n_max, np.float32)
    u = np.empty(n_max, np.float32)
    g = np.empty(m_max, np.float32)
    v = np.empty(m_max, np.float32)
    t = np.empty(m_max, np.float32)
    for p in range(start, len(pairs), stride):
        x = xs[x_offsets[pairs[p, 0]] : x_offsets[pairs[p, 0] + 1]]
        y = ys[y_offsets[pairs[p, 1]] : y_offsets[pairs[p, 1] + 1]]
        n, m = len(x), len(y)
        kernel = store[: n * m].reshape(n, m)
        _, cost[p], error[p], its[p], ok[p] = _sinkhorn(
            x, y, reg, relative, tol, max_iter, kernel, f[:n], g[:m], u[:n], v[:m], t[:m]
        )


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _squared_distances(x0, x1, x2, y0, y1, y2, row):
    """One row of D, exactly: no |x|^2 + |y|^2 - 2 x.y, which cancels."""
    for j in range(len(row)):
        a = x0 - y0[j]
        b = x1 - y1[j]
        c = x2 - y2[j]
        row[j] = a * a + b * b + c * c


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _start_potentials(x, y, f, g, row):
    """f = row minima of D, then g = column minima of D - f: every row and column of exp((f + g - D)/eps) then holds a 1.

    Returns the largest cost.
    """
    n, m = len(x), len(row)
    largest = np.float32(0)
    for i in range(n):
        _squared_distances(x[i, 0], x[i, 1], x[i, 2], y[0], y[1], y[2], row)
        low = row[0]
        for j in range(m):
            low = min(low, row[j])
            largest = max(largest, row[j])
        f[i] = low
        for j in range(m):
            slack = row[j] - low
            g[j] = slack if i == 0 else min(g[j], slack)
    return largest


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _gibbs(x, y, f, g, inv_eps, kernel):
    for i in range(len(x)):
        row = kernel[i]
        _squared_distances(x[i, 0], x[i, 1], x[i, 2], y[0], y[1], y[2], row)
        _exp_row(row, f[i], g, inv_eps)


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _exp_row(row, f, g, inv_eps):
    for j in range(len(row)):
        row[j] = exp32((f + g[j] - row[j]) * inv_eps)


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _iterate(kernel, u, v, t, omega):
    """One relaxed scaling iteration in one pass over K; returns the L1 marginal errors before it and the largest scaling.

    Four rows at a time, so that v and t are read and written once for four of them.
    """
    n, m = kernel.shape
    a = np.float32(1.0) / np.float32(n)
    b = np.float32(1.0) / np.float32(m)
    plain = omega == np.float32(1)
    keep = np.float32(1) - omega
    error = np.float32(0)
    extreme = np.float32(1)
    for j in range(m):
        t[j] = np.float32(0)
    sums = np.empty(4, np.float32)
    for first in range(0, n, 4):
        rows = min(4, n - first)
        if rows == 4:
            _dot_four(kernel[first], kernel[first + 1], kernel[first + 2], kernel[first + 3], v, sums)
        else:
            for r in range(rows):
                sums[r] = _dot(kernel[first + r], v)
        for r in range(rows):
            i = first + r
            s = sums[r] * b
            error += abs(u[i] * s - np.float32(1)) * a
            ui = np.float32(1) / s if plain else np.exp(-omega * np.log(s) + keep * np.log(u[i]))
            u[i] = ui
            extreme = max(extreme, max(ui, np.float32(1) / ui))
        if rows == 4:
            _add_four(
                kernel[first], kernel[first + 1], kernel[first + 2], kernel[first + 3],
                u[first], u[first + 1], u[first + 2], u[first + 3], t,
            )  # fmt: skip
        else:
            for r in range(rows):
                _add(kernel[first + r], u[first + r], t)
    for j in range(m):
        tj = t[j] * a
        error += abs(v[j] * tj - np.float32(1)) * b
        vj = np.float32(1) / tj if plain else np.exp(-omega * np.log(tj) + keep * np.log(v[j]))
        v[j] = vj
        extreme = max(extreme, max(vj, np.float32(1) / vj))
    return error, extreme


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _dot(row, v):
    s = np.float32(0)
    for j in range(len(v)):
        s += row[j] * v[j]
    return s


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _dot_four(row0, row1, row2, row3, v, sums):
    s0 = np.float32(0)
    s1 = np.float32(0)
    s2 = np.float32(0)
    s3 = np.float32(0)
    for j in range(len(v)):
        s0 += row0[j] * v[j]
        s1 += row1[j] * v[j]
        s2 += row2[j] * v[j]
        s3 += row3[j] * v[j]
    sums[0], sums[1], sums[2], sums[3] = s0, s1, s2, s3


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _add(row, u, t):
    for j in range(len(t)):
        t[j] += row[j] * u


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _add_four(row0, row1, row2, row3, u0, u1, u2, u3, t):
    for j in range(len(t)):
        t[j] += row0[j] * u0 + row1[j] * u1 + row2[j] * u2 + row3[j] * u3


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _absorb(u, v, f, g, eps):
    for i in range(len(u)):
        f[i] += eps * np.log(u[i])
        u[i] = np.float32(1)
    for j in range(len(v)):
        g[j] += eps * np.log(v[j])
        v[j] = np.float32(1)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _sinkhorn(x, y, reg, relative, tol, max_iter, kernel, f, g, u, v, t):
    """Solve one problem in the given workspace; on return P_ij = K_ij u_i v_j / (n m)."""
    n, m = len(x), len(y)
    columns = np.ascontiguousarray(y.T)  # (3, m): the inner loops run over targets
    largest = _start_potentials(x, columns, f, g, t)
    eps = reg * largest if relative else reg
    if eps <= np.float32(0):  # one point, or all on one spot: every plan costs the same
        eps = np.float32(1)
    # levels are counted: with costs that overflow, a comparison of floats under fast-math might never end the loop
    level = eps
    levels = 0
    while levels < _MOST_LEVELS and level < _FIRST_LEVEL * largest:
        level *= np.float32(2)
        levels += 1
    u[:] = np.float32(1)
    v[:] = np.float32(1)
    its = 0
    while True:
        final = levels == 0
        _gibbs(x, columns, f, g, np.float32(1) / level, kernel)
        if not final:
            for _ in range(min(_SWEEPS_PER_LEVEL, max_iter - its)):
                _, extreme = _iterate(kernel, u, v, t, np.float32(1))
                its += 1
                if extreme > _ABSORB_ABOVE:
                    break
            _absorb(u, v, f, g, level)
            levels -= 1
            level = eps if levels == 0 else level * np.float32(0.5)
            continue
        omega = np.float32(1)
        error = np.float32(np.inf)
        best = np.float32(np.inf)
        earlier = np.float32(0)
        count = 0
        while its < max_iter:
            error, extreme = _iterate(kernel, u, v, t, omega)
            its += 1
            count += 1
            if not np.isfinite(error):
                break
            if extreme > _ABSORB_ABOVE:
                _absorb(u, v, f, g, eps)
                _gibbs(x, columns, f, g, np.float32(1) / eps, kernel)
            if count % _CHECK_EVERY == 0:
                if error <= np.float32(0.7) * tol:
                    break
                if count == _PLAIN_ITERATIONS - _CHECK_EVERY:
                    earlier = error
                elif count == _PLAIN_ITERATIONS and error < earlier:
                    # plain Sinkhorn contracts by eta an iteration; the best relaxation is 2 / (1 + sqrt(1 - eta))
                    eta = (error / earlier) ** np.float32(1.0 / _CHECK_EVERY)
                    omega = min(
                        np.float32(2) / (np.float32(1) + np.sqrt(np.float32(1) - eta)), np.float32(1.95)
                    )
                elif count > _PLAIN_ITERATIONS and error > np.float32(4) * best:
                    omega = np.float32(1) + np.float32(0.5) * (omega - np.float32(1))
                    best = error
                best = min(best, error)
        break
    # exact rows, then the error of the columns is the error of the plan
    cost = np.float32(0)
    for j in range(m):
        t[j] = np.float32(0)
    a = np.float32(1.0) / np.float32(n)
    b = np.float32(1.0) / np.float32(m)
    for i in range(n):
        s = np.float32(0)
        for j in range(m):
            s += kernel[i, j] * v[j]
        u[i] = np.float32(m) / s
        c = np.float32(0)
        for j in range(m):
            q = kernel[i, j] * u[i]
            t[j] += q
            d0 = x[i, 0] - y[j, 0]
            d1 = x[i, 1] - y[j, 1]
            d2 = x[i, 2] - y[j, 2]
            c += q * v[j] * (d0 * d0 + d1 * d1 + d2 * d2)
        cost += c * a * b
    error = np.float32(0)
    for j in range(m):
        error += abs(v[j] * t[j] * a - np.float32(1)) * b
    ok = np.isfinite(error) and np.isfinite(cost) and error <= tol
    return eps, cost, error, its, ok
