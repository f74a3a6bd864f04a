"""Gradients of the sums that `kernel_index` makes: analytic, over the kernels that reach each point."""

from __future__ import annotations

import numba as nb
import numpy as np

from potschemas.answers import LatentGradients
from potserver.numerics.arrays import Float64
from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.gathering import kernels_around
from potserver.numerics.kernel_index import KernelIndex, sums_by_cube


def latent_gradients(
    index: KernelIndex, points: Float64, *, threads: int = 1, lane: str = "map"
) -> LatentGradients:
    """d/dx of sum w phi, sum v phi^2 and sum k phi, with d phi/dx = -2 gamma (x - h) phi.

    Args:
        points: (N, 3) float64, m, same frame as the hinges.
        threads, lane: See `kernel_index.latent_sums`.
    Returns:
        float32.
    """
    out = sums_by_cube(_gradient_cubes, 9, index, points, threads, lane)
    return LatentGradients(*(np.ascontiguousarray(out[i : i + 3].T) for i in (0, 3, 6)))


@inner_loop
def _gradient_point(x, y, z, hx, hy, hz, minus_gamma, w, v, known, n):
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
        c = known[m] * slope
        ax += c * dx
        ay += c * dy
        az += c * dz
    return mx, my, mz, vx, vy, vz, ax, ay, az


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _gradient_cubes(points, cuts, index, sums):
    found = np.empty(4096, np.int64)
    local = np.empty((7, 4096), np.float32)
    for cube in range(len(cuts) - 1):
        a, b = cuts[cube], cuts[cube + 1]
        n, found, local, cx, cy, cz = kernels_around(index, points[a:b], found, local)
        for q in range(a, b):
            sums[0, q], sums[1, q], sums[2, q], sums[3, q], sums[4, q], sums[5, q], sums[6, q], sums[7, q], sums[
                8, q
            ] = _gradient_point(
                np.float32(points[q, 0] - cx), np.float32(points[q, 1] - cy), np.float32(points[q, 2] - cz),
                local[0], local[1], local[2], local[3], local[4], local[5], local[6], n,
            )  # fmt: skip
