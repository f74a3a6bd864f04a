"""Cubes hold every point once, and groups of cubes hold neighbours."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from potserver.numerics.cubes import sort_into_cubes


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e6])
def test_cubes_hold_neighbours_together(scale: float) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (2000, 3)) * scale
    order, cuts, groups = sort_into_cubes(points, 1.0)
    np.testing.assert_array_equal(np.sort(order), np.arange(2000))
    assert cuts[0] == 0
    assert cuts[-1] == 2000
    assert groups[0] == 0
    assert groups[-1] == len(cuts) - 1
    assert (np.diff(cuts) > 0).all()
    assert (np.diff(groups) > 0).all()
    if scale == 1.0:
        for a, b in itertools.pairwise(cuts):
            assert (np.ptp(points[order[a:b]], axis=0) <= 1.0).all()
