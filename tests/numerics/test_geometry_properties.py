"""Sectors and thinning, whatever the points."""

from __future__ import annotations

import itertools
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from potserver.numerics.geometry import (
    in_sector,
    rotated_diagonal,
    rotation_z,
    sector_edges,
    thin,
    voxel_pick,
)

ANGLES = st.floats(-10.0, 10.0)
SEEDS = st.integers(0, 2**31)


@given(n=st.integers(1, 12), heading=ANGLES, angles=st.lists(ANGLES, min_size=1, max_size=30))
def test_every_point_is_in_exactly_one_sector(n: int, heading: float, angles: list[float]) -> None:
    edges = sector_edges(n)
    bearing = np.concatenate([angles, heading + edges])
    points = np.stack([np.cos(bearing), np.sin(bearing), np.zeros(len(bearing))], axis=1)
    count = sum(
        in_sector(points, heading + low, heading + high, 2.0).astype(int)
        for low, high in itertools.pairwise(edges)
    )
    np.testing.assert_array_equal(count, 1)


@given(seed=SEEDS, low=ANGLES, width=st.floats(0.01, 2 * math.pi), turn=ANGLES)
def test_turning_points_and_sector_together_changes_no_membership(
    seed: int, low: float, width: float, turn: float
) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, 50)
    # not within a millionth of an edge
    inside = (angle - low) % (2 * np.pi)
    angle = angle[(np.abs(inside - width) > 1e-6) & (inside > 1e-6) & (inside < 2 * np.pi - 1e-6)]
    points = np.stack([5 * np.cos(angle), 5 * np.sin(angle), 0 * angle], axis=1)
    before = in_sector(points, low, low + width, 6.0)
    np.testing.assert_array_equal(before, ((angle - low) % (2 * np.pi)) < width)
    np.testing.assert_array_equal(
        before, in_sector(points @ rotation_z(turn).T, low + turn, low + width + turn, 6.0)
    )


@given(seed=SEEDS, n=st.integers(0, 300), n_max=st.integers(1, 100), voxel=st.floats(0.05, 5.0))
def test_thinned_points_are_a_cover_of_one_point_a_voxel(seed: int, n: int, n_max: int, voxel: float) -> None:
    points = np.random.default_rng(seed).normal(size=(n, 3)) * 3.0
    cells = np.floor(points / voxel)
    every = voxel_pick(points, voxel)
    kept = thin(points, n_max, voxel, np.random.default_rng(seed))
    assert len(kept) == min(len(every), n_max)
    assert np.isin(kept, every).all()
    assert len(np.unique(cells[every], axis=0)) == len(every) == len(np.unique(cells, axis=0))


@given(seed=SEEDS, angle=ANGLES)
def test_a_turned_diagonal_keeps_its_trace_and_stays_positive(seed: int, angle: float) -> None:
    variance = np.random.default_rng(seed).uniform(1e-3, 5.0, (10, 3))
    turned = rotated_diagonal(variance, rotation_z(angle))
    np.testing.assert_allclose(turned.sum(axis=1), variance.sum(axis=1))
    np.testing.assert_allclose(turned[:, 2], variance[:, 2])
    assert (turned > 0).all()
