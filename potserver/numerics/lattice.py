"""Cells of a lattice that balls cover: how a robot made of spheres is sampled."""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64, Int64


def most_cells(radii_m: Float64, edge_m: float, dims: int) -> float:
    """An upper bound on the cells that one ball of each radius covers: their cubes lie in a ball larger by half a diagonal."""
    reach = np.asarray(radii_m, np.float64) / edge_m + 0.5 * np.sqrt(dims)
    volume = 4.0 / 3.0 * np.pi * reach**3 if dims == 3 else np.pi * reach**2
    return float(np.sum(np.floor(volume) + 1.0))


def covered_cells(centres: Float64, radii_m: Float64, edge_m: float, dims: int) -> tuple[Int64, Int64]:
    """The cells of each group of balls; a cell is covered when its centre lies in a ball, or a ball's centre lies in it.

    Cell (i, j, k) spans [i, i + 1] x [j, j + 1] x [k, k + 1] times the edge, in the frame of the centres; with 2 dims the balls
    are discs and k is 0. A cell that several balls of a group cover comes several times.

    Args:
        centres: (G, S, 3) m: S balls in each of G groups.
        radii_m: (S,) m.
        edge_m: Of a cell.
        dims: 2 or 3.
    Returns:
        group: (C,) ascending, and cells: (C, 3).
    """
    # copies: see `rays.first_returns`
    centres, radii_m = (np.array(a, np.float64, order="C") for a in (centres, radii_m))
    count = _cover(centres, radii_m, float(edge_m), dims, np.empty(0, np.int64), np.empty((0, 3), np.int64))
    group, cells = np.empty(count, np.int64), np.empty((count, 3), np.int64)
    _cover(centres, radii_m, float(edge_m), dims, group, cells)
    return group, cells


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _cover(centres, radii_m, edge, dims, group, cells):
    """Fill the arrays as far as they go; returns how many cells there are."""
    n = 0
    for g in range(centres.shape[0]):
        for s in range(centres.shape[1]):
            cx, cy = centres[g, s, 0] / edge, centres[g, s, 1] / edge
            cz = centres[g, s, 2] / edge if dims == 3 else 0.5
            reach = radii_m[s] / edge
            x, y, z = int(np.floor(cx)), int(np.floor(cy)), int(np.floor(cz))
            span = int(np.floor(reach)) + 1
            high = span if dims == 3 else 0
            for i in range(x - span, x + span + 1):
                for j in range(y - span, y + span + 1):
                    for k in range(z - high, z + high + 1):
                        dx, dy, dz = i + 0.5 - cx, j + 0.5 - cy, k + 0.5 - cz
                        is_home = i == x and j == y and k == z
                        if is_home or dx * dx + dy * dy + dz * dz <= reach * reach:
                            if n < len(group):
                                group[n] = g
                                cells[n, 0], cells[n, 1], cells[n, 2] = i, j, k
                            n += 1
    return n
