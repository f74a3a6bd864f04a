"""The nearest of many points, by cubes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from potclient.arrays import Bool, Float64
from potserver.numerics.arrays import Int64
from potserver.numerics.voxel_hash import empty_table, find, pack

_PLANE_NEIGHBOURS, _LINE_NEIGHBOURS = 12, 5
_PLANE_REACH_M, _PLANE_CUBE_M = 1.0, 0.25
_FLAT_M = 0.05  # standard deviation of points about their plane, at most
_FLATNESS = 9.0  # the second smallest spread over the smallest one, squared, at least


class Neighbours(NamedTuple):
    """Of N points, the k nearest others, in order."""

    rows: Int64  # (N, k), -1 where there is none in reach
    distance_m: Float64  # (N, k), inf where there is none in reach


def nearest(points: Float64, asked: Float64, k: int, *, reach_m: float, cube_m: float) -> Neighbours:
    """The k nearest of (M, 3) points m for each of (N, 3) asked points, at most `reach_m` away.

    Args:
        cube_m: Edge of the cubes that points are sorted into.
    """
    found = Neighbours(np.full((len(asked), k), -1), np.full((len(asked), k), np.inf))
    if not len(points) or not len(asked):
        return found
    corner = points.min(axis=0)
    keys = _keys(points - corner, cube_m)
    order = np.argsort(keys, kind="stable")
    cubes, first = np.unique(keys[order], return_index=True)
    table = empty_table(len(cubes))
    _enter(table, cubes)
    _search(
        points[order] - corner, np.append(first, len(points)), cubes, table, asked - corner, cube_m, reach_m, *found
    )  # fmt: skip
    return Neighbours(np.where(found.rows < 0, -1, order[found.rows]), found.distance_m)


def cosines_of_incidence(hits: Float64, asked: Float64, eye: Float64, *, planar: bool) -> Float64:
    """(N,) |cosine| between the beams from an eye (3,) m to asked hits (N, 3) m and the surface's normal.

    The surface is the plane (of planar scans: the line) through the nearest of the hits (M, 3) m. NaN where they lie in none.
    """
    k = _LINE_NEIGHBOURS if planar else _PLANE_NEIGHBOURS
    rows = nearest(hits, asked, k, reach_m=_PLANE_REACH_M, cube_m=_PLANE_CUBE_M).rows
    cosines = np.full(len(asked), np.nan)
    whole = np.flatnonzero(rows[:, -1] >= 0)
    around = hits[rows[whole]]
    around = around - around.mean(axis=1, keepdims=True)
    covariance = np.einsum("nki,nkj->nij", around, around) / k
    if planar:
        covariance[:, 2, 2] = 1e3  # m^2: the normal lies in the plane
    spread, axes = np.linalg.eigh(covariance)
    flat = (spread[:, 0] < _FLAT_M**2) & (spread[:, 1] > _FLATNESS * spread[:, 0])
    beam = asked[whole] - eye
    beam /= np.linalg.norm(beam, axis=1, keepdims=True)
    cosines[whole] = np.where(flat, np.abs(np.einsum("ni,ni->n", axes[:, :, 0], beam)), np.nan)
    return cosines


def within(points: Float64, asked: Float64, reach_m: float) -> Bool:
    """(N,) whether one of the (M, 3) points m is at most `reach_m` from asked points (N, 3)."""
    return nearest(points, asked, 1, reach_m=reach_m, cube_m=reach_m).rows[:, 0] >= 0


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _keys(points, edge):
    keys = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x, y, z = points[i]
        keys[i] = pack(0, math.floor(x / edge), math.floor(y / edge), math.floor(z / edge))
    return keys


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter(table, cubes):
    for cube in range(len(cubes)):
        table[find(table, cubes, cubes[cube])] = cube


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _search(points, first, cubes, table, asked, edge, reach, rows, distance):
    k = rows.shape[1]
    shells = math.ceil(reach / edge)
    for i in range(len(asked)):
        x, y, z = asked[i]
        cx, cy, cz = math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)
        for shell in range(shells + 1):
            if distance[i, k - 1] <= (shell - 1) * edge:
                break  # all that lies in this shell is farther
            for dx in range(-shell, shell + 1):
                for dy in range(-shell, shell + 1):
                    side = abs(dx) == shell or abs(dy) == shell
                    for dz in range(-shell, shell + 1, 1 if side or shell == 0 else 2 * shell):
                        place = find(table, cubes, pack(0, cx + dx, cy + dy, cz + dz))
                        cube = table[place]
                        if cube < 0:
                            continue
                        for row in range(first[cube], first[cube + 1]):
                            p = points[row]
                            d = math.sqrt((p[0] - x) ** 2 + (p[1] - y) ** 2 + (p[2] - z) ** 2)
                            if d > reach or d >= distance[i, k - 1]:
                                continue
                            last = k - 1
                            while last > 0 and distance[i, last - 1] > d:
                                distance[i, last], rows[i, last] = distance[i, last - 1], rows[i, last - 1]
                                last -= 1
                            distance[i, last], rows[i, last] = d, row
