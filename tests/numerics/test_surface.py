"""Normals of made-up faces, and samples beside them, against geometry."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.surface import Normals, behind, near_free, normals, smallest_axis

VOXEL_M = 0.1
NOTHING = np.zeros((0, 3))


def turned(degrees: float) -> np.ndarray:
    """A normal towards the origin of a wall at positive x, turned about an axis that is no axis of the grid."""
    axis, angle = np.array([0.1, 0.3, 0.9]) / np.linalg.norm([0.1, 0.3, 0.9]), np.radians(degrees)
    v = np.array([-1.0, 0.0, 0.0])
    return v * np.cos(angle) + np.cross(axis, v) * np.sin(angle) + axis * (axis @ v) * (1.0 - np.cos(angle))


def beams_at(normal: np.ndarray, centre: np.ndarray, n: int, noise_m: float, rng: np.random.Generator):
    """Hits (n, 3) within 1.5 m of a plane's centre, with noise along their rays (n, 3) from the origin."""
    across = np.linalg.svd(normal[None])[2][1:]
    exact = centre + rng.uniform(-1.5, 1.5, (n, 2)) @ across
    length = np.linalg.norm(exact, axis=1)
    rays = exact / length[:, None]
    return exact + rng.normal(0.0, noise_m, n)[:, None] * rays, rays


def angle_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees, of rows."""
    return np.degrees(np.arccos(np.clip((a * b).sum(-1), -1.0, 1.0)))


def rays_of(hits: np.ndarray) -> np.ndarray:
    return hits / np.linalg.norm(hits, axis=1)[:, None]


def is_fallback(found: Normals, rays: np.ndarray) -> np.ndarray:
    return (found.cosine == 0.7) & (found.sigma_m == 0.05) & (found.normal == -rays).all(1)


@pytest.mark.parametrize("degrees", [0.0, 20.0, 45.0, 70.0])
@pytest.mark.parametrize("noise_m", [0.0, 0.02])
def test_a_plane_is_found_at_any_angle(degrees: float, noise_m: float) -> None:
    normal, centre = turned(degrees), np.array([6.0, 0.0, 0.2])
    hits, rays = beams_at(normal, centre, 3000, noise_m, np.random.default_rng(0))
    found = normals(hits, rays, NOTHING, VOXEL_M, planar=False)
    assert is_fallback(found, rays).mean() < 0.01
    plane = ~is_fallback(found, rays)
    error = angle_between(found.normal, normal)[plane]
    assert np.median(error) < (0.1 if noise_m == 0.0 else 2.0)
    assert np.percentile(error, 95) < (0.1 if noise_m == 0.0 else 5.0)
    np.testing.assert_allclose(found.cosine[plane], -(found.normal * rays).sum(1)[plane], atol=1e-12)
    np.testing.assert_allclose(np.median(found.cosine - -(rays @ normal)), 0.0, atol=0.02)
    assert (found.cosine >= 0.0).all()
    assert (found.cosine <= 1.0).all()
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, atol=1e-9)


@pytest.mark.parametrize("noise_m", [0.01, 0.02, 0.03])
def test_sigma_is_the_noise_of_single_hits(noise_m: float) -> None:
    rng = np.random.default_rng(0)
    y, z = np.meshgrid(np.arange(-2, 2, VOXEL_M) + 0.05, np.arange(-1, 2, VOXEL_M) + 0.05)
    hits = np.column_stack([5.05 + rng.normal(0.0, noise_m, y.size), y.ravel(), z.ravel()])
    found = normals(hits, rays_of(hits), NOTHING, VOXEL_M, planar=False)
    assert np.median(found.sigma_m) == pytest.approx(noise_m, rel=0.15)


def test_both_walls_of_a_corner_are_found_and_the_edge_alone_is_not_sure() -> None:
    rng = np.random.default_rng(0)
    along, z = rng.uniform(0.0, 3.0, (2, 4000)), rng.uniform(-1.0, 2.0, (2, 4000))
    hits = np.concatenate(
        [
            np.column_stack([np.full(4000, 4.0), 3.0 - along[0], z[0]]),
            np.column_stack([4.0 - along[1], np.full(4000, 3.0), z[1]]),
        ]
    )
    hits += rng.normal(0.0, 0.005, hits.shape)
    expected = np.repeat([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]], 4000, axis=0)
    found = normals(hits, rays_of(hits), NOTHING, VOXEL_M, planar=False)
    from_edge = np.concatenate(along)
    away = from_edge > 0.4
    assert np.percentile(angle_between(found.normal, expected)[away], 99) < 3.0
    near = (from_edge > 0.2) & ~away
    assert np.percentile(angle_between(found.normal, expected)[near], 75) < 10.0


@pytest.mark.parametrize("background_m", [None, 0.5, 3.0])
def test_a_thin_pole_has_no_plane(background_m: float | None) -> None:
    rng = np.random.default_rng(0)
    turn, z = rng.uniform(np.pi / 2, 3 * np.pi / 2, 400), rng.uniform(-1.0, 1.5, 400)
    pole = np.column_stack([5.0 + 0.025 * np.cos(turn), 0.025 * np.sin(turn), z])
    pole += rng.normal(0.0, 0.01, pole.shape)
    hits = pole
    if background_m is not None:
        y, z = rng.uniform(-2.0, 2.0, 4000), rng.uniform(-1.0, 1.5, 4000)
        hits = np.concatenate([pole, np.column_stack([np.full(4000, 5.0 + background_m), y, z])])
    found = normals(hits, rays_of(hits), NOTHING, VOXEL_M, planar=False)
    assert is_fallback(found, rays_of(hits))[:400].all()
    assert not is_fallback(found, rays_of(hits))[400:].any()


def ring_hits(n_rings: int, range_m: float, rng: np.random.Generator) -> np.ndarray:
    """Where rings two degrees apart meet a wall at x = `range_m`, with 1.5 cm of noise along the rays."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.linspace(-15.0, 15.0, n_rings)), np.radians(np.arange(-20, 20, 0.2))
    )
    rays = np.column_stack(
        [
            (np.cos(elevation) * np.cos(azimuth)).ravel(),
            (np.cos(elevation) * np.sin(azimuth)).ravel(),
            np.sin(elevation).ravel(),
        ]
    )
    return rays * (range_m / rays[:, 0] + rng.normal(0.0, 0.015, len(rays)))[:, None]


