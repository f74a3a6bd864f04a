"""Sums over many squared-exponential kernels, with each point looking only at the kernels that reach it.

    latent mean  sum_m w_m phi_m(x),   latent variance  sum_m v_m phi_m(x)^2,   activation  sum_m known_m phi_m(x)
    phi_m(x) = exp(-gamma_m |x - h_m|^2)                                                        (paper eq. 1)
    known_m = max(0, 1 - v_m / prior variance): a kernel that no data have touched activates nothing

A kernel reaches as far as what it adds is above a cut tau; that depends on its gamma, weight and variance. tau is found by
measuring: at sample points, all that is cut together may change the probability by less than a budget. Kernels are sorted into
levels by reach, a factor of two each, and every level into its own grid of cells, so that wide and narrow ones cost the same.
Points are sorted into cubes. The kernels that reach a cube are gathered once (`gathering`), and a dense SIMD loop runs over
points times kernels.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple

import numba as nb
import numpy as np

from potschemas.answers import LatentSums
from potserver.numerics.arrays import Float32, Float64, Floats, Int64
from potserver.numerics.cubes import sort_into_cubes
from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.gathering import kernels_around
from potserver.numerics.geometry import bounds, inside_box
from potserver.numerics.threads import parallel_map, spans
from potserver.numerics.voxel_hash import empty_table, enter

_PROBABILITY_BUDGET = 4e-5  # by which all cut kernels together may change a probability
_TAUS = np.logspace(-3, -12, 10)  # the cuts to choose from
_SAMPLES = 96  # points at which cuts are measured
_FRINGE = 25.0  # the largest gamma d^2 of a sample
_STACK = 4.0  # kernels within a width of each other, from which on their reach grows
_TARGET_QUERIES_PER_CUBE = 24  # points a cube, on average, at least
_PART_CUBE_M = 10.0  # a third of the edge of the cubes whose points ask the parts of a map together
_WORTH_THREADS = 4096  # points; with fewer one thread is as fast as several


class KernelIndex(NamedTuple):
    """K kernels sorted by level and cell. Immutable; any number of threads may query it."""

    hinge: Float64  # (K, 3) m
    columns: Float32  # (5, K): -gamma 1/m^2, w, v, reach m, known
    order: Int64  # (K,) number of each kernel in the arrays that the index was built from
    level_start: Int64  # (L + 1,) first kernel of each level
    level_edge: Float64  # (L,) m, cell edge; no kernel of the level reaches farther
    level_cell: Int64  # (L, 3) cell of the level's lower corner
    level_size: Int64  # (L, 3) cells along each axis
    keys: Int64  # (K,) cell number inside its level, ascending within a level
    tau: float  # the cut
    median_reach_m: float
    lower: Float64  # (3,) m: outside this box no kernel is reached; empty without kernels
    upper: Float64


def reach(gamma: Float64, weight: Float64, variance: Float64, tau: float, activation_cut: float) -> Float64:
    """(K,) m: where |w| phi < tau, v phi^2 < tau and phi < activation_cut all hold."""
    return np.sqrt(_log_reach(weight, variance, tau, activation_cut) / gamma)


def _log_reach(weight: Float64, variance: Float64, tau: float, activation_cut: float) -> Float64:
    with np.errstate(divide="ignore"):
        log_ratio = np.maximum(np.log(np.abs(weight) / tau), 0.5 * np.log(variance / tau))
    return np.maximum(log_ratio, -np.log(activation_cut))


def choose_tau(hinge: Float64, gamma: Float64, weight: Float64, variance: Float64) -> float:
    """The largest cut that keeps the probability within budget at sample points.

    |dp| <= sum_cut |w| phi / (4 sqrt(1 + pi s2 / 8)) + 0.05 sum_cut v phi^2: the sigmoid's slope is at most 1/4, and the
    probit scaling's derivative in s2 is below 0.05 everywhere. The samples lie inside kernels and at their fringes, where
    what is cut begins.
    """
    rng = np.random.default_rng(0)
    # of few kernels each is sampled several times: where one sample lies must not decide
    pick = rng.choice(len(hinge), _SAMPLES, replace=len(hinge) < _SAMPLES)
    distance2 = np.where(
        np.arange(len(pick)) % 2 == 0, rng.chisquare(3, len(pick)) / 2.0, rng.uniform(0.0, _FRINGE, len(pick))
    )
    away = rng.normal(0.0, 1.0, (len(pick), 3))
    points = hinge[pick] + away * np.sqrt(distance2 / gamma[pick] / np.square(away).sum(axis=1))[:, None]
    cut_mean, cut_var, total_var = _cut_sums(points, hinge, gamma, np.abs(weight), variance, _TAUS)
    change = cut_mean / (4.0 * np.sqrt(1.0 + np.pi / 8.0 * total_var[:, None])) + 0.05 * cut_var
    within = change.max(axis=0) <= _PROBABILITY_BUDGET
    return float(_TAUS[np.argmax(within)] if within.any() else _TAUS[-1])


def stack_sizes(hinge: Float64, gamma: Float64) -> Float64:
    """(K,) about how many kernels of a kernel's own width lie within that width of it, itself included.

    Where many kernels lie on one spot (a robot that stands still, maps that are concatenated), each may fall below a cut while
    their sum does not. The samples of `choose_tau` may miss such a stack.
    """
    level = np.rint(0.5 * np.log2(gamma))
    cell = np.floor(hinge * np.exp2(level)[:, None])
    # one number a cell is faster than three; a rare collision widens a reach
    key = (cell @ np.array([1.0, 7919.0, 104729.0]) + 15485863.0 * level).astype(np.int64)
    return np.asarray(_times_there(key, empty_table(len(key))), np.float64)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _times_there(key, table):
    """(K,) how often each key is among them."""
    keys, count = np.empty(len(key), np.int64), np.zeros(len(key), np.int64)
    entry = np.empty(len(key), np.int64)
    n = 0
    for i in range(len(key)):
        entry[i] = enter(table, keys, n, key[i])
        n = max(n, entry[i] + 1)
        count[entry[i]] += 1
    return count[entry]


def build_index(
    hinge: Float64,
    gamma: Floats,
    weight: Floats,
    variance: Floats,
    *,
    activation_cut: float,
    prior_var: float = math.inf,
    tau: float | None = None,
    guard_stacks: bool = True,
) -> KernelIndex:
    """Sort kernels for fast sums.

    Args:
        hinge: (K, 3) float64, m.
        gamma: (K,) 1/m^2, > 0.
        weight: (K,) log-odds.
        variance: (K,) log-odds^2, >= 0.
        activation_cut: phi below this is left out of the activation sum too.
        prior_var: log-odds^2, variance of a weight of which nothing is known; all counts as known by default.
        tau: The cut, if it is known already; measured otherwise.
        guard_stacks: Let kernels reach farther where many lie on one spot, see `stack_sizes`.
    """
    hinge = np.ascontiguousarray(hinge, np.float64)
    gamma, weight, variance = (np.asarray(a, np.float64) for a in (gamma, weight, variance))
    if tau is None:
        tau = choose_tau(hinge, gamma, weight, variance) if len(hinge) else float(_TAUS[0])
    exponent = _log_reach(weight, variance, tau, activation_cut)
    if guard_stacks:
        exponent += np.log(np.maximum(stack_sizes(hinge, gamma) / _STACK, 1.0))
    r = np.sqrt(exponent / gamma)
    # each level has half the reach of the one above; all kernels of tiny reach share the last one
    top = float(r.max(initial=1e-3))
    level = np.clip(np.ceil(np.log2(np.maximum(r, 1e-6) / top)).astype(np.int64), -12, 0)
    used = np.unique(level)[::-1]
    starts, edges, corners, sizes, keys, order = [0], [], [], [], [], []
    for number in used:
        members = np.flatnonzero(level == number)
        edge = max(top * 2.0 ** float(number), 1e-3)
        cell = np.floor(hinge[members] / edge).astype(np.int64)
        corner, last = bounds(cell)
        size = last - corner + 1
        cell -= corner
        key = (cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0]
        by_key = np.argsort(key, kind="stable")
        order.append(members[by_key])
        keys.append(key[by_key])
        edges.append(edge)
        corners.append(corner)
        sizes.append(size)
        starts.append(starts[-1] + len(members))
    lower, upper = bounds(hinge) if len(hinge) else (np.full(3, np.inf), np.full(3, -np.inf))
    permutation = np.concatenate(order) if order else np.zeros(0, np.int64)
    known = np.maximum(1.0 - variance / prior_var, 0.0)
    columns = np.stack([-gamma, weight, variance, r, known])[:, permutation].astype(np.float32)
    return KernelIndex(
        hinge=hinge[permutation],
        columns=np.ascontiguousarray(columns),
        order=permutation.astype(np.int64),
        level_start=np.asarray(starts, np.int64),
        level_edge=np.asarray(edges, np.float64),
        level_cell=np.asarray(corners, np.int64).reshape(-1, 3),
        level_size=np.asarray(sizes, np.int64).reshape(-1, 3),
        keys=np.concatenate(keys) if keys else np.zeros(0, np.int64),
        tau=tau,
        median_reach_m=_median(r) if len(r) else 1.0,
        lower=lower - top,
        upper=upper + top,
    )


def _median(values: Float64) -> float:
    """As numpy's, whose checks take longer than its work on few values."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    middle = np.partition(values, (low, high))
    return float(0.5 * (middle[low] + middle[high]))


