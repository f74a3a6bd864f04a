"""A small made-up scene, ray cast in numpy: for load tests and examples, where no recording is at hand."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import as_points
from potclient.arrays import Bool, Float64
from potclient.datasets.scans import RecordedScan, Recording
from potclient.poses import yaw_pose

_GROUND_Z_M = 0.0
_WALL_M = 0.5


class GeneratedScene:
    """A walled yard with boxes on a flat ground, and a sensor that drives round it. Same seed, same scene and scans.

    Args:
        seed: Chooses boxes, noise and drop-outs.
        planar: A 2D scanner at z = 0 instead of a 3D one at 1.5 m.
        n_beams: Beams of a scan.
        size_m: Edge of the yard.
        max_range_m: Beams that hit nothing before it come back without an echo, free up to there.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        planar: bool = False,
        n_beams: int = 5760,
        size_m: float = 40.0,
        n_boxes: int = 14,
        max_range_m: float = 25.0,
        noise_m: float = 0.02,
    ) -> None:
        self.seed, self.planar, self.size_m = seed, planar, size_m
        self.max_range_m, self.noise_m = max_range_m, noise_m
        self._path_radius_m = size_m / 4
        rng = np.random.default_rng(seed)
        half = size_m / 2
        walls = [
            ([-half, -half, -1], [half, -half + _WALL_M, 3]),
            ([-half, half - _WALL_M, -1], [half, half, 3]),
            ([-half, -half, -1], [-half + _WALL_M, half, 3]),
            ([half - _WALL_M, -half, -1], [half, half, 3]),
        ]
        boxes: list[tuple[list[float], list[float]]] = []
        while len(boxes) < n_boxes:
            size = rng.uniform([0.5, 0.5, 1.8], [4.0, 4.0, 3.5])
            center = rng.uniform(-half + 1, half - 1, 2)
            clearance = abs(math.hypot(*center) - self._path_radius_m) - math.hypot(size[0], size[1]) / 2
            if clearance > 1.0:  # the sensor's way stays free
                lower = [center[0] - size[0] / 2, center[1] - size[1] / 2, -1.0]
                boxes.append((lower, [center[0] + size[0] / 2, center[1] + size[1] / 2, size[2]]))
        self._lower = np.array([b[0] for b in walls + boxes], np.float64)  # (B, 3) m
        self._upper = np.array([b[1] for b in walls + boxes], np.float64)
        self._directions = _directions(n_beams, planar)

    def pose(self, k: int, n_loop: int = 100) -> Float64:
        """(4, 4): where the sensor is at step k of a round of `n_loop` steps, looking ahead."""
        angle = 2 * math.pi * k / n_loop
        x, y = self._path_radius_m * math.cos(angle), self._path_radius_m * math.sin(angle)
        return yaw_pose(x, y, angle + math.pi / 2, 0.0 if self.planar else 1.5)

    def scan(self, k: int, n_loop: int = 100, period_s: float = 0.1) -> RecordedScan:
        """Scan k from `pose(k)`."""
        rng = np.random.default_rng((self.seed, k))
        pose = self.pose(k, n_loop)
        range_m = self._cast(pose[:3, 3], self._directions @ pose[:3, :3].T)
        is_return = range_m < self.max_range_m
        range_m = np.where(is_return, range_m + rng.normal(0, self.noise_m, len(range_m)), self.max_range_m)
        return RecordedScan(
            points=(self._directions * range_m[:, None]).astype(np.float32),
            is_return=is_return,
            T_map_sensor=pose,
            stamp_ns=round((k + 1) * period_s * 1e9),
            name=f"generated:{self.seed}:{k}",
            is_planar=self.planar,
        )

    def is_occupied(self, points: ArrayLike) -> Bool:
        """(N,) the exact truth at points (N, 3) or (N, 2), m, map frame: inside a box or wall, or under the ground."""
        p = as_points(points)
        inside = np.zeros(len(p), np.bool_)
        for lower, upper in zip(self._lower, self._upper, strict=True):
            inside |= ((p >= lower) & (p <= upper)).all(axis=1)
        return inside if self.planar else inside | (p[:, 2] < _GROUND_Z_M)

    def _cast(self, origin: Float64, directions: Float64) -> Float64:
        """(N,) m: range of the first surface along unit directions (N, 3) in the map frame; inf if there is none."""
        d = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
        nearest = np.full(len(d), np.inf)
        for lower, upper in zip(self._lower, self._upper, strict=True):
            a, b = (lower - origin) / d, (upper - origin) / d
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (enter <= leave) & (enter > 0)
            nearest[hit] = np.minimum(nearest[hit], enter[hit])
        if not self.planar:
            down = d[:, 2] < -1e-9
            nearest[down] = np.minimum(nearest[down], (_GROUND_Z_M - origin[2]) / d[down, 2])
        return nearest


class GeneratedRecording(Recording):
    """Scans of a generated scene as a recording."""

    format = "generated"

    def __init__(self, scene: GeneratedScene, n_scans: int) -> None:
        super().__init__(Path("generated"))
        self.scene, self._n_scans = scene, n_scans
        self.notes = (f"made-up {'2D' if scene.planar else '3D'} scene, seed {scene.seed}",)

    def __len__(self) -> int:
        return self._n_scans

    def read(self, i: int) -> RecordedScan:
        return self.scene.scan(i, n_loop=max(self._n_scans, 1))


def _directions(n_beams: int, planar: bool) -> Float64:
    """(n_beams, 3) unit vectors, sensor frame."""
    if planar:
        azimuth, elevation = np.linspace(-math.pi, math.pi, n_beams, endpoint=False), np.zeros(n_beams)
    else:
        n_rings = max(1, min(64, round(math.sqrt(n_beams / 22))))
        ring = np.arange(n_beams) % n_rings
        azimuth = -math.pi + 2 * math.pi * np.arange(n_beams) / n_beams
        elevation = np.radians(-25.0 + 40.0 * ring / max(1, n_rings - 1))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)
