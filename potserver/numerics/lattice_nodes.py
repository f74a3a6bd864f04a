"""Nodes of a kernel lattice: cells that get a kernel because points lie in or near them."""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64
from potserver.numerics.voxel_hash import empty_table, find, pack


def new_nodes(
    points: Float64,
    present: Float64,
    spacing_m: float,
    *,
    within: float,
    planar: bool,
) -> Float64:
    """Centres of the lattice cells that points ask for and that have no kernel yet.

    A point asks for the cell that it lies in, and for those of the 26 around it with centres nearer than `within` spacings.
    Without these, the activation at a point would depend on where in its cell it lies.

    Args:
        points: (N, 3) m.
        present: (K, 3) m, centres that are there already, same frame.
        spacing_m: Edge of a cell.
        within: In spacings; 0 takes the own cell alone.
        planar: Keep to the plane of the points: only neighbours in x and y, and centres at the height of their point.
    Returns:
        (M, 3) m, in the order in which the points ask for them.
    """
    capacity = len(present) + len(points) * (1 if within <= 0 else 9 if planar else 27)
    # most points ask for cells that are there: start small and grow
    size = min(capacity, len(present) + 4 * len(points) + 64)
    while True:
        table = empty_table(size)
        centres, n = _new_nodes(
            np.ascontiguousarray(points),
            np.ascontiguousarray(present),
            spacing_m,
            within,
            planar,
            table,
            size,
        )
        if n >= 0:
            return centres[len(present) : n]
        size = min(capacity, 4 * size)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _new_nodes(points, present, spacing, within, planar, table, size):
    keys = np.empty(size, np.int64)
    centres = np.empty((size, 3))
    cell = np.empty(3, np.int64)
    off = np.empty(3)
    n = 0
    for k in range(len(present)):
        for c in range(3):
            cell[c] = np.int64(np.floor(present[k, c] / spacing))
            centres[n, c] = present[k, c]
        keys[n] = pack(0, cell[0], cell[1], cell[2])
        place = find(table, keys, keys[n])
        if table[place] < 0:
            table[place] = n
        n += 1
    reach = 1 if within > 0.0 else 0
    up = 0 if planar else reach
    for i in range(len(points)):
        for c in range(3):
            cell[c] = np.int64(np.floor(points[i, c] / spacing))
            off[c] = points[i, c] / spacing - cell[c] - 0.5
        if planar:
            off[2] = 0.0
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                for dz in range(-up, up + 1):
                    d2 = (off[0] - dx) ** 2 + (off[1] - dy) ** 2 + (off[2] - dz) ** 2
                    if d2 >= within * within and (dx != 0 or dy != 0 or dz != 0):
                        continue
                    key = pack(0, cell[0] + dx, cell[1] + dy, cell[2] + dz)
                    place = find(table, keys, key)
                    if table[place] >= 0:
                        continue
                    if n == size:
                        return centres, -1
                    table[place] = n
                    keys[n] = key
                    centres[n, 0] = (cell[0] + dx + 0.5) * spacing
                    centres[n, 1] = (cell[1] + dy + 0.5) * spacing
                    centres[n, 2] = points[i, 2] if planar else (cell[2] + dz + 0.5) * spacing
                    n += 1
    return centres, n
