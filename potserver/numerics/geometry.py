"""Rotations about the vertical, cylindrical sectors, and thinning of point sets. In 2D everything has z = 0."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_ANGLE_STEPS = 2**32  # of a full turn
_ANGLE_STEP_RAD = 2.0 * math.pi / _ANGLE_STEPS


def rotation_z(angle_rad: float) -> Float64:
    """(3, 3) rotation about the z axis, counter-clockwise seen from above (paper eq. 5)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotated_diagonal(variance: NDArray[np.floating], rotation: Float64) -> NDArray[np.floating]:
    """(K, 3) diagonal of R diag(variance) R^T: what is left of a diagonal covariance after a rotation."""
    return variance @ np.square(rotation).T.astype(variance.dtype)


def yaw_of(T_map_sensor: Float64) -> float:
    """Heading of the sensor's x axis in the map's horizontal plane, rad."""
    return math.atan2(T_map_sensor[1, 0], T_map_sensor[0, 0])


def sector_edges(n_sectors: int) -> Float64:
    """(n_sectors + 1,) rad: equal cylindrical sectors about the sensor, the first one centred on its heading."""
    width = 2.0 * math.pi / n_sectors
    return np.asarray(-width / 2.0 + width * np.arange(n_sectors + 1), np.float64)


def in_sector(
    points: NDArray[np.floating], azimuth_min_rad: float, azimuth_max_rad: float, radius_m: float
) -> Bool:
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


def voxel_pick(points: NDArray[np.floating], voxel_m: float) -> NDArray[np.intp]:
    """Numbers of the first point in every occupied voxel, ascending."""
    if len(points) == 0:
        return np.zeros(0, np.intp)
    cell = np.floor(points / voxel_m).astype(np.int64)
    cell -= cell.min(axis=0)
    size = cell.max(axis=0) + 1
    _, first = np.unique((cell[:, 2] * size[1] + cell[:, 1]) * size[0] + cell[:, 0], return_index=True)
    return np.sort(first)


def thin(
    points: NDArray[np.floating], n_max: int, voxel_m: float, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Numbers of at most `n_max` points that cover the set: one a voxel, then a random choice among those.

    A voxel of 0 leaves the voxels out: a plain random choice.
    """
    picked = voxel_pick(points, voxel_m) if voxel_m > 0 else np.arange(len(points))
    if len(picked) > n_max:
        picked = np.sort(rng.choice(picked, n_max, replace=False))
    return picked
