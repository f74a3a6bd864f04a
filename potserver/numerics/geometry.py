"""Rotations about the vertical, cylindrical sectors, and thinning of point sets. In 2D everything has z = 0."""

from __future__ import annotations

import math

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.numerics.arrays import Bool, Float64, Floats
from potserver.numerics.voxel_hash import empty_table, enter

_ANGLE_STEPS = 2**32  # of a full turn
_ANGLE_STEP_RAD = 2.0 * math.pi / _ANGLE_STEPS


def rotation_z(angle_rad: float) -> Float64:
    """(3, 3) rotation about the z axis, counter-clockwise seen from above (paper eq. 5)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotated_diagonal(variance: Floats, rotation: Float64) -> Floats:
    """(K, 3) diagonal of R diag(variance) R^T: what is left of a diagonal covariance after a rotation."""
    return variance @ np.square(rotation).T.astype(variance.dtype)


def yaw_of(T_map_sensor: Float64) -> float:
    """Heading of the sensor's x axis in the map's horizontal plane, rad."""
    return math.atan2(T_map_sensor[1, 0], T_map_sensor[0, 0])


def sector_edges(n_sectors: int) -> Float64:
    """(n_sectors + 1,) rad: equal cylindrical sectors about the sensor, the first one centred on its heading."""
    width = 2.0 * math.pi / n_sectors
    return np.asarray(-width / 2.0 + width * np.arange(n_sectors + 1), np.float64)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def bounds(points):
    """(3,) and (3,): the lower and upper corner of (N, 3) points, N > 0; numpy is slow along so short an axis."""
    lower, upper = points[0].copy(), points[0].copy()
    for i in range(1, len(points)):
        for c in range(3):
            lower[c] = min(lower[c], points[i, c])
            upper[c] = max(upper[c], points[i, c])
    return lower, upper


@nb.njit(nogil=True, error_model="numpy", cache=True)
def inside_box(points, lower, upper):
    """(N,) bool: which of (N, 3) points lie in a box, its faces included."""
    out = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        out[i] = (
            (lower[0] <= points[i, 0] <= upper[0])
            and (lower[1] <= points[i, 1] <= upper[1])
            and (lower[2] <= points[i, 2] <= upper[2])
        )
    return out


def in_sector(points: Floats, azimuth_min_rad: float, azimuth_max_rad: float, radius_m: float) -> Bool:
    """(N,) which points lie in a cylindrical sector (pie slice) about the origin.

    Args:
        points: (N, 3) m.
        azimuth_min_rad: Inclusive; the sector runs counter-clockwise to `azimuth_max_rad`, exclusive.
        azimuth_max_rad: At most 2 pi beyond `azimuth_min_rad`.
        radius_m: Horizontal radius of the cylinder; its height is not bounded.
    """
    # whole steps of 1.5e-9 rad: in floats, a point on the edge of two sectors would now and then fall in both or in neither
    lower, upper = round(azimuth_min_rad / _ANGLE_STEP_RAD), round(azimuth_max_rad / _ANGLE_STEP_RAD)
    angle = np.rint(np.arctan2(points[:, 1], points[:, 0]) / _ANGLE_STEP_RAD).astype(np.int64)
    return ((angle - lower) % _ANGLE_STEPS < upper - lower) & (
        np.hypot(points[:, 0], points[:, 1]) <= radius_m
    )


def voxel_pick(points: Floats, voxel_m: float) -> NDArray[np.intp]:
    """Numbers of the first point in every occupied voxel, ascending."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    cell = np.floor(points / voxel_m).astype(np.int64)
    lower, upper = bounds(cell)
    return np.asarray(_first_of_each(cell, lower, upper - lower + 1, empty_table(len(cell))), np.intp)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _first_of_each(cell, lower, size, table):
    keys = np.empty(len(cell), np.int64)
    picked = np.empty(len(cell), np.int64)
    n = 0
    for i in range(len(cell)):
        key = ((cell[i, 2] - lower[2]) * size[1] + cell[i, 1] - lower[1]) * size[0] + cell[i, 0] - lower[0]
        if enter(table, keys, n, key) == n:
            picked[n] = i
            n += 1
    return picked[:n].copy()


def thin(points: Floats, n_max: int, voxel_m: float, rng: np.random.Generator) -> NDArray[np.intp]:
    """Numbers of at most `n_max` points that cover the set: one a voxel, then a random choice among those.

    A voxel of 0 leaves the voxels out: a plain random choice.
    """
    picked = voxel_pick(points, voxel_m) if voxel_m > 0 else np.arange(len(points))
    if len(picked) > n_max:
        picked = np.sort(rng.choice(picked, n_max, replace=False))
    return picked
