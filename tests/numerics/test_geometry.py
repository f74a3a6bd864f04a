"""Sectors, rotations, thinning."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from potserver.numerics.geometry import (
    bounds,
    in_sector,
    inside_box,
    rotated_diagonal,
    rotation_z,
    sector_edges,
    thin,
    voxel_pick,
)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6, 8])
def test_sectors_share_no_point_and_miss_none_even_on_their_edges(n: int) -> None:
    edges = sector_edges(n)
    for heading in np.linspace(-4.0, 4.0, 41):
        on = heading + edges
        angle = np.concatenate(
            [on, np.nextafter(on, 99), np.nextafter(on, -99), np.linspace(-np.pi, np.pi, 97)]
        )
        angle = np.concatenate([angle, np.arctan2(np.sin(angle), np.cos(angle))])
        points = np.stack([3 * np.cos(angle), 3 * np.sin(angle), 0 * angle], axis=1)
        hits = sum(
            in_sector(points, heading + low, heading + high, 10.0).astype(int)
            for low, high in itertools.pairwise(edges)
        )
        np.testing.assert_array_equal(hits, 1)


def test_the_first_sector_is_centred_on_the_heading() -> None:
    edges = sector_edges(6)
    assert edges[0] == pytest.approx(-math.pi / 6)
    assert edges[1] == pytest.approx(math.pi / 6)
    assert edges[-1] - edges[0] == pytest.approx(2 * math.pi)


def test_a_sector_is_a_pie_slice_of_unbounded_height() -> None:
    points = np.array([[1, 0, 0], [1, 0, 99], [0, 1, 0], [-1, 0, 0], [9, 0, 0], [10, 0.0, 0], [10.001, 0, 0]])
    inside = in_sector(points, -0.5, 0.5, 10.0)
    np.testing.assert_array_equal(inside, [True, True, False, False, True, True, False])


def test_a_sector_may_cross_the_back() -> None:
    angle = np.deg2rad([170.0, 190.0, -170.0, 10.0])
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    np.testing.assert_array_equal(
        in_sector(points, math.radians(150), math.radians(210), 2.0), [True, True, True, False]
    )


def test_the_full_circle_holds_all() -> None:
    angle = np.linspace(-np.pi, np.pi, 400)
    points = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    assert in_sector(points, -np.pi, np.pi, 2.0).all()


def test_rotation_turns_counter_clockwise_and_back() -> None:
    np.testing.assert_allclose(rotation_z(math.pi / 2) @ [1, 0, 7], [0, 1, 7], atol=1e-15)
    np.testing.assert_allclose(rotation_z(0.7) @ rotation_z(-0.7), np.eye(3), atol=1e-15)


def test_rotated_diagonal_is_the_diagonal_of_the_turned_covariance() -> None:
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.1, 2.0, (9, 3))
    rotation, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    truth = [np.diag(rotation @ np.diag(v) @ rotation.T) for v in variance]
    np.testing.assert_allclose(rotated_diagonal(variance, rotation), truth)
    np.testing.assert_allclose(rotated_diagonal(variance, rotation).sum(axis=1), variance.sum(axis=1))
    assert rotated_diagonal(variance.astype(np.float32), rotation).dtype == np.float32


@pytest.mark.parametrize("offset", [0.0, -1234.5, 5e6])
def test_thinning_keeps_the_coverage(offset: float) -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (3000, 3)) * [1, 1, 0.2] + offset
    picked = voxel_pick(points, 1.0)
    assert (np.diff(picked) > 0).all()
    cells = np.floor(points)
    np.testing.assert_array_equal(np.unique(cells[picked], axis=0), np.unique(cells, axis=0))
    assert len(np.unique(cells[picked], axis=0)) == len(picked), "one a voxel"
    for i in picked[:50]:
        assert i == np.flatnonzero((cells == cells[i]).all(axis=1))[0], "the first one"
    np.testing.assert_array_equal(thin(points, 10_000, 1.0, np.random.default_rng(1)), picked)


def test_thinning_to_a_number_draws_among_the_voxels() -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (3000, 3))
    picked = voxel_pick(points, 1.0)
    few = thin(points, 50, 1.0, np.random.default_rng(1))
    assert len(few) == 50
    assert (np.diff(few) > 0).all()
    assert np.isin(few, picked).all()
    np.testing.assert_array_equal(few, thin(points, 50, 1.0, np.random.default_rng(1)))
    assert not np.array_equal(few, thin(points, 50, 1.0, np.random.default_rng(2)))


def test_thinning_nothing() -> None:
    assert len(thin(np.zeros((0, 3)), 5, 1.0, np.random.default_rng(0))) == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int64])
@pytest.mark.parametrize("n", [1, 2, 500])
def test_bounds_are_numpys(dtype: type, n: int) -> None:
    points = np.random.default_rng(n).uniform(-1e6, 1e6, (n, 3)).astype(dtype)
    lower, upper = bounds(points)
    np.testing.assert_array_equal(lower, points.min(axis=0))
    np.testing.assert_array_equal(upper, points.max(axis=0))


def test_a_box_includes_its_faces() -> None:
    rng = np.random.default_rng(0)
    points = rng.integers(-2, 3, (400, 3)).astype(np.float64)
    lower, upper = np.array([-1.0, 0.0, -2.0]), np.array([1.0, 0.0, 1.0])
    wanted = ((points >= lower) & (points <= upper)).all(axis=1)
    assert wanted.any()
    np.testing.assert_array_equal(inside_box(points, lower, upper), wanted)
    assert not inside_box(np.full((1, 3), np.nan), lower, upper).any()