def test_sparse_rings_on_a_wall_need_the_points_that_the_map_knows() -> None:
    rng = np.random.default_rng(0)
    hits = ring_hits(16, 50.0, rng)  # rings 1.7 m apart
    rays, wall = rays_of(hits), np.array([-1.0, 0.0, 0.0])
    alone = normals(hits, rays, NOTHING, VOXEL_M, planar=False)
    inside = (np.abs(hits[:, 1]) < 5.0) & (np.abs(hits[:, 2]) < 4.0)
    known = np.column_stack(
        [rng.normal(50.0, 0.015, 12000), rng.uniform(-6, 6, 12000), rng.uniform(-5, 5, 12000)]
    )
    helped = normals(hits, rays, known, VOXEL_M, planar=False)
    assert is_fallback(alone, rays)[inside].all()
    assert not is_fallback(helped, rays)[inside].any()
    assert np.percentile(angle_between(helped.normal, wall)[inside], 95) < 5.0
    assert is_fallback(helped, rays)[np.abs(hits[:, 1]) > 9.0].all(), "nothing is known there"


def test_rings_near_enough_are_a_wall_by_themselves() -> None:
    hits = ring_hits(16, 10.0, np.random.default_rng(0))  # rings .35 m apart
    found = normals(hits, rays_of(hits), NOTHING, VOXEL_M, planar=False)
    plane = ~is_fallback(found, rays_of(hits))
    assert plane.mean() > 0.95
    assert np.percentile(angle_between(found.normal, np.array([-1.0, 0.0, 0.0]))[plane], 95) < 5.0


