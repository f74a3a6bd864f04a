"""Profile `sharp`: free space ends at faces, and nobody is sure behind them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Scan, yaw_pose
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.numerics import evidence

NO_ATOMS = AtomDictionary(())


def service_of(profile: str, **changes: float) -> MappingService:
    settings = dataclasses.replace(MappingSettings.of_profile(profile), **changes)
    return MappingService(NO_ATOMS, settings, threads=2)


def wall(distance_m: float, n: int = 8000, *, seed: int = 0, noise_m: float = 0.01) -> Scan:
    """One upright wall across the way, and nothing else."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-1, 1, n), rng.uniform(-0.3, 0.3, n)
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    ends = ray * (distance_m / ray[:, :1] + rng.normal(0, noise_m, (n, 1)))
    return Scan(points=ends.astype(np.float32), T_map_sensor=np.eye(4))


def crossing_m(service: MappingService, distance_m: float) -> float:
    """How far before the wall p crosses one half; positive is in front of it."""
    x = np.linspace(distance_m - 1.0, distance_m + 0.5, 301)
    lines = [
        service.snapshot.occupancy(np.column_stack([x, np.full(301, y), np.full(301, z)])).mean
        for y in (-0.5, 0.0, 0.5)
        for z in (-0.2, 0.2)
    ]
    p = np.mean(lines, axis=0)
    return distance_m - float(x[np.argmax(p >= 0.5)])


@pytest.mark.parametrize("distance_m", [2.0, 5.0, 10.0, 20.0])
def test_a_wall_stands_where_it_is(distance_m: float) -> None:
    found = {}
    for profile in ("default", "sharp"):
        service = service_of(profile)
        for k in range(5):
            service.integrate(wall(distance_m, seed=k))
        found[profile] = crossing_m(service, distance_m)
    assert abs(found["sharp"]) <= 0.10
    assert abs(found["sharp"]) < 0.6 * abs(found["default"])


def test_behind_a_wall_nobody_is_sure() -> None:
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-0.8, 0.8, 6000), rng.uniform(-0.25, 0.25, 6000)
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    scan = Scan(points=ray * (3.0 / ray[:, :1] + rng.normal(0, 0.02, (6000, 1))), T_map_sensor=np.eye(4))
    answers = {}
    for profile in ("default", "sharp"):
        service = service_of(profile)
        service.integrate(scan)
        answers[profile] = service.snapshot.occupancy([[2.5, 0, 0], [3.02, 0, 0], [3.5, 0, 0]])
    sharp, default = answers["sharp"], answers["default"]
    assert sharp.mean[0] < 0.05
    assert sharp.mean[1] > 0.6
    # half a metre behind the wall, where no beam ever was: far less sure than on the face
    assert abs(sharp.latent_mean[2]) < abs(sharp.latent_mean[1])
    assert sharp.latent_var[2] > 5.0 * sharp.latent_var[0]
    assert sharp.var[2] > 20.0 * default.var[2]


def test_what_wide_kernels_reach_and_nobody_saw_is_unknown() -> None:
    """Above the field of view, beside free space that was seen."""
    free, above = np.array([[2.0, 0.0, 0.0], [3.0, 0.5, 0.3]]), np.array([[3.0, 0.0, 1.9], [3.5, 0.5, 2.1]])
    observed = {}
    for profile in ("default", "sharp"):
        service = service_of(profile)
        for k in range(3):
            service.integrate(wall(5.0, seed=k))
        answer = service.snapshot.occupancy(np.concatenate([free, above])).observed
        observed[profile] = answer.tolist()
    assert observed["sharp"] == [True, True, False, False]
    assert observed["default"][:2] == [True, True]
    assert any(observed["default"][2:])


def test_the_rows_beside_faces_are_of_the_robot_that_saw_them() -> None:
    service = service_of("sharp")
    for robot, seed in (("a", 1), ("b", 2)):
        service.integrate(dataclasses.replace(wall(5.0, seed=seed), robot_id=robot))
    kinds = {int(k) for tile in service.state.tiled.tiles.values() for k in tile.rows.kind}
    assert kinds == {evidence.FREE, evidence.HIT, evidence.SHADOW, evidence.NEAR}
    service.remove_robot("b")
    alone = service_of("sharp")
    alone.integrate(dataclasses.replace(wall(5.0, seed=1), robot_id="a"))
    points = np.random.default_rng(0).uniform([1, -2, -1], [5.5, 2, 1], (500, 3))
    with_undo, never = (s.snapshot.occupancy(points).mean for s in (service, alone))
    assert np.abs(with_undo - never).mean() < 0.05


def test_a_planar_map_has_sharp_walls_too() -> None:
    rng = np.random.default_rng(0)
    service = service_of("sharp")
    for k in range(5):
        azimuth = rng.uniform(-1, 1, 1000)
        ray = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(1000)], axis=1)
        ends = ray * (4.0 / ray[:, :1] + rng.normal(0, 0.01, (1000, 1)))
        pose = yaw_pose(0.0, 0.02 * k, 0.0)
        service.integrate(Scan(points=ends.astype(np.float32), T_map_sensor=pose, is_planar=True))
    x = np.linspace(3.0, 4.5, 301)
    p = service.snapshot.occupancy(np.column_stack([x, np.zeros(301)])).mean
    assert abs(4.0 - x[np.argmax(p >= 0.5)]) <= 0.10
    assert np.abs(service.snapshot.kernels.hinge_mean[:, 2]).max() < 1e-6


def test_the_same_scans_give_the_same_map() -> None:
    maps = []
    for _ in range(2):
        service = service_of("sharp")
        for k in range(2):
            service.integrate(wall(5.0, seed=k))
        maps.append(service.snapshot.kernels)
    np.testing.assert_array_equal(maps[0].weight_mean, maps[1].weight_mean)
    np.testing.assert_array_equal(maps[0].weight_var, maps[1].weight_var)


def test_two_maps_merge_with_what_they_know_beside_faces() -> None:
    one, other, both = service_of("sharp"), service_of("sharp"), service_of("sharp")
    for k in range(2):
        one.integrate(dataclasses.replace(wall(5.0, seed=k), robot_id="a"))
        other.integrate(dataclasses.replace(wall(5.0, seed=10 + k), robot_id="b"))
    for k in (0, 1, 10, 11):
        both.integrate(dataclasses.replace(wall(5.0, seed=k), robot_id="a" if k < 5 else "b"))
    one.merge(other.state, np.eye(4))
    assert abs(crossing_m(one, 5.0) - crossing_m(both, 5.0)) < 0.04
