"""Recordings of made-up places: scans by a LiDAR model, and the exact truth about every point and every ray."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from potclient.arrays import Bool, Float64
from potclient.datasets.scans import RecordedScan, Recording
from potclient.errors import DatasetError
from potclient.towns.lidar import Lidar
from potclient.towns.raycast import require
from potclient.towns.streets import stream

PERIOD_S = 0.1  # of scans
_GROUND_Z_M = 0.0


class Surfaces(NamedTuple):
    """What rays meet first."""

    range_m: Float64  # (N,) inf: nothing
    normals: Float64  # (N, 3) unit, of the surface, on the ray's side; zeros where there is none


class SurveyedRecording(Recording):
    """Scans of a place whose truth is known, at 10 Hz.

    Scan k is taken at `stamp_ns` = k * 0.1 s of the place's clock, so `occupied(points, scan.stamp_ns / 1e9)` is the truth of
    that moment. Every scan has random numbers of its own: the order of reading does not matter.

    Args:
        path: The place's name.
        lidar: What scans it.
        indices: Which scans.
        seed: Of noise and drop-outs.
        slice_m: The height of a planar scanner; None: the place is 3D.
        ceiling_m: The height of a ceiling, if there is one. The ground is at 0.
    Raises:
        DatasetError: open3d is missing, or a planar scanner meets a 3D place or the reverse.
    """

    def __init__(
        self,
        path: Path,
        lidar: Lidar,
        indices: range,
        *,
        seed: int,
        slice_m: float | None,
        ceiling_m: float | None,
    ) -> None:
        require()
        if lidar.is_planar != (slice_m is not None):
            raise DatasetError(f"sensor {lidar.name}: a planar scanner is for 2D places, and only that")
        super().__init__(path)
        self.lidar, self.indices = lidar, indices
        self.slice_m, self.ceiling_m = slice_m, ceiling_m
        self._seed = seed
        self._directions = lidar.directions()

    @abstractmethod
    def pose(self, time_s: float) -> Float64:
        """(4, 4) T_map_sensor; z is 0 if the place is 2D."""

    @abstractmethod
    def occupied(self, points: ArrayLike, time_s: float = 0.0) -> Bool:
        """(N,) the exact truth at points (N, 3) m, map frame; z is ignored if the place is 2D."""

    @abstractmethod
    def solid_surfaces(self, eye: Float64, directions: Float64, time_s: float) -> Surfaces:
        """What rays from a point (3,) m along unit directions (N, 3) meet first, ground and ceiling apart.

        Normals may be on either side.
        """

    def eye(self, pose: Float64) -> Float64:
        """(3,) m: where the sensor of a pose is in the place, at its true height."""
        eye: Float64 = pose[:3, 3].copy()
        if self.slice_m is not None:
            eye[2] = self.slice_m
        return eye

    def cast(self, eye: Float64, directions: Float64, time_s: float = 0.0) -> Surfaces:
        """The first surface, of whatever kind, from a point (3,) m at its true height along unit directions (N, 3)."""
        range_m, normals = self.solid_surfaces(eye, directions, time_s)
        rise = directions[:, 2]
        for height_m, rows in ((_GROUND_Z_M, rise < 0), (self.ceiling_m, rise > 0)):
            if height_m is None:
                continue
            towards = np.flatnonzero(rows)
            plane_m = (height_m - eye[2]) / rise[towards]
            nearer = plane_m < range_m[towards]
            range_m[towards[nearer]] = plane_m[nearer]
            normals[towards[nearer]] = (0.0, 0.0, 1.0)
        return Surfaces(range_m, -normals * np.sign(np.einsum("nd,nd->n", normals, directions))[:, None])

    def __len__(self) -> int:
        return len(self.indices)

    def read(self, i: int) -> RecordedScan:
        k = self.indices[i]
        time_s = k * PERIOD_S
        lidar = self.lidar
        pose = self.pose(time_s)
        range_m = self.cast(self.eye(pose), self._directions @ pose[:3, :3].T, time_s).range_m
        rng = stream(self._seed, 9, k)
        is_return = range_m < lidar.max_range_m
        noise = rng.normal(0.0, lidar.noise_m, len(range_m)) if lidar.noise_m else 0.0
        measured = np.where(is_return, np.minimum(range_m + noise, lidar.max_range_m), lidar.max_range_m)
        kept = (range_m >= lidar.min_range_m) & (measured > 0) & (rng.random(len(range_m)) >= lidar.dropout)
        return RecordedScan(
            points=(self._directions[kept] * measured[kept, None]).astype(np.float32),
            is_return=is_return[kept],
            T_map_sensor=pose,
            stamp_ns=round(time_s * 1e9),
            name=f"{self.path}#{k}",
            is_planar=lidar.is_planar,
        )
