"""How likely a point is occupied by its height above the ground and its distance from the sensor: a logistic model of both.

The log-odds are bilinear between knots, close ones about the ground, where they change most. The ground of one scan is a plane
through the lowest hits about the sensor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from potserver.numerics.arrays import Bool, Float64, Int64
from potserver.numerics.geometry import voxel_pick

HEIGHTS_M = (-2.0, -0.6, -0.3, -0.12, 0.0, 0.12, 0.3, 0.6, 1.0, 1.6, 2.4, 3.5, 5.0, 8.0)
RANGES_M = (0.0, 4.0, 8.0, 14.0, 22.0)
_ALIKE_ALONG_HEIGHT, _ALIKE_ALONG_RANGE = (
    0.3,
    3.0,
)  # precision of the difference of neighbouring knots, 1/log-odds^2
_PRIOR_PRECISION = 0.02
_FIT_STEPS, _LONGEST_STEP = 25, 2.0
_LEAST_CURVATURE = 1e-4
_WORTH = 0.05  # of a label: those of one scan repeat each other
_SURE = 8.0  # log-odds that count no more when models are compared
_CELL_M = 2.0  # of each cell the lowest hit is looked at
_ABOVE_M, _BELOW_M = (
    0.15,
    0.5,
)  # scales of a robust fit: what is above the ground stands on it, little is below
_FLAT_M = 0.04  # of slope, about: the precision of a level ground
_PLANE_STEPS = 20


class HeightModel(NamedTuple):
    """Log-odds of a point that a beam tells about, at knots."""

    heights_m: Float64  # (A,) ascending
    ranges_m: Float64  # (B,) ascending
    log_odds: Float64  # (A, B)

    def at(self, height_m: Float64, range_m: Float64) -> Float64:
        """(N,) log-odds; beyond the outermost knots as on them."""
        i, s = _between(height_m, self.heights_m)
        j, t = _between(range_m, self.ranges_m)
        f = self.log_odds
        low = f[i, j] + t * (f[i, j + 1] - f[i, j])
        high = f[i + 1, j] + t * (f[i + 1, j + 1] - f[i + 1, j])
        return np.asarray(low + s * (high - low))


class HeightModels(NamedTuple):
    """Models of several kinds of places, with the same knots."""

    heights_m: Float64  # (A,) ascending
    ranges_m: Float64  # (B,) ascending
    log_odds: Float64  # (M, A, B)

    def shares(self, labels: HeightLabels) -> Float64:
        """(M,) how likely each makes labels, with a sum of 1."""
        models = [HeightModel(self.heights_m, self.ranges_m, table) for table in self.log_odds]
        nats = np.array([labels.log_likelihood(model) for model in models]) * _WORTH
        share = np.exp(nats - nats.max())
        return np.asarray(share / share.sum())

    def mixed(self, shares: Float64) -> HeightModel:
        """The mean of the models' log-odds, by (M,) shares."""
        return HeightModel(self.heights_m, self.ranges_m, np.tensordot(shares, self.log_odds, 1))


class HeightLabels(NamedTuple):
    """N labelled points, as height models see them."""

    height_m: Float64  # (N,) above the ground
    range_m: Float64  # (N,) from the sensor, horizontally
    occupied: Bool  # (N,)
    weight: Float64  # (N,) how much each counts

    def log_likelihood(self, model: HeightModel) -> float:
        """Of the labels under a model, nats."""
        log_odds = np.clip(model.at(self.height_m, self.range_m), -_SURE, _SURE)
        return -float((self.weight * np.logaddexp(0.0, np.where(self.occupied, -log_odds, log_odds))).sum())


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


def fit_heights(labels: HeightLabels) -> HeightModel:
    """The model that explains labels best, smooth from knot to knot."""
    height_m, range_m, occupied, weight = labels
    weight = _WORTH * weight
    heights, ranges = np.array(HEIGHTS_M), np.array(RANGES_M)
    i, s = _between(height_m, heights)
    j, t = _between(range_m, ranges)
    n = len(ranges)
    corners = np.stack([i * n + j, i * n + j + 1, (i + 1) * n + j, (i + 1) * n + j + 1])
    shares = np.stack([(1 - s) * (1 - t), (1 - s) * t, s * (1 - t), s * t])
    precision = _smoothness(len(heights), n)
    log_odds = np.zeros(len(precision))
    for _ in range(_FIT_STEPS):
        f = (log_odds[corners] * shares).sum(axis=0)
        p = 1.0 / (1.0 + np.exp(-f))
        gradient = precision @ log_odds
        np.add.at(gradient, corners, shares * (weight * (p - occupied)))
        curvature = weight * p * (1 - p) + _LEAST_CURVATURE
        hessian = precision.copy()
        for a in range(4):
            for b in range(4):
                np.add.at(hessian, (corners[a], corners[b]), shares[a] * shares[b] * curvature)
        log_odds = log_odds - np.clip(np.linalg.solve(hessian, gradient), -_LONGEST_STEP, _LONGEST_STEP)
    return HeightModel(heights, ranges, log_odds.reshape(len(heights), n))


def _between(values: Float64, knots: Float64) -> tuple[Int64, Float64]:
    """(N,) the knot below each value, and (N,) how far it is on the way to the next, in [0, 1]."""
    inside = np.clip(values, knots[0], knots[-1])
    below = np.clip(np.searchsorted(knots, inside, side="right") - 1, 0, len(knots) - 2)
    return below, (inside - knots[below]) / (knots[below + 1] - knots[below])


def _smoothness(n_heights: int, n_ranges: int) -> Float64:
    """Precision of all knots: neighbours are alike."""
    number = np.arange(n_heights * n_ranges).reshape(n_heights, n_ranges)
    precision = _PRIOR_PRECISION * np.eye(number.size)
    along_height = (number[:-1].ravel(), number[1:].ravel(), _ALIKE_ALONG_HEIGHT)
    along_range = (number[:, :-1].ravel(), number[:, 1:].ravel(), _ALIKE_ALONG_RANGE)
    for one, other, alike in (along_height, along_range):
        for a, b in zip(one, other, strict=True):
            precision[[a, b], [a, b]] += alike
            precision[[a, b], [b, a]] -= alike
    return precision
