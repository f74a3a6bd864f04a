"""Compiled Sinkhorn scaling in float32: the loops behind `coupling`.

The potentials f, g are kept apart from the scalings u, v and absorb them whenever these grow large. The regularisation is
reached from above in halvings. At its final value the iteration is over-relaxed, by a factor taken from its own measured
contraction.
Source: Cuturi 2013; stabilisation: Schmitzer 2019; over-relaxation: Lehmann et al. 2021.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float32
from potserver.numerics.fastexp import exp32, inner_loop

_CHECK_EVERY = 5  # iterations between looks at the error
_PLAIN_ITERATIONS = 15  # at the final level, before the contraction is measured
_SWEEPS_PER_LEVEL = 4  # iterations at each level before the last
_FIRST_LEVEL = np.float32(0.02)  # of the largest cost: where the regularisation starts
_ABSORB_ABOVE = np.float32(1e12)  # scaling at which the potentials take the scalings in
_MOST_LEVELS = 60  # halvings of reg on the way to its value


class Workspace(NamedTuple):
    """Memory for problems of at most n source and m target points; what is left in it belongs to the last one solved.

    The plan of an n x m problem is P_ij = K_ij u_i v_j / (n m); the dual potentials are f + reg log(u) and g + reg log(v), m^2.
    """

    kernel: Float32  # (n m,) K, row by row
    f: Float32  # (n,) m^2
    u: Float32  # (n,)
    g: Float32  # (m,) m^2
    v: Float32  # (m,)
    t: Float32  # (m,) scratch

    @staticmethod
    def of(n: int, m: int) -> Workspace:
        """Memory for problems up to n x m."""
        return Workspace(*(np.empty(size, np.float32) for size in (n * m, n, n, m, m, m)))


# The one function that is called from Python: a second one would have its own copy of the loops, which may round otherwise.
@nb.njit(nogil=True, error_model="numpy", cache=True)
def solve_pairs(
    xs, x_offsets, ys, y_offsets, pairs, start, stride, reg, relative, tol, max_iter, work, costs, regs
):
    """Solve every `stride`-th problem from `start` on, and write how each ended.

    Args:
        xs, x_offsets, ys, y_offsets: Sets of source and target points, see `coupling.Ragged`.
        pairs: (P, 2) numbers of the sets of each problem.
        reg, relative, tol, max_iter: See `coupling.coupling_costs`; reg and tol are float32.
        work: A Workspace that is large enough.
        costs: A `coupling.CouplingCosts` of P problems, to be filled.
        regs: (P,) float32, to be filled: the regularisation that was used, m^2.
    """
    for p in range(start, len(pairs), stride):
        x = xs[x_offsets[pairs[p, 0]] : x_offsets[pairs[p, 0] + 1]]
        y = ys[y_offsets[pairs[p, 1]] : y_offsets[pairs[p, 1] + 1]]
        n, m = len(x), len(y)
        regs[p], costs.cost[p], costs.marginal_error[p], costs.n_iterations[p], costs.converged[p] = _solve(
            x, y, reg, relative, tol, max_iter, work.kernel[: n * m].reshape(n, m), work.f[:n], work.g[:m],
            work.u[:n], work.v[:m], work.t[:m],
        )  # fmt: skip


@inner_loop
def _squared_distances(x0, x1, x2, y0, y1, y2, row):
    """One row of D, exactly: no |x|^2 + |y|^2 - 2 x.y, which cancels."""
    for j in range(len(row)):
        a = x0 - y0[j]
        b = x1 - y1[j]
        c = x2 - y2[j]
        row[j] = a * a + b * b + c * c


@inner_loop
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


@inner_loop
def _gibbs(x, y, f, g, inv_eps, kernel):
    for i in range(len(x)):
        row = kernel[i]
        _squared_distances(x[i, 0], x[i, 1], x[i, 2], y[0], y[1], y[2], row)
        _exp_row(row, f[i], g, inv_eps)


@inner_loop
def _exp_row(row, f, g, inv_eps):
    for j in range(len(row)):
        row[j] = exp32((f + g[j] - row[j]) * inv_eps)


@inner_loop
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
        # The error has loops of its own, see `inner_loop`.
        for r in range(rows):
            error += abs(u[first + r] * sums[r] * b - np.float32(1)) * a
        for r in range(rows):
            i = first + r
            s = sums[r] * b
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
        error += abs(v[j] * t[j] * a - np.float32(1)) * b
    for j in range(m):
        tj = t[j] * a
        vj = np.float32(1) / tj if plain else np.exp(-omega * np.log(tj) + keep * np.log(v[j]))
        v[j] = vj
        extreme = max(extreme, max(vj, np.float32(1) / vj))
    return error, extreme


@inner_loop
def _dot(row, v):
    s = np.float32(0)
    for j in range(len(v)):
        s += row[j] * v[j]
    return s


@inner_loop
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


@inner_loop
def _add(row, u, t):
    for j in range(len(t)):
        t[j] += row[j] * u


@inner_loop
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


@nb.njit(nogil=True, error_model="numpy", cache=True, forceinline=True)
def _solve(x, y, reg, relative, tol, max_iter, kernel, f, g, u, v, t):
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
