"""Bayesian generalised kernel inference (Doherty, Wang and Englot 2017): kernel-weighted counts of labels in voxels."""

from __future__ import annotations

import math

import numba as nb
import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potserver.evaluation.mappers import Answer, Mapper, Size
from potserver.numerics.voxel_hash import empty_table, find, pack

_SCALE = 1.0  # of the kernel
_LENGTH_PER_RESOLUTION = 2.0
_FREE_STEP_M = 0.5
_PRIOR = 0.001  # pseudo-counts of each class
_BYTES_A_CELL = 3 * 2 + 2 * 4  # key, two counts


class BgkMap(Mapper):
    """BGK inference with the sparse kernel, online, and the parameters that its authors publish for 0.1 m.

    Their lengths go with the resolution: kernel length 2 voxels, end points and free points thinned to their mean in each
    voxel; free points every 0.5 m of a thinned beam, and 0.5 m before its end. A beam without an echo, which the authors' code
    drops, gives its free points here.

    The authors' code puts free points right up to a beam's end, which on grazing beams is free space on the ground. With a
    gap it does better.

    Args:
        resolution_m: Edge of a voxel.
        gap_m: Before a beam's end, without free points.
    """

    def __init__(self, resolution_m: float, *, gap_m: float = 0.0) -> None:
        self.name = f"BGK {resolution_m:g} m" + (f", {gap_m:g} m gap" if gap_m else "")
        self._gap_m = gap_m
        self._edge_m, self._length_m = resolution_m, _LENGTH_PER_RESOLUTION * resolution_m
        self._keys = np.zeros(1 << 12, np.int64)
        self._counts = np.zeros((1 << 12, 2), np.float32)  # of free, of occupied
        self._table = empty_table(1 << 12)
        self._n = 0

    def warm_up(self, *, planar: bool) -> None:
        scratch = BgkMap(self._edge_m)
        scratch._add(np.zeros((1, 3)), np.ones(1, np.bool_), planar)
        scratch.occupancy(np.zeros((1, 3)))

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        origin = scan.T_map_sensor[:3, 3]
        ends = scan.in_map
        hits = _thinned(ends[scan.is_return], self._edge_m)
        beams = np.concatenate([hits, _thinned(ends[~scan.is_return], self._edge_m)])
        free = _thinned(np.concatenate([origin[None], _along(origin, beams, self._gap_m)]), self._edge_m)
        self._add(np.concatenate([hits, free]), np.arange(len(hits) + len(free)) < len(hits), scan.is_planar)
        return {}

    def _add(self, points: Float64, occupied: Bool, planar: bool) -> None:
        """Kernel-weighted counts of labelled points, in all voxels whose centres are within the kernel's length."""
        done = 0
        while True:
            done, self._n = _count(
                points, occupied, done, self._edge_m, self._length_m, planar,
                self._keys, self._counts, self._table, self._n,
            )  # fmt: skip
            if done == len(points):
                return
            self._keys = np.concatenate([self._keys, np.zeros_like(self._keys)])
            self._counts = np.concatenate([self._counts, np.zeros_like(self._counts)])
            self._table = empty_table(len(self._keys))
            _enter(self._table, self._keys, self._n)

    def occupancy(self, points: Float64) -> Answer:
        counts = _look_up(np.ascontiguousarray(points), self._edge_m, self._keys, self._counts, self._table)
        total = counts.sum(axis=1, dtype=np.float64)
        return Answer((counts[:, 1] + _PRIOR) / (total + 2 * _PRIOR), total > 0)

    def size(self) -> Size:
        return Size(self._n, self._n * _BYTES_A_CELL)


def _thinned(points: Float64, edge_m: float) -> Float64:
    """The mean of the points in each voxel."""
    if not len(points):
        return points
    cell = np.floor(points / edge_m).astype(np.int64)
    cell -= cell.min(axis=0)
    _, of, n = np.unique(
        np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)),
        return_inverse=True,
        return_counts=True,
    )
    return np.stack([np.bincount(of, points[:, axis]) / n for axis in range(3)], axis=1)


def _along(origin: Float64, ends: Float64, gap_m: float) -> Float64:
    """The free points of beams from the origin (3,) to ends (N, 3)."""
    length = np.linalg.norm(ends - origin, axis=1)
    n = np.maximum(np.ceil((length - gap_m) / _FREE_STEP_M).astype(np.int64) - 1, 0)  # k steps, k = 1, 2, ...
    beam = np.repeat(np.arange(len(ends)), n)
    step = 1 + np.arange(len(beam)) - np.repeat(np.cumsum(n) - n, n)
    last = np.flatnonzero(length > _FREE_STEP_M)
    beam = np.concatenate([beam, last])
    distance = np.concatenate([step * _FREE_STEP_M, length[last] - _FREE_STEP_M])
    return np.asarray(origin + (ends[beam] - origin) * (distance / length[beam])[:, None])


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _count(points, occupied, done, edge, length, planar, keys, counts, table, n):
    """From point `done` on; how many are done, and the entries in use. Stops early where the entries may not suffice."""
    reach = math.ceil(length / edge)
    reach_z = 0 if planar else reach
    most = (2 * reach + 1) ** 2 * (2 * reach_z + 1)
    for i in range(done, len(points)):
        if n + most > len(keys):
            return i, n
        x, y, z = points[i]
        cx, cy, cz = math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)
        for kx in range(cx - reach, cx + reach + 1):
            for ky in range(cy - reach, cy + reach + 1):
                for kz in range(cz - reach_z, cz + reach_z + 1):
                    dx, dy = (kx + 0.5) * edge - x, (ky + 0.5) * edge - y
                    # a planar map is a map of columns
                    dz = 0.0 if planar else (kz + 0.5) * edge - z
                    square = dx * dx + dy * dy + dz * dz
                    if square >= length * length:
                        continue
                    d = math.sqrt(square) / length
                    turn = 2.0 * math.pi * d
                    weight = _SCALE * (
                        (2.0 + math.cos(turn)) * (1.0 - d) / 3.0 + math.sin(turn) / (2.0 * math.pi)
                    )
                    if weight <= 0.0:
                        continue
                    key = pack(0, kx, ky, kz)
                    place = find(table, keys, key)
                    entry = table[place]
                    if entry < 0:
                        entry = n
                        table[place] = entry
                        keys[entry] = key
                        n += 1
                    counts[entry, 1 if occupied[i] else 0] += np.float32(weight)
    return len(points), n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter(table, keys, n):
    for entry in range(n):
        table[find(table, keys, keys[entry])] = entry


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _look_up(points, edge, keys, counts, table):
    out = np.zeros((len(points), 2), np.float32)
    for i in range(len(points)):
        x, y, z = points[i]
        entry = table[
            find(table, keys, pack(0, math.floor(x / edge), math.floor(y / edge), math.floor(z / edge)))
        ]
        if entry >= 0:
            out[i] = counts[entry]
    return out
