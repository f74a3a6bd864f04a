"""A 2D recording cut out of a 3D one: the beams near the horizontal plane of the sensor, as a planar scanner would see them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from potclient.datasets.scans import RecordedScan, Recording


class PlanarSlice(Recording):
    """The nearly horizontal beams of a 3D recording, projected onto z = 0 of the map.

    Args:
        source: A recording of 3D scans.
        half_angle_rad: Beams within this elevation of the horizontal are taken.
    """

    format = "planar slice"

    def __init__(self, source: Recording, half_angle_rad: float = math.radians(1.5)) -> None:
        super().__init__(source.path)
        self._source, self._half_angle_rad = source, half_angle_rad
        self.notes = (
            *source.notes,
            f"beams within {math.degrees(half_angle_rad):.1f} degrees of the horizontal, z = 0",
        )

    def __len__(self) -> int:
        return len(self._source)

    def read(self, i: int) -> RecordedScan:
        return planar_slice(self._source.read(i), self._half_angle_rad)


def planar_slice(scan: RecordedScan, half_angle_rad: float) -> RecordedScan:
    """The beams of one scan within `half_angle_rad` of the horizontal, in a frame that only turns about the vertical."""
    R = scan.T_map_sensor[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    level = scan.points.astype(np.float64) @ R.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    near = np.abs(np.arctan2(level[:, 2], np.hypot(level[:, 0], level[:, 1]))) <= half_angle_rad
    flat = level[near]
    flat[:, 2] = 0.0
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:2, 3] = scan.T_map_sensor[:2, 3]
    return dataclasses.replace(
        scan,
        points=flat.astype(np.float32),
        is_return=scan.is_return[near],
        T_map_sensor=pose,
        is_planar=True,
    )
