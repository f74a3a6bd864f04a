"""A 2D recording cut out of a 3D one: the beams in a band of elevations, seen from above."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from potclient.datasets.scans import RecordedScan, Recording


class PlanarSlice(Recording):
    """The beams of a 3D recording whose elevation lies in a band, projected onto z = 0 of the map.

    A band about 0 gives what a planar scanner at the same place would see; one above 0 keeps off the floor.

    Args:
        source: A recording of 3D scans.
        elevations_rad: Lowest and highest elevation above the horizontal.
    """

    format = "planar slice"

    def __init__(self, source: Recording, elevations_rad: tuple[float, float]) -> None:
        super().__init__(source.path)
        self._source, self._elevations_rad = source, elevations_rad
        low, high = (math.degrees(a) for a in elevations_rad)
        self.notes = (
            *source.notes,
            f"beams {low:+.1f} to {high:+.1f} degrees above the horizontal, z = 0",
        )

    def __len__(self) -> int:
        return len(self._source)

    def read(self, i: int) -> RecordedScan:
        return planar_slice(self._source.read(i), self._elevations_rad)


def planar_slice(scan: RecordedScan, elevations_rad: tuple[float, float]) -> RecordedScan:
    """The beams of one scan in a band of elevations, in a frame that only turns about the vertical."""
    R = scan.T_map_sensor[:3, :3]
    yaw = math.atan2(R[1, 0], R[0, 0])
    c, s = math.cos(yaw), math.sin(yaw)
    level = scan.points.astype(np.float64) @ R.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    elevation = np.arctan2(level[:, 2], np.hypot(level[:, 0], level[:, 1]))
    inside = (elevation >= elevations_rad[0]) & (elevation <= elevations_rad[1])
    flat = level[inside]
    flat[:, 2] = 0.0
    pose = np.eye(4)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:2, 3] = scan.T_map_sensor[:2, 3]
    return dataclasses.replace(
        scan,
        points=flat.astype(np.float32),
        is_return=scan.is_return[inside],
        T_map_sensor=pose,
        is_planar=True,
    )
