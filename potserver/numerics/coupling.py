"""Entropic optimal transport between point sets (paper eq. 3-4), many ragged problems at once.

    P* = argmin_P  <P, D> - reg * r(P),   D_ij = |x_i - y_j|^2,   rows of P sum to 1/n, columns to 1/m

(the paper's lambda is 1/reg). `sinkhorn` has the solver. A solve says how it ended; the caller decides what to do with one that
did not converge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from potserver.errors import EmptyError, ShapeError
from potserver.numerics.arrays import Bool, Float32, Int64
from potserver.numerics.sinkhorn import Workspace, solve_pairs
from potserver.numerics.threads import parallel_map


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

    @property
    def largest(self) -> int:
        """Points of the largest set; 0 without sets."""
        return int(np.diff(self.offsets).max(initial=0))

    def set(self, i: int) -> Float32:
        """(N_i, 3) m: one of the sets, a view."""
        return self.points[self.offsets[i] : self.offsets[i + 1]]


class CouplingCosts(NamedTuple):
    """How each problem of a batch ended."""

    cost: Float32  # (P,) <P, D>, m^2: the squared 2-Wasserstein distance under the entropic plan
    marginal_error: Float32  # (P,) L1 distance of the column sums from 1/m (row sums are exact)
    n_iterations: Int64  # (P,)
    converged: Bool  # (P,) marginal_error <= tolerance within max_iterations

    @staticmethod
    def room(n: int) -> CouplingCosts:
        """Arrays for n problems, to be filled."""
        cost, marginal_error = np.empty(n, np.float32), np.empty(n, np.float32)
        return CouplingCosts(cost, marginal_error, np.empty(n, np.int64), np.empty(n, np.bool_))


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
    costs, regs = CouplingCosts.room(n), np.empty(n, np.float32)

    def run(start: int) -> None:
        solve_pairs(
            sources.points, sources.offsets, targets.points, targets.offsets, pairs, start, stride, np.float32(reg),
            relative, np.float32(tolerance), max_iterations, Workspace.of(sources.largest, targets.largest), costs, regs,
        )  # fmt: skip

    stride = max(1, min(n, 8 * threads))
    parallel_map(run, range(stride if n else 0), threads)
    # checked again here: fast-math code may take a NaN for a number
    finite = np.isfinite(costs.cost) & np.isfinite(costs.marginal_error)
    return costs._replace(converged=costs.converged & finite)


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
    Source: paper eq. 3-4; Cuturi 2013.
    """
    _check_reg(reg)
    x, y = Ragged.of([source]), Ragged.of([target])
    n, m = x.largest, y.largest
    work, costs, regs = Workspace.of(n, m), CouplingCosts.room(1), np.empty(1, np.float32)
    solve_pairs(
        x.points, x.offsets, y.points, y.offsets, np.zeros((1, 2), np.int64), 0, 1, np.float32(reg), relative,
        np.float32(tolerance), max_iterations, work, costs, regs,
    )  # fmt: skip
    plan, f, g = work.kernel.reshape(n, m), work.f, work.g
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of a solve that failed
        plan *= work.u[:, None] / np.float32(n)
        plan *= work.v[None, :] / np.float32(m)
        f += regs[0] * np.log(work.u)
        g += regs[0] * np.log(work.v)
    # checked again here: fast-math code may take a NaN for a number
    finite = all(bool(np.isfinite(a).all()) for a in (costs.cost, costs.marginal_error, f, g, plan))
    return Coupling(
        plan, float(costs.cost[0]), f, g, float(regs[0]), float(costs.marginal_error[0]),
        int(costs.n_iterations[0]), bool(costs.converged[0]) and finite,
    )  # fmt: skip


def _check_reg(reg: float) -> None:
    if not (reg > 0 and math.isfinite(reg)):
        raise ValueError(f"reg is {reg}, need a positive number")
