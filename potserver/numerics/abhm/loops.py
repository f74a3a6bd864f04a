"""Compiled loops of the ABHM learner: log-likelihood, gradient and curvature over points in cubes.

`block` is a `feature_blocks.Block`, of which only the lists of kernels are used; `columns` is (5, K) float32: hinge x, y, z (m,
relative to the corner of the points), gamma (1/m^2) and weight (log-odds) of each kernel.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.fastexp import exp32, inner_loop
from potserver.numerics.feature_blocks import widest


# The inner loops get slices, so that the compiler makes SIMD code of them; see feature_blocks.py.
@inner_loop
def latent(x, y, z, hx, hy, hz, g, w, phi, d2):
    """f at one point. What the gradient needs as well is written to `phi` and `d2`, (K,): activations and squared distances."""
    for i in range(len(phi)):
        dx, dy, dz = x - hx[i], y - hy[i], z - hz[i]
        q = dx * dx + dy * dy + dz * dz
        d2[i] = q
        phi[i] = exp32(-g[i] * q)
    # a loop of its own, see `inner_loop`
    f = np.float32(0)
    for i in range(len(phi)):
        f += w[i] * phi[i]
    return f


@inner_loop
def _add_gradient(residual, x, y, z, hx, hy, hz, g, w, phi, d2, by_x, by_y, by_z, by_g, by_w):
    """Add one point's gradient to those by hinges, gammas and weights."""
    for i in range(len(phi)):
        t = residual * phi[i]
        by_w[i] += t
        t *= w[i]
        by_g[i] -= t * d2[i]
        t *= np.float32(2) * g[i]
        by_x[i] += t * (x - hx[i])
        by_y[i] += t * (y - hy[i])
        by_z[i] += t * (z - hz[i])


@nb.njit(nogil=True, error_model="numpy", cache=True)
def gradient(x, occupied, count, block, columns, first, stride, negligible):
    """Sum of count * log-likelihood over some points of each cube, and its gradient (5, K) in `columns`.

    Args:
        x: (3, N) float32 m, relative to the corner, in the blocks' order.
        occupied, count: (N,) labels and weights, likewise.
        block, columns: See the module.
        first, stride: (C,) of cube c the points first[c], first[c] + stride, ... are taken.
        negligible: Points whose residual is smaller are left out of the gradient.
    """
    cuts, kernels, numbers = block.cuts, block.kernels, block.numbers
    out = np.zeros(columns.shape, np.float32)
    most = widest(kernels)
    near, by = np.empty((5, most), np.float32), np.empty((5, most), np.float32)
    phi_of, d2_of = np.empty(most, np.float32), np.empty(most, np.float32)
    total = 0.0
    for c in range(len(cuts) - 1):
        if cuts[c] + first[c] >= cuts[c + 1]:
            continue
        at, n = kernels[c], kernels[c + 1] - kernels[c]
        for i in range(n):
            m = numbers[at + i]
            for row in range(5):
                near[row, i] = columns[row, m]
        by[:, :n] = 0
        hx, hy, hz, g, w = near[0, :n], near[1, :n], near[2, :n], near[3, :n], near[4, :n]
        phi, d2 = phi_of[:n], d2_of[:n]
        for r in range(cuts[c] + first[c], cuts[c + 1], stride):
            f = latent(x[0, r], x[1, r], x[2, r], hx, hy, hz, g, w, phi, d2)
            margin = f if occupied[r] else -f
            small = exp32(-abs(margin))
            total += count[r] * (min(margin, np.float32(0)) - np.log1p(small))
            wrong = small / (np.float32(1) + small) if margin > 0 else np.float32(1) / (np.float32(1) + small)
            residual = count[r] * (wrong if occupied[r] else -wrong)
            if abs(residual) >= negligible:
                _add_gradient(
                    residual, x[0, r], x[1, r], x[2, r], hx, hy, hz, g, w, phi, d2,
                    by[0, :n], by[1, :n], by[2, :n], by[3, :n], by[4, :n],
                )  # fmt: skip
        for i in range(n):
            m = numbers[at + i]
            for row in range(5):
                out[row, m] += by[row, i]
    return total, out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def curvatures(x, count, block, columns):
    """Gauss-Newton curvature (4, K) of the log-likelihood: in each hinge coordinate, 1/m^2, and in each log gamma.

    Args:
        x, count, block, columns: See `gradient`.
    """
    cuts, kernels, numbers = block.cuts, block.kernels, block.numbers
    out = np.zeros((4, columns.shape[1]), np.float32)
    for c in range(len(cuts) - 1):
        at, n = kernels[c], kernels[c + 1] - kernels[c]
        near = np.empty((5, n), np.float32)
        for i in range(n):
            for row in range(5):
                near[row, i] = columns[row, numbers[at + i]]
        phi, d2 = np.empty(n, np.float32), np.empty(n, np.float32)
        for r in range(cuts[c], cuts[c + 1]):
            f = latent(x[0, r], x[1, r], x[2, r], near[0], near[1], near[2], near[3], near[4], phi, d2)
            small = exp32(-abs(f))
            curvature = count[r] * small / np.square(np.float32(1) + small)
            for i in range(n):
                t = near[4, i] * phi[i] * near[3, i]
                m = numbers[at + i]
                for axis in range(3):
                    slope = np.float32(2) * t * (x[axis, r] - near[axis, i])
                    out[axis, m] += curvature * slope * slope
                out[3, m] += curvature * t * t * d2[i] * d2[i]
    return out