def latent_sums(index: KernelIndex, points: Float64, *, threads: int = 1, lane: str = "map") -> LatentSums:
    """Evaluate the kernels of an index.

    Args:
        points: (N, 3) float64, m, same frame as the hinges.
        threads: Threads to spread the points over.
        lane: See `threads.parallel_map`.
    Returns:
        float32.
    Source: paper eq. 1; variance of a factorised posterior.
    """
    return LatentSums(*sums_by_cube(_sum_cubes, 3, index, points, threads, lane))


def sums_by_cube(
    sum_cubes: Callable[[Float64, Int64, KernelIndex, Float32], None],
    n_sums: int,
    index: KernelIndex,
    points: Float64,
    threads: int,
    lane: str,
) -> Float32:
    """(S, N) sums at N points, by a compiled loop over cubes of points.

    Args:
        sum_cubes: `f(points, cuts, index, out)` writes columns cuts[0] to cuts[-1] of `out`, (S, N); cube c is
            points[cuts[c]:cuts[c + 1]].
        n_sums: S.
        index, points, threads, lane: See `latent_sums`.
    """
    n = len(points)
    out = np.zeros((n_sums, n), np.float32)
    if n == 0 or len(index.hinge) == 0:
        return out
    order, cuts = group_points(points, index.median_reach_m)
    grouped = points[order]
    sums = np.zeros((n_sums, n), np.float32)
    threads = threads if n >= _WORTH_THREADS else 1
    parallel_map(
        lambda span: sum_cubes(grouped, cuts[span[0] : span[1] + 1], index, sums),
        spans(len(cuts) - 1, 4 * threads if threads > 1 else 1), threads, lane,
    )  # fmt: skip
    out[:, order] = sums
    return out


