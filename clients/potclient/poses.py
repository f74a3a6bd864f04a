"""Poses from few numbers, and between two poses."""

from __future__ import annotations

import math

import numpy as np

from potclient.arrays import Float64


def yaw_pose(x_m: float, y_m: float, yaw_rad: float, z_m: float = 0.0) -> Float64:
    """(4, 4) of something upright: turned about the vertical, then moved."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], np.float64)


def euler_pose(translation: Float64, roll: float, pitch: float, yaw: float) -> Float64:
    """(4, 4) of a translation (3,), m, and turns about x, then y, then z of the fixed axes, radians."""
    pose = yaw_pose(0.0, 0.0, yaw)
    (cp, sp), (cr, sr) = ((math.cos(angle), math.sin(angle)) for angle in (pitch, roll))
    pose[:3, :3] @= np.array([[cp, sp * sr, sp * cr], [0, cr, -sr], [-sp, cp * sr, cp * cr]])
    pose[:3, 3] = translation
    return pose


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


def quaternion_pose(translation: Float64, wxyz: Float64) -> Float64:
    """(4, 4) of a translation (3,), m, and a quaternion (4,) of any length but zero, w first.

    Raises:
        ValueError: a number is not finite, or the quaternion is zero.
    """
    norm = float(np.linalg.norm(wxyz))
    if not (np.isfinite(translation).all() and math.isfinite(norm) and norm > 1e-9):
        raise ValueError(f"translation {translation.tolist()} and quaternion {wxyz.tolist()} are no pose")
    pose = np.eye(4)
    pose[:3, :3] = quaternion_rotation(*(wxyz / norm).tolist())
    pose[:3, 3] = translation
    return pose


def quaternion_of(rotation: Float64) -> Float64:
    """(4,) w x y z of length one, w >= 0: the quaternion of a rotation (3, 3)."""
    # of the four ways to divide, the one with the largest divisor
    m = rotation
    candidates = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    best = candidates[int(np.argmax(np.diagonal(candidates)))]
    q: Float64 = best / np.linalg.norm(best)
    return q if q[0] >= 0 else -q


def interpolate(before: Float64, after: Float64, share: float) -> Float64:
    """(4, 4): the pose at a share of the way, 0 to 1; the turn is even, the way straight."""
    a, b = quaternion_of(before[:3, :3]), quaternion_of(after[:3, :3])
    cosine = float(a @ b)
    b, cosine = (b, cosine) if cosine >= 0 else (-b, -cosine)
    angle = math.acos(min(1.0, cosine))
    if angle < 1e-6:
        q = (1 - share) * a + share * b
    else:
        q = (math.sin((1 - share) * angle) * a + math.sin(share * angle) * b) / math.sin(angle)
    return quaternion_pose((1 - share) * before[:3, 3] + share * after[:3, 3], q)
