"""Scores of probabilities against truth, as sums over points: they can be added up, discounted, and divided at the end.

`potclient.metrics` scores the same way from whole arrays; a test holds the two together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

N_BINS = 15  # of equal width, for the calibration error
_CLIP = 1e-6  # probabilities are clipped to [_CLIP, 1 - _CLIP] before the logarithm

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


def nll_sum(p: Float64, occupied: Bool) -> float:
    """Negative log-likelihood, nats, summed over (N,) points of P(occupied) `p` and truth `occupied`."""
    clipped = np.clip(p, _CLIP, 1.0 - _CLIP)
    return float(-np.log(np.where(occupied, clipped, 1.0 - clipped)).sum())


def brier_sum(p: Float64, occupied: Bool) -> float:
    """Squared error, summed over (N,) points."""
    return float(np.square(p - occupied).sum())


def calibration_bins(p: Float64, occupied: Bool) -> Float64:
    """(N_BINS, 3): the number of points in each bin of `p`, the sum of their `p`, and how many are occupied."""
    member = np.minimum((p * N_BINS).astype(np.int64), N_BINS - 1)
    columns = (np.ones(len(p)), p, occupied.astype(np.float64))
    return np.stack([np.bincount(member, column, N_BINS) for column in columns], axis=1)


def calibration_error(bins: Float64, n_points: float) -> float:
    """Expected calibration error of `calibration_bins` that hold `n_points` > 0 points."""
    return float(np.abs(bins[:, 1] - bins[:, 2]).sum()) / n_points


def auc(occupied: NDArray[np.floating], free: NDArray[np.floating]) -> float:
    """Area under the ROC curve: how often a point of the first kind scores above one of the second; ties count half.

    Args:
        occupied: (P,) scores of occupied points, P > 0.
        free: (Q,) scores of free points, Q > 0.
    """
    ordered = np.sort(free)
    below = np.searchsorted(ordered, occupied, "left") + np.searchsorted(ordered, occupied, "right")
    return float(below.mean() / (2 * len(ordered)))
