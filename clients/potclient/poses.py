"""Poses from few numbers."""

from __future__ import annotations

import math

import numpy as np

from potclient.arrays import Float64


def yaw_pose(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> Float64:
    """(4, 4) of something upright: turned about the vertical, then moved."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], np.float64)


def quaternion_rotation(w: float, x: float, y: float, z: float) -> Float64:
    """(3, 3) of a quaternion of length one."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ],
        np.float64,
    )
