"""What has left is gone after a few scans, near and far, before a wall and before nothing; thin things that are there stay."""

from __future__ import annotations

import numpy as np
import pytest

from potserver import MappingService, Scan

Array = np.ndarray
RANGE_M = 25.0


def _directions(rings: int, rng: np.random.Generator, half_rad: float) -> Array:
    """(N, 3) unit. The sensor shakes, so that its rings move by a sixth of their distance."""
    step = np.radians(0.4)
    azimuth = np.arange(-half_rad, half_rad, step) + rng.uniform(0, step)
    elevation = np.radians(np.linspace(-15, 15, rings) + rng.normal(0, 0.3 * 16 / rings))
    a, e = np.meshgrid(azimuth, elevation)
    return np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)


def _scan(directions: Array, range_m: Array, y_m: float, rng: np.random.Generator) -> Scan:
    back = range_m < RANGE_M
    length = np.where(back, range_m + rng.normal(0, 0.02, len(range_m)), RANGE_M)
    pose = np.eye(4)
    pose[1, 3] = y_m
    return Scan(points=directions * length[:, None], is_return=back, T_map_sensor=pose)


def _to_plane(directions: Array, x_m: float) -> Array:
    return x_m / np.maximum(directions[:, 0], 1e-9)


def _to_floor(directions: Array) -> Array:
    return np.where(directions[:, 2] < -1e-9, -1.0 / np.minimum(directions[:, 2], -1e-9), np.inf)


def _mean(service: MappingService, points: Array) -> float:
    return float(service.snapshot.occupancy(points).mean.mean())


@pytest.mark.parametrize(
    ("at_m", "rings", "wall_m", "stood"),
    [
        (16.0, 16, 4.0, 10),  # a far one with few echoes
        (16.0, 16, 4.0, 100),  # ... which stood for long
        (20.0, 16, 0.4, 10),  # far, and near to a wall
        (20.0, 64, 0.4, 20),
        (8.0, 16, 0.4, 20),  # its voxels touch those of the wall
        (8.0, 16, None, 100),  # before nothing
        (4.0, 64, 0.4, 10),
    ],
)  # fmt: skip
def test_a_box_that_was_carried_off_is_gone_within_five_scans(
    at_m: float, rings: int, wall_m: float | None, stood: int
) -> None:
    rng, service = np.random.default_rng(0), MappingService(threads=1)

    def look(k: int, *, box: bool) -> None:
        d, y_m = _directions(rings, rng, min(0.5, max(0.12, 2.2 / at_m))), 0.02 * k
        r = _to_floor(d) if wall_m is None else np.minimum(_to_floor(d), _to_plane(d, at_m + wall_m))
        t = _to_plane(d, at_m)  # to the front of a box 1 m wide and 1.6 m high
        is_hit = (np.abs(t * d[:, 1] + y_m) < 0.5) & (t * d[:, 2] > -1) & (t * d[:, 2] < 0.6) & (t < r)
        service.integrate(_scan(d, np.where(is_hit & box, t, r), y_m, rng))

    place = np.array([[at_m + 0.03, y, z] for y in (-0.3, 0, 0.3) for z in (-0.6, -0.3, 0, 0.3)])
    for k in range(stood):
        look(k, box=True)
    assert _mean(service, place) > 0.9
    for k in range(5):
        look(k, box=False)
    assert _mean(service, place) < 0.5


@pytest.mark.parametrize("before_m", [6.0, 12.0])
def test_a_wall_doubled_by_drift_is_single_again(before_m: float) -> None:
    """Poses were .3 m off for ten scans: the false wall stands before the true one, and beams that reach that go through."""
    rng, service = np.random.default_rng(0), MappingService(threads=1)

    def look(k: int, x_m: float) -> None:
        d = _directions(32, rng, 0.3)
        service.integrate(_scan(d, np.minimum(_to_floor(d), _to_plane(d, x_m)), 0.02 * k, rng))

    heights = [[0.0, y, z] for y in (-1.0, 0.0, 1.0) for z in (-0.3, 0.0, 0.3)]
    false, true = (np.add(heights, [x, 0, 0]) for x in (before_m, before_m + 0.31))
    for k in range(10):
        look(k, before_m)
    assert _mean(service, false) > 0.9
    for k in range(5):
        look(k, before_m + 0.3)
    assert _mean(service, true) > 0.9
    assert _mean(service, false) < 0.5


def _stays(service: MappingService, points: Array) -> float:
    answer = service.snapshot.occupancy(points)
    return float(((answer.mean > 0.5) & answer.observed).mean())


def test_a_fence_that_gives_one_echo_in_ten_stays() -> None:
    rng, service = np.random.default_rng(0), MappingService(threads=1)
    for k in range(100):
        d = _directions(16, rng, 0.2)
        r, t = np.minimum(_to_floor(d), _to_plane(d, 12.0)), _to_plane(d, 6.0)
        is_hit = (rng.random(len(d)) < 0.1) & (t < r)
        service.integrate(_scan(d, np.where(is_hit, t, r), 0.02 * (k % 10), rng))
    place = np.array([[6.0, y, z] for y in np.arange(-0.9, 0.95, 0.1) for z in np.arange(-0.6, 0.9, 0.1)])
    assert _stays(service, place) > 0.8


def test_poles_and_wires_stay() -> None:
    """A pole of 8 cm at 6 m, a wire of 3 cm at 5 m, a wall .5 m behind the pole."""
    rng, service = np.random.default_rng(0), MappingService(threads=1)
    for k in range(100):
        d, y_m = _directions(32, rng, 0.25), 0.01 * (k % 20)
        r = np.minimum(_to_floor(d), _to_plane(d, 6.5))
        pole, wire = _to_plane(d, 6.0), _to_plane(d, 5.0)
        r = np.where((np.abs(pole * d[:, 1] + y_m - 0.5) < 0.04) & (pole < r), pole, r)
        r = np.where((np.abs(wire * d[:, 2] - 0.4) < 0.015) & (wire < r), wire, r)
        service.integrate(_scan(d, r, y_m, rng))
    assert _stays(service, np.array([[6.0, 0.5, z] for z in np.arange(-0.7, 0.9, 0.05)])) > 0.9
    assert _stays(service, np.array([[5.0, y, 0.4] for y in np.arange(-0.9, 0.9, 0.05)])) > 0.8