@pytest.mark.parametrize("degrees", [0.0, 30.0, 60.0])
def test_walls_in_2d(degrees: float) -> None:
    rng, angle = np.random.default_rng(0), np.radians(degrees)
    normal = np.array([-np.cos(angle), -np.sin(angle), 0.0])
    along = np.array([-normal[1], normal[0], 0.0])
    exact = np.array([4.0, 1.0, 0.0]) + np.arange(-1.5, 1.5, 0.02)[:, None] * along
    hits = exact + rng.normal(0.0, 0.01, len(exact))[:, None] * rays_of(exact)
    found = normals(hits, rays_of(hits), NOTHING, VOXEL_M, planar=True)
    inner = np.abs((hits - np.array([4.0, 1.0, 0.0])) @ along) < 1.2
    assert not is_fallback(found, rays_of(hits))[inner].any()
    assert np.percentile(angle_between(found.normal, normal)[inner], 95) < 5.0
    assert (found.normal[:, 2] == 0.0).all()
    lone = normals(hits[:2], rays_of(hits[:2]), NOTHING, VOXEL_M, planar=True)
    assert is_fallback(lone, rays_of(hits[:2])).all()


@pytest.mark.parametrize("planar", [False, True])
def test_no_hits(planar: bool) -> None:
    found = normals(NOTHING, NOTHING, np.ones((4, 3)), VOXEL_M, planar=planar)
    assert [part.shape for part in found] == [(0, 3), (0,), (0,)]
    rng = np.random.default_rng(0)
    points, index = near_free(NOTHING, np.zeros(3), found, low_m=0.1, high_m=0.2, sigmas=2.0, rng=rng)
    assert points.shape == (0, 3)
    assert index.shape == (0,)
    assert behind(NOTHING, found, low_m=0.1, high_m=0.2, rng=rng).shape == (0, 3)


def test_one_hit() -> None:
    hit = np.array([[1.0, 2.0, 3.0]])
    assert is_fallback(normals(hit, rays_of(hit), NOTHING, VOXEL_M, planar=False), rays_of(hit)).all()


def test_far_from_the_origin_of_the_frame() -> None:
    hits, rays = beams_at(turned(30.0), np.array([6.0, 0.0, 0.2]), 3000, 0.01, np.random.default_rng(0))
    far = np.array([5e6, -5e6, 40.0])  # whole voxels
    here = normals(hits, rays, hits[::7] + 0.03, VOXEL_M, planar=False)
    there = normals(hits + far, rays, hits[::7] + 0.03 + far, VOXEL_M, planar=False)
    same = angle_between(here.normal, there.normal) < 0.1  # but hits that rounding moved into another voxel
    assert same.mean() > 0.99
    np.testing.assert_allclose(here.sigma_m[same], there.sigma_m[same], atol=1e-4)


def test_the_order_of_points_changes_nothing() -> None:
    rng = np.random.default_rng(0)
    hits, rays = beams_at(turned(30.0), np.array([6.0, 0.0, 0.2]), 3000, 0.02, rng)
    known, order = hits[::3] + rng.normal(0.0, 0.02, (1000, 3)), rng.permutation(3000)
    found = normals(hits, rays, known, VOXEL_M, planar=False)
    again = normals(hits[order], rays[order], known[::-1], VOXEL_M, planar=False)
    for one, other in zip(found, again, strict=True):
        np.testing.assert_array_equal(one[order], other)


def test_hits_of_a_voxel_share_a_normal_and_arrays_stay() -> None:
    hits, rays = beams_at(turned(10.0), np.array([6.0, 0.0, 0.2]), 3000, 0.02, np.random.default_rng(0))
    arrays = hits, rays, hits[:50].copy()
    copies = [array.copy() for array in arrays]
    for array in arrays:
        array.flags.writeable = False
    found = normals(*arrays, VOXEL_M, planar=False)
    _, voxel = np.unique(np.floor(hits / VOXEL_M), axis=0, return_inverse=True)
    for v in range(40):
        inside = (voxel.ravel() == v) & ~is_fallback(found, rays)
        assert len(np.unique(found.normal[inside], axis=0)) <= 1
    for array, copy in zip(arrays, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


@pytest.mark.parametrize("voxel_m", [0.025, 0.05, 0.1, 0.2])
def test_the_edge_of_a_voxel_matters_little(voxel_m: float) -> None:
    normal = turned(40.0)
    hits, rays = beams_at(normal, np.array([6.0, 0.0, 0.2]), 4000, 0.01, np.random.default_rng(0))
    found = normals(hits, rays, NOTHING, voxel_m, planar=False)
    assert np.percentile(angle_between(found.normal, normal), 95) < 4.0


def exact_normals(normal: np.ndarray, rays: np.ndarray, sigma_m: float) -> Normals:
    return Normals(np.tile(normal, (len(rays), 1)), -(rays @ normal), np.full(len(rays), sigma_m))


@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0])
@pytest.mark.parametrize("sigmas", [0.0, 2.0])
def test_free_samples_have_the_clearance_that_was_asked(degrees: float, sigmas: float) -> None:
    normal, centre, origin = turned(degrees), np.array([9.0, 0.0, 0.2]), np.array([100.0, -50.0, 2.0])
    hits, rays = beams_at(normal, centre, 2000, 0.0, np.random.default_rng(0))
    facing = rays @ normal < -0.06
    hits, rays = hits[facing], rays[facing]
    found = exact_normals(normal, rays, 0.02)
    points, index = near_free(
        hits + origin, origin, found, low_m=0.05, high_m=0.15, sigmas=sigmas, rng=np.random.default_rng(1)
    )
    clearance = (points - origin - centre) @ normal
    assert len(points) > 0.8 * len(hits)
    assert clearance.min() >= 0.05 + 0.02 * sigmas - 1e-9
    assert clearance.max() <= 0.15 + 0.02 * sigmas + 1e-9
    assert np.ptp(clearance) > 0.09
    on_beam = points - origin
    np.testing.assert_allclose(on_beam / np.linalg.norm(on_beam, axis=1)[:, None], rays[index], atol=1e-9)
    assert (np.diff(index) > 0).all()