class IndexParts(NamedTuple):
    """Several indices whose sums add: parts of one map, of which only the changed ones were built anew."""

    indices: list[KernelIndex]  # none of them empty
    lower: Float64  # (P, 3) m: outside its box no kernel of a part is reached
    upper: Float64

    @staticmethod
    def of(indices: list[KernelIndex]) -> IndexParts:
        """Parts of a map; empty ones are left out."""
        used = [index for index in indices if len(index.hinge)]
        lower, upper = [index.lower for index in used], [index.upper for index in used]
        return IndexParts(used, np.reshape(lower, (-1, 3)), np.reshape(upper, (-1, 3)))


def latent_sums_of_parts(
    parts: IndexParts, points: Float64, *, threads: int = 1, lane: str = "map"
) -> LatentSums:
    """`latent_sums` over all parts of a map. Points near each other ask together, and they ask only parts that reach them."""
    if len(parts.indices) == 1:
        return latent_sums(parts.indices[0], points, threads=threads, lane=lane)
    total = LatentSums(*np.zeros((3, len(points)), np.float32))
    if len(points) == 0 or not parts.indices:
        return total
    order, cuts, groups = sort_into_cubes(points, _PART_CUBE_M)
    pieces = list(itertools.pairwise(cuts[groups].tolist()))

    def run(span: tuple[int, int]) -> None:
        for a, b in pieces[slice(*span)]:
            members = order[a:b]
            x = points[members]
            lower, upper = bounds(x)
            reached = (parts.lower <= upper).all(axis=1) & (parts.upper >= lower).all(axis=1)
            for number in np.flatnonzero(reached):
                inside = inside_box(x, parts.lower[number], parts.upper[number])
                if inside.any():
                    sums = latent_sums(parts.indices[number], x[inside])
                    for out, part in zip(total, sums, strict=True):
                        out[members[inside]] += part

    # whole pieces to a thread: to share the points of each would cost more than it gains
    threads = threads if len(points) >= _WORTH_THREADS else 1
    parallel_map(run, spans(len(pieces), 4 * threads if threads > 1 else 1), threads, lane)
    return total


