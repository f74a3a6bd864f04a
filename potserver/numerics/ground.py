"""The ground of one scan: a plane through the lowest hits about the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.numerics.arrays import Float64
from potserver.numerics.geometry import voxel_pick

LEAST_GROUND = 6  # cells of a scan's surroundings that lie on one plane
LOWEST_EYE_M = 0.3  # above it: a sensor on the ground itself tells nothing about heights
_CELL_M = 2.0  # of each cell the lowest hit is looked at
# scales of a robust fit: what is above the ground stands on it, little is below
_ABOVE_M, _BELOW_M = 0.15, 0.5
_FLAT_M = 0.04  # of slope, about: the precision of a level ground
_PLANE_STEPS = 20


class Ground(NamedTuple):
    """A plane z = height_m + slope_x x + slope_y y."""

    height_m: float
    slope_x: float
    slope_y: float
    n_near: int  # cells whose lowest hit lies on it

    def below(self, points: Float64) -> Float64:
        """(N,) m: the heights of (N, 3) points above the plane."""
        level = self.height_m + points[:, 0] * self.slope_x + points[:, 1] * self.slope_y
        return np.asarray(points[:, 2] - level)


def ground_of(hits: Float64) -> Ground:
    """The ground below a scan's hits: a robust plane through the lowest of each cell.

    Args:
        hits: (N, 3) m, N > 0, the sensor as origin, z up.
    """
    upwards = hits[np.argsort(hits[:, 2], kind="stable")]
    lowest = upwards[voxel_pick(upwards * (1.0, 1.0, 0.0), _CELL_M)]
    z, A = lowest[:, 2], np.column_stack([np.ones(len(lowest)), lowest[:, :2]])
    slack = len(lowest) * _FLAT_M**2 * 100.0
    ridge = np.diag([1e-6, slack, slack])
    weight = np.exp(-np.maximum(z - np.percentile(z, 10), 0.0) / _BELOW_M)
    plane = np.zeros(3)
    for _ in range(_PLANE_STEPS):
        plane = np.linalg.solve((A.T * weight) @ A + ridge, A.T @ (weight * z))
        off = z - A @ plane
        weight = 1.0 / (1.0 + np.square(off / np.where(off > 0, _ABOVE_M, _BELOW_M)))
    is_near = np.abs(z - A @ plane) < _ABOVE_M
    height, slope_x, slope_y = (float(v) for v in plane)
    return Ground(height, slope_x, slope_y, int(is_near.sum()))
