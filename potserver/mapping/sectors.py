"""Cut the surroundings of a sensor into cylindrical sectors (paper, section III-A; in 3D a pie slice of any height)."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.types import Bool, Float64, Sector
from potserver.numerics.beams import LabelledPoints
from potserver.numerics.geometry import in_sector, rotation_z, sector_edges, yaw_of


class SectorCut(NamedTuple):
    """How the surroundings of a sensor are cut."""

    n_sectors: int = 6
    is_aligned: bool = True  # each sector's x axis is its bisector, as in atoms; false: the map's x axis


class SectorFrame(NamedTuple):
    """One sector about a sensor. Its frame has the sensor as origin and is turned about the vertical."""

    number: int
    azimuth_min_rad: float  # inclusive, map axes
    azimuth_max_rad: float  # exclusive
    radius_m: float
    turn_rad: float  # of the sector's x axis in the map

    def inside(self, points: NDArray[np.floating]) -> Bool:
        """(N,) which of (N, 3) points lie in the sector; m, map axes, the sensor as origin."""
        return in_sector(points, self.azimuth_min_rad, self.azimuth_max_rad, self.radius_m)

    def local(self, points: Float64) -> Float64:
        """(N, 3) m in the sector's frame, from (N, 3) m with map axes and the sensor as origin."""
        return points @ rotation_z(self.turn_rad)  # R^T p, row by row

    @property
    def width_rad(self) -> float:
        """Between its two azimuths."""
        return self.azimuth_max_rad - self.azimuth_min_rad


def sector_frames(T_map_sensor: Float64, radius_m: float, cut: SectorCut) -> list[SectorFrame]:
    """The sectors about a sensor, counter-clockwise, the first one centred on the sensor's heading."""
    heading = yaw_of(T_map_sensor)
    return [
        SectorFrame(
            number, heading + low, heading + high, radius_m,
            turn_rad=heading + (low + high) / 2.0 if cut.is_aligned else 0.0,
        )
        for number, (low, high) in enumerate(itertools.pairwise(sector_edges(cut.n_sectors)))
    ]  # fmt: skip


def cut_sectors(
    labelled: LabelledPoints, T_map_sensor: Float64, radius_m: float, cut: SectorCut
) -> list[Sector]:
    """A scan's labelled points by sector.

    Args:
        labelled: N points, m, map axes, the sensor as origin.
        T_map_sensor: (4, 4) pose of the sensor.
        radius_m: Horizontal reach of a sector.
        cut: How many sectors, and how their frames lie.
    """
    sectors = []
    for frame in sector_frames(T_map_sensor, radius_m, cut):
        members = frame.inside(labelled.points)
        local = frame.local(labelled.points).astype(np.float32)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation_z(frame.turn_rad), T_map_sensor[:3, 3]
        sectors.append(
            Sector(
                azimuth_min_rad=frame.azimuth_min_rad - frame.turn_rad,
                azimuth_max_rad=frame.azimuth_max_rad - frame.turn_rad,
                radius_m=radius_m,
                hit_points=local[members & labelled.occupied],
                free_points=local[members & ~labelled.occupied],
                T_map_sector=pose,
            )
        )
    return sectors
