"""Gradients of the sums that `kernel_index` makes: analytic, over the kernels that reach each point."""

from __future__ import annotations

import numba as nb
import numpy as np

from potschemas.answers import LatentGradients
from potserver.numerics.fastexp import FAST, exp32
from potserver.numerics.kernel_index import (
    Float64,
    KernelIndex,
    _about_middle,
    _box,
    _gather,
    group_points,
)
from potserver.numerics.threads import parallel_map, spans


def latent_gradients(
    index: KernelIndex, points: Float64, *, threads: int = 1, lane: str = "map"
) -> LatentGradients:
    """d/dx of sum w phi, sum v phi^2 and sum phi, with d phi/dx = -2 gamma (x - h) phi.

    Args:
        points: (N, 3) float64, m, same frame as the hinges.
        threads, lane: See `kernel_index.latent_sums`.
    Returns:
        float32.
    """
    n = len(points)
    out = np.zeros((9, n), np.float32)
    if n and len(index.hinge):
        order, cuts = group_points(points, index.median_reach_m)
        grouped = points[order]
        sums = np.zeros((9, n), np.float32)

        def run(span: tuple[int, int]) -> None:
            _gradient_cubes(
                grouped, cuts[span[0] : span[1] + 1], index.hinge, index.columns, index.level_start, index.level_edge,
                index.level_cell, index.level_size, index.keys, sums,
            )  # fmt: skip

        parallel_map(run, spans(len(cuts) - 1, 16 * threads if threads > 1 else 1), threads, lane)
        out[:, order] = sums
    return LatentGradients(*(np.ascontiguousarray(out[i : i + 3].T) for i in (0, 3, 6)))


@nb.njit(nogil=True, fastmath=FAST, error_model="numpy", cache=True)
def _gradient_point(x, y, z, hx, hy, hz, minus_gamma, w, v, n):
    mx = my = mz = np.float32(0)
    vx = vy = vz = np.float32(0)
    ax = ay = az = np.float32(0)
    two = np.float32(2)
    for m in range(n):
        dx = x - hx[m]
        dy = y - hy[m]
        dz = z - hz[m]
        phi = exp32(minus_gamma[m] * (dx * dx + dy * dy + dz * dz))
        slope = two * minus_gamma[m] * phi
        a = w[m] * slope
        b = two * v[m] * slope * phi
        mx += a * dx
        my += a * dy
        mz += a * dz
        vx += b * dx
        vy += b * dy
        vz += b * dz
        ax += slope * dx
        ay += slope * dy
        az += slope * dz
    return mx, my, mz, vx, vy, vz, ax, ay, az


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _gradient_cubes(
    points, cuts, hinge, columns, level_start, level_edge, level_cell, level_size, keys, sums
):
    found = np.empty(4096, np.int64)
    local = np.empty((6, 4096), np.float32)
    lower = np.empty(3)
    upper = np.empty(3)
    for cube in range(len(cuts) - 1):
        a, b = cuts[cube], cuts[cube + 1]
        _box(points, a, b, lower, upper)
        n, found = _gather(
            lower, upper, hinge, columns, level_start, level_edge, level_cell, level_size, keys, found
        )
        local, cx, cy, cz = _about_middle(lower, upper, hinge, columns, found, n, local)
        for q in range(a, b):
            sums[0, q], sums[1, q], sums[2, q], sums[3, q], sums[4, q], sums[5, q], sums[6, q], sums[7, q], sums[
                8, q
            ] = _gradient_point(
                np.float32(points[q, 0] - cx), np.float32(points[q, 1] - cy), np.float32(points[q, 2] - cz),
                local[0], local[1], local[2], local[3], local[4], local[5], n,
            )  # fmt: skip
