"""Sort points into cubes, and cubes into groups of neighbours, in linear time."""

from __future__ import annotations

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64, Int64
from potserver.numerics.geometry import bounds

_MAX_CUBES = 2**22  # of the table that is counted into
_SPLIT = 3  # cubes along an edge of a group


def sort_into_cubes(points: Float64, edge_m: float) -> tuple[Int64, Int64, Int64]:
    """Sort points by cube, in linear time; cubes are larger where so many of them would not fit a table.

    Returns:
        order: (N,) so that `points[order]` has each cube's points together, in their old order.
        cuts: (C + 1,) where each cube starts.
        groups: (G + 1,) the first cube of each group of neighbouring cubes.
    """
    lower, upper = bounds(points)
    extent = upper - lower
    while True:
        size = (extent / (_SPLIT * edge_m)).astype(np.int64) + 1
        if size.astype(np.float64).prod() * _SPLIT**3 <= _MAX_CUBES:
            return _counting_sort(points, lower, edge_m, size)
        edge_m *= 2.0


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _counting_sort(points, lower, edge, size):
    n = len(points)
    cube = np.empty(n, np.int64)
    in_group = _SPLIT**3
    count = np.zeros(size[0] * size[1] * size[2] * in_group + 1, np.int64)
    for i in range(n):
        x = min(np.int64((points[i, 0] - lower[0]) / edge), size[0] * _SPLIT - 1)
        y = min(np.int64((points[i, 1] - lower[1]) / edge), size[1] * _SPLIT - 1)
        z = min(np.int64((points[i, 2] - lower[2]) / edge), size[2] * _SPLIT - 1)
        group = ((x // _SPLIT) * size[1] + y // _SPLIT) * size[2] + z // _SPLIT
        cube[i] = group * in_group + ((x % _SPLIT) * _SPLIT + y % _SPLIT) * _SPLIT + z % _SPLIT
        count[cube[i]] += 1
    n_cubes, n_groups, last = 0, 0, -1
    total = 0
    cuts = np.empty(min(n, len(count)) + 1, np.int64)
    groups = np.empty(len(cuts), np.int64)
    for c in range(len(count) - 1):
        members = count[c]
        count[c] = total
        if members:
            if c // in_group != last:
                last = c // in_group
                groups[n_groups] = n_cubes
                n_groups += 1
            cuts[n_cubes] = total
            n_cubes += 1
        total += members
    cuts[n_cubes] = total
    groups[n_groups] = n_cubes
    order = np.empty(n, np.int64)
    for i in range(n):
        order[count[cube[i]]] = i
        count[cube[i]] += 1
    return order, cuts[: n_cubes + 1].copy(), groups[: n_groups + 1].copy()
