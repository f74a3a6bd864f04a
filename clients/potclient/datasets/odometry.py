"""Poses for recordings that have none: LiDAR odometry by KISS-ICP."""

from __future__ import annotations

import dataclasses
import importlib.util
import math
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.scans import RecordedScan, Recording
from potclient.datasets.trajectory import tum_line
from potclient.errors import DatasetError
from potclient.extras import how_to_install
from potclient.poses import quaternion_of

ODOMETRIES = ("kiss-icp",)
_FARTHEST_M = 100.0
_MOST_ECHOES = 0.999
# Off the course of even motion. A drive of 5 scans a second stays within 0.05 m and 0.6 degrees.
_MAX_OFF_M, _MAX_OFF_RAD = 1.0, math.radians(15.0)


class OdometryRecording(Recording):
    """A recording whose scans are placed one after the other by KISS-ICP, in a map frame that is the sensor at the first scan.

    Odometry only: nothing closes loops, so errors add up along the way. Sweeps are taken as they are (no deskewing), and
    must come at the rate of a sensor: keyframes metres apart cannot be placed. A scan is placed when it is first read, after
    all before it; whoever reads every tenth has all of them registered meanwhile.

    Args:
        source: 3D scans in the order in which they were taken; its poses do not count.
        trajectory: A file that gets a TUM line for each scan as it is placed; `poses` of `open_dataset` reads it.
    Raises:
        DatasetError: kiss-icp is missing; on access, a planar scan, or one that cannot be placed or is far off the course.
    """

    def __init__(self, source: Recording, trajectory: Path | None = None) -> None:
        super().__init__(source.path)
        self._source, self._trajectory = source, trajectory
        self._odometry: Any = None  # made for the first scan
        self._poses: list[Float64] = []
        self.format = source.format
        self.notes = (
            *source.notes,
            "placed by kiss-icp: odometry only, no loop is closed, errors add up along the way",
        )

    def __len__(self) -> int:
        return len(self._source)

    @property
    def used(self) -> frozenset[Path]:
        return self._source.used

    def read(self, i: int) -> RecordedScan:
        while len(self._poses) < i:
            self._place(self._source.read(len(self._poses)))
        scan = self._source.read(i)
        if len(self._poses) == i:
            self._place(scan)
        return dataclasses.replace(scan, T_map_sensor=self._poses[i])

    def _place(self, scan: RecordedScan) -> None:
        if scan.is_planar:
            raise DatasetError(f"{scan.name}: kiss-icp needs 3D scans, and this one is planar")
        points = scan.points[scan.is_return].astype(np.float64)
        if not len(points):
            raise DatasetError(f"{scan.name}: no echo, so odometry cannot place it")
        if self._odometry is None:
            self._odometry = _kiss_icp(points)
        self._odometry.register_frame(points, np.zeros(0))
        pose = np.array(self._odometry.last_pose, np.float64)
        if not np.isfinite(pose).all():
            raise DatasetError(f"{scan.name}: kiss-icp found no pose for it")
        self._check_course(scan.name, pose)
        self._poses.append(pose)
        if self._trajectory is not None:
            with self._trajectory.open("a" if len(self._poses) > 1 else "w") as file:
                file.write(tum_line(pose, scan.stamp_ns) + "\n")

    def _check_course(self, name: str, pose: Float64) -> None:
        """Refuse a pose far from where the last two lead."""
        if len(self._poses) < 2:  # no speed is known yet
            return
        before, last = self._poses[-2:]
        off = np.linalg.inv(last @ np.linalg.inv(before) @ last) @ pose
        off_m = float(np.linalg.norm(off[:3, 3]))
        off_rad = 2 * math.acos(min(1.0, float(quaternion_of(off[:3, :3])[0])))
        if off_m > _MAX_OFF_M or off_rad > _MAX_OFF_RAD:
            raise DatasetError(
                f"{name}: kiss-icp puts it {off_m:.1f} m and {math.degrees(off_rad):.0f} degrees off the course so far: it lost"
                " the way, or the scans are too far apart for odometry"
            )


def check_installed() -> None:
    """Refuse before any work.

    Raises:
        DatasetError: kiss-icp is missing.
    """
    if importlib.util.find_spec("kiss_icp") is None:
        raise DatasetError(f"odometry needs the package kiss-icp: {how_to_install('odometry')}")


def _kiss_icp(points: Float64) -> Any:
    """KISS-ICP with its usual settings, for a sensor that sees as far as the first scan, (N, 3) m, shows."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew = False
    range_m = float(np.quantile(np.linalg.norm(points, axis=1), _MOST_ECHOES))
    config.data.max_range = min(_FARTHEST_M, range_m)
    config.mapping.voxel_size = config.data.max_range / 100.0  # its own rule
    return KissICP(config)