def group_points(points: Float64, scale_m: float) -> tuple[Int64, Int64]:
    """Sort points into cubes of about `scale_m`, larger where points are sparse.

    Returns:
        order: (N,) so that `points[order]` has each cube's points together.
        cuts: (C + 1,) where each cube starts.
    """
    edge = 0.5 * scale_m
    lower, upper = bounds(points)
    extent = upper - lower
    while True:
        edge = max(edge, float(extent.max()) / 2**20)  # 21 bits an axis
        cell = ((points - lower) / edge).astype(np.int64)
        key = (cell[:, 2] << 42) | (cell[:, 1] << 21) | cell[:, 0]
        order = np.argsort(key, kind="stable")
        ordered = key[order]
        cuts = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1], [True]]))
        if len(points) >= _TARGET_QUERIES_PER_CUBE * (len(cuts) - 1) or edge >= 1.5 * scale_m:
            return order, cuts.astype(np.int64)
        edge *= 1.8


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _cut_sums(points, hinge, gamma, weight, variance, taus):
    """Float64: for each sample and each tau, the sums that a cut at tau leaves out; and the whole variance."""
    n, k, n_taus = len(points), len(hinge), len(taus)
    cut_mean = np.zeros((n, n_taus))
    cut_var = np.zeros((n, n_taus))
    total = np.zeros(n)
    exponent = np.empty(k)
    for i in range(n):
        x, y, z = points[i]
        for m in range(k):  # apart from what follows, so that the compiler makes SIMD code of it
            dx, dy, dz = x - hinge[m, 0], y - hinge[m, 1], z - hinge[m, 2]
            exponent[m] = gamma[m] * (dx * dx + dy * dy + dz * dz)
        for m in range(k):
            if exponent[m] > 40.0:
                continue
            phi = np.exp(-exponent[m])
            a = weight[m] * phi
            b = variance[m] * phi * phi
            total[i] += b
            for j in range(n_taus):
                if a < taus[j] and b < taus[j]:
                    cut_mean[i, j] += a
                    cut_var[i, j] += b
    return cut_mean, cut_var, total


@inner_loop
def _sum_point(x, y, z, hx, hy, hz, minus_gamma, w, v, known, n):
    mean = np.float32(0)
    var = np.float32(0)
    activation = np.float32(0)
    for m in range(n):
        dx = x - hx[m]
        dy = y - hy[m]
        dz = z - hz[m]
        phi = exp32(minus_gamma[m] * (dx * dx + dy * dy + dz * dz))
        mean += w[m] * phi
        var += v[m] * phi * phi
        activation += known[m] * phi
    return mean, var, activation


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _sum_cubes(points, cuts, index, sums):
    found = np.empty(4096, np.int64)
    local = np.empty((7, 4096), np.float32)
    for cube in range(len(cuts) - 1):
        a, b = cuts[cube], cuts[cube + 1]
        n, found, local, cx, cy, cz = kernels_around(index, points[a:b], found, local)
        for q in range(a, b):
            sums[0, q], sums[1, q], sums[2, q] = _sum_point(
                np.float32(points[q, 0] - cx), np.float32(points[q, 1] - cy), np.float32(points[q, 2] - cz),
                local[0], local[1], local[2], local[3], local[4], local[5], local[6], n,
            )  # fmt: skip
