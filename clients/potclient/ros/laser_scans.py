"""`sensor_msgs/LaserScan` as beams, and the beams of a planar laser in a level frame."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float32, Float64
from potclient.errors import RosMessageError
from potclient.poses import yaw_pose
from potclient.ros.types import frame_of, stamp_of

MAX_TILT_DEG = 20.0  # of a planar laser: seen from above, lengths along the tilt shrink by 6 %


class LaserBeams(NamedTuple):
    """The beams of one message that say something."""

    points: Float32  # (N, 3) m, in the frame `frame_id`, z = 0
    is_return: Bool  # (N,) false = no echo: free up to the point, at the scanner's largest range
    frame_id: str
    stamp_ns: int
    n_invalid: int  # readings that were left out


def read_laser_scan(message: Any) -> LaserBeams:
    """The beams of a `LaserScan`, by REP 117: infinity is no echo up to `range_max`; NaN, and numbers outside the
    scanner's limits, are no readings.

    Raises:
        RosMessageError: the angles are not finite, or the limits are no limits.
    """
    range_m = np.asarray(message.ranges, np.float64)
    start, step = float(message.angle_min), float(message.angle_increment)
    low, high = float(message.range_min), float(message.range_max)
    if not (math.isfinite(start) and math.isfinite(step) and 0 <= low < high):
        raise RosMessageError(
            f"laser scan: angles from {start:g} rad by {step:g}, ranges from {low:g} to {high:g} m",
            reason="bad_layout",
        )
    angle = start + step * np.arange(len(range_m))
    is_return = np.isfinite(range_m) & (range_m >= low) & (range_m <= high)
    no_echo = np.isposinf(range_m) & math.isfinite(high)
    keep = is_return | no_echo
    length = np.where(is_return, range_m, high)[keep]
    points = np.stack([length * np.cos(angle[keep]), length * np.sin(angle[keep]), np.zeros(len(length))], 1)
    return LaserBeams(
        points=points.astype(np.float32),
        is_return=is_return[keep],
        frame_id=frame_of(message.header.frame_id),
        stamp_ns=stamp_of(message.header),
        n_invalid=int((~keep).sum()),
    )


def level(points: Float32, T_map_sensor: Float64) -> tuple[Float32, Float64]:
    """A planar laser's points seen from above, as a planar map takes them; it may hang upside down.

    Args:
        points: (N, 3) m, sensor frame.
        T_map_sensor: (4, 4).
    Returns:
        (N, 2) m, in a frame at the sensor that only turns about the vertical, and that frame's (4, 4) pose, with z = 0.
    Raises:
        RosMessageError: the laser's plane is steeper than `MAX_TILT_DEG`.
    """
    R = T_map_sensor[:3, :3]
    tilt_deg = math.degrees(math.acos(min(1.0, abs(float(R[2, 2])))))
    if tilt_deg > MAX_TILT_DEG:
        raise RosMessageError(
            f"a planar laser tilted by {tilt_deg:.0f} degrees; up to {MAX_TILT_DEG:g} can be seen from above",
            reason="tilted",
        )
    pose = yaw_pose(float(T_map_sensor[0, 3]), float(T_map_sensor[1, 3]), math.atan2(R[1, 0], R[0, 0]))
    flat = points.astype(np.float64) @ (pose[:3, :3].T @ R).T
    return np.ascontiguousarray(flat[:, :2], np.float32), pose
