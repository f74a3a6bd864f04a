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


def interpolate(start: Float64, end: Float64, fraction: float) -> Float64:
    """A pose between two: linear in translation, along the great circle in rotation (slerp)."""
    q0, q1 = rotation_quaternion(start[:3, :3]), rotation_quaternion(end[:3, :3])
    cosine = float(q0 @ q1)
    if cosine < 0:  # the shorter way round
        q1, cosine = -q1, -cosine
    angle = float(np.arccos(min(1.0, cosine)))
    if angle < 1e-6:
        q = (1 - fraction) * q0 + fraction * q1
    else:
        q = (np.sin((1 - fraction) * angle) * q0 + np.sin(fraction * angle) * q1) / np.sin(angle)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_rotation(*(q / np.linalg.norm(q)))
    pose[:3, 3] = (1 - fraction) * start[:3, 3] + fraction * end[:3, 3]
    return pose


def rotation_quaternion(R: Float64) -> Float64:
    """(4,) w, x, y, z of a rotation (3, 3): the best conditioned of the four ways."""
    w2 = np.array(
        [
            1 + R[0, 0] + R[1, 1] + R[2, 2],
            1 + R[0, 0] - R[1, 1] - R[2, 2],
            1 - R[0, 0] + R[1, 1] - R[2, 2],
            1 - R[0, 0] - R[1, 1] + R[2, 2],
        ]
    )
    i = int(np.argmax(w2))
    rows = (
        (w2[0], R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]),
        (R[2, 1] - R[1, 2], w2[1], R[1, 0] + R[0, 1], R[0, 2] + R[2, 0]),
        (R[0, 2] - R[2, 0], R[1, 0] + R[0, 1], w2[2], R[2, 1] + R[1, 2]),
        (R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[2, 1] + R[1, 2], w2[3]),
    )
    q = np.array(rows[i])
    return np.asarray(q / np.linalg.norm(q))
