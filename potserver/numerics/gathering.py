"""Which kernels of an index reach a box: the compiled search that sums, gradients, rays and feature blocks share.

A caller takes the points of a cube, or a stretch of a ray, finds the kernels that reach it once, and runs a dense loop over
points times these kernels. For use inside numba code; `index` is a `kernel_index.KernelIndex`.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.geometry import bounds


@nb.njit(nogil=True, error_model="numpy", cache=True)
def kernels_that_reach(index, lower, upper, found):
    """The kernels whose reach meets a box.

    Args:
        index: A KernelIndex.
        lower, upper: (3,) m, corners of the box.
        found: (F,) int64, a buffer.
    Returns:
        n, and the buffer, replaced by a larger one if it was too small: its first n entries number the kernels, in the
        index's order.
    """
    hinge, reach, keys = index.hinge, index.columns[3], index.keys
    n = 0
    for level in range(len(index.level_edge)):
        edge = index.level_edge[level]
        first, last = index.level_start[level], index.level_start[level + 1]
        corner_x, corner_y, corner_z = index.level_cell[level]
        nx, ny, nz = index.level_size[level]
        x0 = max(int(np.floor(lower[0] / edge)) - 1 - corner_x, 0)
        y0 = max(int(np.floor(lower[1] / edge)) - 1 - corner_y, 0)
        z0 = max(int(np.floor(lower[2] / edge)) - 1 - corner_z, 0)
        x1 = min(int(np.floor(upper[0] / edge)) + 1 - corner_x, nx - 1)
        y1 = min(int(np.floor(upper[1] / edge)) + 1 - corner_y, ny - 1)
        z1 = min(int(np.floor(upper[2] / edge)) + 1 - corner_z, nz - 1)
        if x1 < x0 or y1 < y0 or z1 < z0:
            continue
        # Small cells under a large box: where it meets more rows of cells than there are kernels, all kernels are tried.
        whole = (y1 - y0 + 1) * (z1 - z0 + 1) > last - first
        rows_z, rows_y = (1, 1) if whole else (z1 - z0 + 1, y1 - y0 + 1)
        for z in range(z0, z0 + rows_z):
            for y in range(y0, y0 + rows_y):
                row = (z * ny + y) * nx
                low = first if whole else _lower_bound(keys, first, last, row + x0)
                for m in range(low, last):
                    if not whole and keys[m] > row + x1:
                        break
                    d2 = 0.0
                    for c in range(3):
                        d = max(max(lower[c] - hinge[m, c], hinge[m, c] - upper[c]), 0.0)
                        d2 += d * d
                    if d2 <= reach[m] * reach[m]:
                        if n == len(found):
                            larger = np.empty(2 * n, np.int64)
                            larger[:n] = found
                            found = larger
                        found[n] = m
                        n += 1
    return n, found


@nb.njit(nogil=True, error_model="numpy", cache=True)
def kernels_around(index, points, found, local):
    """The kernels that reach the box about some points, with hinges relative to the middle of that box.

    Coordinates relative to the middle lose nothing in float32, however far from the origin the points lie.

    Args:
        index: A KernelIndex.
        points: (N, 3) float64, m.
        found: (F,) int64, a buffer.
        local: (7, L) float32, a buffer.
    Returns:
        n, both buffers, replaced by larger ones if they were too small, and the middle's x, y and z. The first n columns of
        `local` are the kernels: relative hinge x, y, z (m), -gamma (1/m^2), weight, variance and
        what is known of the weight.
    """
    lower, upper = bounds(points)
    n, found = kernels_that_reach(index, lower, upper, found)
    if n > local.shape[1]:
        local = np.empty((7, 2 * n), np.float32)
    cx, cy, cz = 0.5 * (lower[0] + upper[0]), 0.5 * (lower[1] + upper[1]), 0.5 * (lower[2] + upper[2])
    hinge, columns = index.hinge, index.columns
    for i in range(n):
        m = found[i]
        local[0, i] = hinge[m, 0] - cx
        local[1, i] = hinge[m, 1] - cy
        local[2, i] = hinge[m, 2] - cz
        local[3, i] = columns[0, m]
        local[4, i] = columns[1, m]
        local[5, i] = columns[2, m]
        local[6, i] = columns[4, m]
    return n, found, local, cx, cy, cz


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _lower_bound(keys, low, high, key):
    """The first place in keys[low:high], ascending, with at least the key."""
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low
