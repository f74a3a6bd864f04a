"""Rows of evidence from points, for tests."""

from __future__ import annotations

import numpy as np

from potserver.numerics.evidence import Rows, add

FINE_M = 0.4


def rows_of(points, occupied, weight=None) -> Rows:
    """The rows of some points, of weight 1 unless another is given."""
    points = np.atleast_2d(np.asarray(points, float))
    occupied = np.broadcast_to(occupied, len(points))
    return add(
        Rows.empty(), points, occupied, np.ones(len(points)) if weight is None else weight, FINE_M
    ).rows