def test_free_samples_that_reach_the_sensor_are_left_out() -> None:
    hits = np.array([[0.1, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    normal = np.tile([-1.0, 0.0, 0.0], (4, 1))
    found = Normals(normal, np.array([1.0, 1.0, 1.0, 0.0]), np.zeros(4))
    points, index = near_free(
        hits, np.zeros(3), found, low_m=0.1, high_m=0.1, sigmas=2.0, rng=np.random.default_rng(0)
    )
    np.testing.assert_array_equal(index, [1])
    np.testing.assert_allclose(points, [[4.9, 0.0, 0.0]])


def test_samples_behind_are_behind() -> None:
    normal, centre = turned(45.0), np.array([6.0, 0.0, 0.2])
    hits, rays = beams_at(normal, centre, 2000, 0.0, np.random.default_rng(0))
    points = behind(
        hits, exact_normals(normal, rays, 0.0), low_m=0.2, high_m=1.2, rng=np.random.default_rng(1)
    )
    depth = -(points - centre) @ normal
    assert points.shape == hits.shape
    assert 0.2 - 1e-9 <= depth.min() < 0.25
    assert 1.15 < depth.max() <= 1.2 + 1e-9
    np.testing.assert_allclose(points + depth[:, None] * normal, hits, atol=1e-9)


SPECTRA = {
    "random": lambda rng: rng.uniform(0.0, 1.0, 3),
    "flat": lambda rng: np.array([1e-9, 0.7, 1.0]),
    "exactly flat": lambda rng: np.array([0.0, 1.0, 1.0]),
    "line": lambda rng: np.array([0.0, 0.0, 1.0]),
    "sphere": lambda rng: np.ones(3),
    "nearly a sphere": lambda rng: 1.0 + 1e-9 * rng.uniform(0.0, 1.0, 3),
    "smallest twice": lambda rng: np.array([0.5, 0.5, 1.0]),
    "signs": lambda rng: rng.normal(size=3),
    "zero": lambda rng: np.zeros(3),
}


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("is_turned", [False, True])
def test_the_smallest_axis_of_a_matrix(spectrum: str, is_turned: bool) -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0] if is_turned else np.eye(3)[rng.permutation(3)]
        a = (turn * SPECTRA[spectrum](rng)) @ turn.T * 10.0 ** rng.uniform(-8, 8)
        a = 0.5 * (a + a.T)
        w0, w1, *axis = smallest_axis(a[0, 0], a[1, 1], a[2, 2], a[0, 1], a[0, 2], a[1, 2])
        expected, scale = np.linalg.eigh(a)[0], max(np.abs(a).max(), 1e-300)
        np.testing.assert_allclose(np.array([w0, w1]) / scale, expected[:2] / scale, atol=1e-14)
        assert np.linalg.norm(axis) == pytest.approx(1.0, abs=1e-12)
        np.testing.assert_allclose(a @ axis / scale, expected[0] * np.array(axis) / scale, atol=1e-14)
