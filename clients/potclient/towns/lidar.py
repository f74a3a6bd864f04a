"""LiDARs: which beams they have, how far they see and how well."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from potclient.arrays import Float64
from potclient.errors import DatasetError


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Lidar:
    """A spinning (or planar) laser scanner.

    A beam that meets nothing before `max_range_m` is delivered without an echo, free up to there. A drop-out is a beam that
    is not delivered at all, and so is one that meets something nearer than `min_range_m`.
    """

    name: str
    elevations_rad: tuple[float, ...]  # one a ring, downwards negative
    n_azimuth: int
    fov_rad: float = 2 * math.pi  # about the direction ahead
    min_range_m: float = 0.9
    max_range_m: float = 80.0
    noise_m: float = 0.02  # standard deviation of a range
    dropout: float = 0.02  # share of beams
    is_planar: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.min_range_m < self.max_range_m or self.noise_m < 0 or not 0 <= self.dropout < 1:
            raise DatasetError(
                f"sensor {self.name}: need 0 <= min < max range, noise >= 0 and drop-outs in [0, 1)"
            )

    def directions(self) -> Float64:
        """(rings * n_azimuth, 3) unit vectors, sensor frame, ring by ring from right to left."""
        full = self.fov_rad > 2 * math.pi - 1e-9
        azimuth = np.linspace(-self.fov_rad / 2, self.fov_rad / 2, self.n_azimuth, endpoint=not full)
        elevation, azimuth = np.meshgrid(np.array(self.elevations_rad), azimuth, indexing="ij")
        flat = np.cos(elevation)
        beams = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
        return np.asarray(beams.reshape(-1, 3))


def _degrees(*values: float) -> tuple[float, ...]:
    return tuple(math.radians(v) for v in values)


SENSORS = {
    sensor.name: sensor
    for sensor in (
        # 32 rings a third of a degree apart from +2 degrees down, then 32 half a degree apart
        Lidar(
            name="hdl64",
            elevations_rad=_degrees(*(2.0 - k / 3 for k in range(32)), *(-8.83 - k / 2 for k in range(32))),
            n_azimuth=1024,
        ),
        Lidar(
            name="vlp16",
            elevations_rad=_degrees(*range(-15, 16, 2)),
            n_azimuth=900,
            noise_m=0.03,
            min_range_m=0.5,
        ),
        Lidar(
            name="os64",
            elevations_rad=_degrees(*np.linspace(-45, 45, 64).tolist()),
            n_azimuth=1024,
            min_range_m=0.3,
            max_range_m=35.0,
        ),
        Lidar(
            name="planar360",
            elevations_rad=(0.0,),
            n_azimuth=720,
            min_range_m=0.1,
            max_range_m=30.0,
            noise_m=0.01,
            dropout=0.01,
            is_planar=True,
        ),
        Lidar(
            name="planar180",
            elevations_rad=(0.0,),
            n_azimuth=181,
            fov_rad=math.pi,
            min_range_m=0.1,
            max_range_m=30.0,
            noise_m=0.01,
            dropout=0.01,
            is_planar=True,
        ),
    )
}
