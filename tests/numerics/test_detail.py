"""How closely beams lie, and how fine a map may be for it."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.arrays import Float64
from potserver.numerics.detail import angles_between, scales_of


def _rays(azimuth: Float64, elevation: Float64) -> Float64:
    a, e = (x.ravel() for x in np.meshgrid(azimuth, elevation))
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=1)


@pytest.mark.parametrize("apart_deg", [0.3, 1.0, 2.0])
def test_of_beams_that_fill_a_field_of_view_the_angle_is_about_theirs(apart_deg: float) -> None:
    apart = np.radians(apart_deg)
    rays = _rays(np.arange(-0.6, 0.6, apart), np.arange(-0.3, 0.3, apart))
    found = angles_between(7.0 * rays, planar=False)
    assert np.isfinite(found).mean() > 0.95, "those at the corners have too few beside them"
    assert apart / 2 < np.median(found) < 2.5 * apart


def test_rings_are_as_far_apart_as_they_are_however_dense_each_is() -> None:
    rings = _rays(np.arange(-3.1, 3.1, 0.003), np.radians(np.arange(-15, 16, 2.0)))
    found = angles_between(rings, planar=False)
    assert np.quantile(found, 0.05) > np.radians(1.0)
    assert np.isfinite(found).all()


def test_a_beam_by_itself_has_none_beside_it() -> None:
    assert np.isinf(angles_between(np.array([[1.0, 0, 0], [-1, 0, 0.5]]), planar=False)).all()
    assert angles_between(np.zeros((0, 3)), planar=False).shape == (0,)


def test_in_a_plane_the_beams_beside_it_count() -> None:
    rays = _rays(np.arange(-3.1, 3.1, 0.02), np.zeros(1))
    found = angles_between(rays, planar=True)
    assert 0.01 < np.median(found) < 0.05


def test_the_resolution_is_halved_while_it_stays_above_a_length() -> None:
    least_m = np.array([np.inf, 0.41, 0.2, 0.11, 0.1, 0.05, 0.0])
    assert scales_of(least_m, 0.4, 3).tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert scales_of(least_m, 0.4, 1).tolist() == [0] * 7
