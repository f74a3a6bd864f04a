"""The exact truth about the space around a drive through a made-up place: what is solid, and what was ever in sight."""

from __future__ import annotations

import dataclasses

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potclient.towns import Surfaces, SurveyedRecording
from potserver.evaluation.beams import Beams
from potserver.evaluation.neighbours import within

BAND_M = 3.0  # above the ground: points drawn from volumes lie below that
_FAR_FROM_HITS_M = 0.3  # space out of sight and farther from any hit is unseen
_AT_THE_SENSOR_M = 0.05


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Surroundings:
    """A place, the poses from which it was scanned, and the beams that no map was given."""

    place: SurveyedRecording
    poses: list[Float64]  # (4, 4) T_map_sensor of each scan
    times_s: list[float]  # of each scan
    hits: Float64  # (N, 3) m, map frame: of all scans, held-out ones too
    beams: Beams  # held out

    @property
    def planar(self) -> bool:
        return self.place.slice_m is not None

    @property
    def track(self) -> Float64:
        """(N, 3) m: where the sensor was."""
        return np.stack(self.poses)[:, :3, 3]

    def occupied(self, points: Float64) -> Bool:
        """(N,) the truth at the time of the last scan."""
        return self.place.occupied(points, self.times_s[-1])

    def surfaces(self, origins: Float64, directions: Float64) -> Surfaces:
        """What rays from (N, 3) m in the map frame meet at the time of the last scan."""
        range_m, normals = np.full(len(origins), np.inf), np.zeros((len(origins), 3))
        eyes, of = np.unique(origins, axis=0, return_inverse=True)
        for k, eye in enumerate(eyes):
            rows = np.flatnonzero(of.ravel() == k)
            found = self.place.cast(self._at_true_height(eye), directions[rows], self.times_s[-1])
            range_m[rows], normals[rows] = found
        return Surfaces(range_m, normals)

    def unseen(self, points: Float64) -> Bool:
        """(N,) points that were in no scan's line of sight and are more than 0.3 m from any hit."""
        far = np.flatnonzero(~within(self.hits, points, _FAR_FROM_HITS_M))
        unseen = np.zeros(len(points), np.bool_)
        unseen[far] = ~self._in_sight(points[far])
        return unseen

    def _in_sight(self, points: Float64) -> Bool:
        lidar = self.place.lidar
        lowest, highest = min(lidar.elevations_rad), max(lidar.elevations_rad)
        seen = np.zeros(len(points), np.bool_)
        for pose, time_s in zip(self.poses, self.times_s, strict=True):
            beams = points - pose[:3, 3]
            if self.planar:
                beams[:, 2] = 0.0
            range_m = np.linalg.norm(beams, axis=1)
            rows = np.flatnonzero(~seen & (range_m > _AT_THE_SENSOR_M) & (range_m < lidar.max_range_m))
            directions = beams[rows] / range_m[rows, None]
            local = directions @ pose[:3, :3]
            elevation, azimuth = np.arcsin(np.clip(local[:, 2], -1, 1)), np.arctan2(local[:, 1], local[:, 0])
            within_view = np.abs(azimuth) <= lidar.fov_rad / 2
            if not self.planar:
                within_view &= (elevation >= lowest) & (elevation <= highest)
            rows, directions = rows[within_view], directions[within_view]
            surfaces = self.place.cast(self.place.eye(pose), directions, time_s)
            seen[rows] = surfaces.range_m > range_m[rows]
        return seen

    def _at_true_height(self, eye: Float64) -> Float64:
        return np.array([*eye[:2], eye[2] if self.place.slice_m is None else self.place.slice_m])

    def uniform_points(self, n: int, reach_m: float, rng: np.random.Generator) -> Float64:
        """(n, 3) m: uniform in a disc about a random place of the way, up to 3 m or the ceiling above the ground."""
        centre = self.track[rng.integers(0, len(self.track), n)]
        angle, radius = rng.uniform(0, 2 * np.pi, n), reach_m * np.sqrt(rng.random(n))
        top = BAND_M if self.place.ceiling_m is None else self.place.ceiling_m
        height = np.zeros(n) if self.planar else rng.uniform(0, top, n)
        return np.stack(
            [centre[:, 0] + radius * np.cos(angle), centre[:, 1] + radius * np.sin(angle), height], axis=1
        )

    def hits_to_draw_from(self, n: int, rng: np.random.Generator) -> Float64:
        """(at most n, 3) m: held-out hits."""
        hits = self.beams.hits
        return hits[rng.permutation(len(hits))[:n]]


class Visits:
    """Collects poses and hits while scans are read."""

    def __init__(self) -> None:
        self.poses: list[Float64] = []
        self.times_s: list[float] = []
        self._hits: list[Float64] = []

    def add(self, scan: RecordedScan) -> None:
        """A scan is taken."""
        self.poses.append(scan.T_map_sensor)
        self.times_s.append(scan.stamp_ns / 1e9)
        self._hits.append(scan.in_map[scan.is_return])

    def of(self, place: SurveyedRecording, beams: Beams) -> Surroundings:
        """The place around all of them."""
        hits = np.concatenate([*self._hits, beams.hits])
        return Surroundings(place=place, poses=self.poses, times_s=self.times_s, hits=hits, beams=beams)
