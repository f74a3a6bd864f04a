"""A scene of known openings, poles and wires, to see what a map leaves of them: `gauntlet[:SENSOR][:SEED]`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import ArrayLike

from potclient.arguments import as_points
from potclient.arrays import Bool, Float64
from potclient.datasets.scans import RecordedScan
from potclient.errors import DatasetError
from potclient.towns.lidar import SENSORS, Lidar
from potclient.towns.raycast import RayScene
from potclient.towns.solids import Kind, Part, SolidSet, box, post
from potclient.towns.surveyed import PERIOD_S, Surfaces, SurveyedRecording

N_SCANS = 20
_WALL_M, _WALL_TOP_M = 0.2, 2.4  # thickness and height of the walls with openings
_SLICE_M, _SENSOR_M = 0.7, 1.73  # height of a planar scanner, and of another
_HALF_WAY_M, _HALF_WALL_M = 9.0, 9.0
_YARD_M = ((-14.1, -10.7, 0.0), (14.1, 8.2, 3.0))  # lower and upper corner of the walls around all


class Opening(NamedTuple):
    """A doorway through a wall along x."""

    x_m: float  # of its middle
    y_m: float  # of the middle of the wall
    width_m: float
    away_m: float  # from the sensor's way to the wall


class Pole(NamedTuple):
    """An upright post."""

    x_m: float
    y_m: float
    diameter_m: float


class Wire(NamedTuple):
    """A square wire along x."""

    y_m: float
    z_m: float
    diameter_m: float


OPENINGS = tuple(
    Opening(-7.5 + 3.0 * k, y + np.sign(y) * _WALL_M / 2, width, abs(y))
    for y in (3.5, -6.0)
    for k, width in enumerate((0.7, 0.9, 1.2) * 2)
)
POLES = tuple(
    Pole(-8.25 + 1.5 * k, 2.0 if k < 6 else -3.5, diameter) for k, diameter in enumerate((0.05, 0.1, 0.2) * 4)
)
POLE_TOP_M = 2.4
WIRES = tuple(Wire(2.6, 1.4 + 0.3 * k, diameter) for k, diameter in enumerate((0.01, 0.02, 0.03)))
WIRE_HALF_M = 8.0


class GauntletRecording(SurveyedRecording):
    """Scans along a straight way between walls with openings, poles and wires. A slice is such a recording too.

    Args:
        lidar: A planar one sees the slice at its height: there are no wires.
        indices: Which of the scans.
        seed: Of noise and drop-outs.
        name: For people.
    Raises:
        DatasetError: open3d is missing.
    """

    format = "gauntlet"
    notes = ("made-up scene: doorways of 0.7 to 1.2 m, poles of 5 to 20 cm, wires of 1 to 3 cm",)

    def __init__(self, lidar: Lidar, indices: range, *, seed: int = 0, name: str = "gauntlet") -> None:
        slice_m = _SLICE_M if lidar.is_planar else None
        super().__init__(Path(name), lidar, indices, seed=seed, slice_m=slice_m, ceiling_m=None)
        self._solids = SolidSet(_parts())
        self._scene = RayScene([self._solids], np.zeros(2))

    @overload
    def __getitem__(self, index: int) -> RecordedScan: ...
    @overload
    def __getitem__(self, index: slice) -> GauntletRecording: ...
    def __getitem__(self, index: int | slice) -> RecordedScan | GauntletRecording:
        if isinstance(index, slice):
            return GauntletRecording(self.lidar, self.indices[index], seed=self._seed, name=str(self.path))
        return super().__getitem__(index)

    def pose(self, time_s: float) -> Float64:
        k = time_s / PERIOD_S
        yaw = 0.13 * k  # so that no beam points where one of another scan does
        pose = np.eye(4)
        pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        pose[0, 3] = -_HALF_WAY_M + 2 * _HALF_WAY_M * k / (N_SCANS - 1)
        pose[1, 3] = 0.05 * np.sin(2.1 * k)
        pose[2, 3] = _SENSOR_M if self.slice_m is None else 0.0
        return pose

    def occupied(self, points: ArrayLike, time_s: float = 0.0) -> Bool:
        p = np.array(as_points(points))
        if self.slice_m is not None:
            p[:, 2] = self.slice_m
        return self._solids.contains(p) | (p[:, 2] < 0.0)

    def solid_surfaces(self, eye: Float64, directions: Float64, time_s: float) -> Surfaces:
        range_m, _, normals = self._scene.cast(eye, directions)
        return Surfaces(range_m, normals.astype(np.float64))


def _parts() -> list[Part]:
    parts = []
    for y_m in dict.fromkeys(opening.y_m for opening in OPENINGS):
        edges = [-_HALF_WALL_M]
        for opening in OPENINGS:
            if opening.y_m == y_m:
                edges += [opening.x_m - opening.width_m / 2, opening.x_m + opening.width_m / 2]
        edges.append(_HALF_WALL_M)
        for x0, x1 in zip(edges[::2], edges[1::2], strict=True):
            lower, upper = (x0, y_m - _WALL_M / 2, 0.0), (x1, y_m + _WALL_M / 2, _WALL_TOP_M)
            parts.append(box(lower, upper, Kind.WALL))
    parts += [post(p.x_m, p.y_m, 0.0, POLE_TOP_M, p.diameter_m / 2, Kind.POLE) for p in POLES]
    for y_m, z_m, diameter_m in WIRES:
        r = diameter_m / 2
        lower, upper = (-WIRE_HALF_M, y_m - r, z_m - r), (WIRE_HALF_M, y_m + r, z_m + r)
        parts.append(box(lower, upper, Kind.POLE))
    (x0, y0, z0), (x1, y1, z1) = _YARD_M
    for lower, upper in (
        ((x0, y0, z0), (x0 + _WALL_M, y1, z1)),
        ((x1 - _WALL_M, y0, z0), (x1, y1, z1)),
        ((x0, y0, z0), (x1, y0 + _WALL_M, z1)),
        ((x0, y1 - _WALL_M, z0), (x1, y1, z1)),
    ):
        parts.append(box(lower, upper, Kind.BUILDING))
    return parts


def open_gauntlet(
    path: str, *, min_range_m: float = 0.0, max_range_m: float | None = None
) -> GauntletRecording:
    """The recording that a path `gauntlet[:SENSOR][:SEED]` names; by default `hdl64`.

    Args:
        min_range_m: Beams that end nearer are dropped, if the sensor does not drop them anyway.
        max_range_m: A shorter reach than the sensor's.
    Raises:
        DatasetError: not such a path, or open3d is missing.
    """
    sensor, seed = "hdl64", 0
    for word in path.split(":")[1:]:
        if word in SENSORS:
            sensor = word
        elif word.isascii() and word.isdigit():
            seed = int(word)
        else:
            raise DatasetError(
                f"{path}: {word!r} is neither a seed nor a sensor of {', '.join(SENSORS)}; e.g. gauntlet:vlp16:7"
            )
    lidar = SENSORS[sensor]
    lidar = dataclasses.replace(
        lidar,
        min_range_m=max(min_range_m, lidar.min_range_m),
        max_range_m=lidar.max_range_m if max_range_m is None else min(max_range_m, lidar.max_range_m),
    )
    return GauntletRecording(lidar, range(N_SCANS), seed=seed, name=path)
