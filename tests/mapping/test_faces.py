"""Free space ends at faces, nobody is sure behind them, and what has left is gone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.domain.dictionary import AtomDictionary
from potserver.domain.tiles import level_of
from potserver.domain.types import Scan, yaw_pose
from potserver.mapping.service import MappingService
from potserver.mapping.settings import MappingSettings
from potserver.numerics import evidence

NO_ATOMS = AtomDictionary(())


def mapper(**changes: float) -> MappingService:
    return MappingService(NO_ATOMS, dataclasses.replace(MappingSettings(), **changes), threads=2)


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
    service = mapper()
    for k in range(5):
        service.integrate(wall(distance_m, seed=k))
    assert abs(crossing_m(service, distance_m)) <= 0.10


def opening(seed: int) -> Scan:
    """A wall 3 m away with a slit of .4 m in it, and a wall 2 m behind."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = (
        x.ravel() for x in np.meshgrid(np.arange(-0.6, 0.6, 0.004), np.arange(-0.2, 0.2, 0.01))
    )
    azimuth += rng.uniform(0, 0.004)
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    is_open = np.abs(3.0 / ray[:, 0] * ray[:, 1]) < 0.2
    range_m = np.where(is_open, 5.0, 3.0) / ray[:, 0] + rng.normal(0, 0.01, len(ray))
    return Scan(points=ray * range_m[:, None], T_map_sensor=np.eye(4))


def free_width_m(service: MappingService) -> float:
    """Of the slit, where p is below one half."""
    y = np.linspace(-0.6, 0.6, 601)
    lines = [
        service.snapshot.occupancy(np.column_stack([np.full(601, 3.03), y, np.full(601, z)])).mean
        for z in (-0.2, 0.0, 0.2)
    ]
    return float((np.mean(lines, axis=0) < 0.5).mean() * 1.2)


def test_a_map_that_began_far_outside_is_fine_where_beams_lie_closely() -> None:
    """The first scan alone would make kernels of .4 m everywhere."""
    follows, coarse = mapper(), mapper(resolution_m=0.4)
    for service in (follows, coarse):
        service.integrate(wall(20.0))
        for k in range(5):
            service.integrate(opening(k))
    assert follows.state.tiled.grid == coarse.state.tiled.grid
    assert follows.state.tiled.grid.fine_m == 0.4
    finest = {
        name: max(
            int(tile.kernels.level.max()) for tile in service.state.tiled.tiles.values() if len(tile.kernels)
        )
        for name, service in (("follows", follows), ("coarse", coarse))
    }
    assert finest == {"follows": level_of(2), "coarse": level_of(0)}
    assert free_width_m(coarse) == 0.0
    assert 0.25 < free_width_m(follows) <= 0.4


def test_behind_a_wall_nothing_is_known() -> None:
    rng = np.random.default_rng(0)
    azimuth, elevation = rng.uniform(-0.8, 0.8, 6000), rng.uniform(-0.25, 0.25, 6000)
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    scan = Scan(points=ray * (3.0 / ray[:, :1] + rng.normal(0, 0.02, (6000, 1))), T_map_sensor=np.eye(4))
    service = mapper()
    service.integrate(scan)
    before, on_it, *behind = (
        service.snapshot.occupancy([[x, 0, 0]]) for x in (2.5, 3.02, 3.4, 3.5, 4.0, 4.5)
    )
    assert before.mean[0] < 0.05
    assert on_it.mean[0] > 0.6
    assert before.observed[0]
    assert on_it.observed[0]
    for answer in behind:
        assert not answer.observed[0]
        assert answer.mean[0] == 0.5
        assert answer.var[0] > 0.2


def test_what_wide_kernels_reach_and_nobody_saw_is_unknown() -> None:
    """Above the field of view, beside free space that was seen."""
    free, above = np.array([[2.0, 0.0, 0.0], [3.0, 0.5, 0.3]]), np.array([[3.0, 0.0, 1.9], [3.5, 0.5, 2.1]])
    service = mapper()
    for k in range(3):
        service.integrate(wall(5.0, seed=k))
    assert service.snapshot.occupancy(free).observed.all()
    assert not service.snapshot.occupancy(above).observed.any()


def test_a_cabinet_that_is_carried_away_from_a_wall_is_gone() -> None:
    """Beams that see through its place end on the wall .4 m behind."""
    rng = np.random.default_rng(0)
    azimuth, elevation = np.meshgrid(np.linspace(-1, 1, 300), np.radians(np.linspace(-15, 15, 64)))
    ray = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)

    def scan(is_there: bool) -> Scan:
        range_m = 5.0 / ray[:, 0]
        hit = is_there & (np.abs(4.6 / ray[:, 0] * ray[:, 1]) < 0.6)
        range_m = np.where(hit, 4.6 / ray[:, 0], range_m) + rng.normal(0, 0.02, len(ray))
        return Scan(points=ray * range_m[:, None], T_map_sensor=np.eye(4))

    place = np.array([[4.63, y, z] for y in (-0.4, 0, 0.4) for z in (-0.6, 0, 0.6)])
    service = mapper()
    for _ in range(10):
        service.integrate(scan(True))
    assert service.snapshot.occupancy(place).mean.min() > 0.8
    for _ in range(5):
        service.integrate(scan(False))
    assert service.snapshot.occupancy(place).mean.max() < 0.5


def test_a_far_box_of_a_few_rings_is_gone_in_the_end() -> None:
    """Sixteen rings, 16 m away: two or three beams a scan pass through each part of its place."""
    rng = np.random.default_rng(0)

    def scan(is_there: bool, k: int) -> Scan:
        azimuth, elevation = np.meshgrid(
            np.radians(np.arange(900) * 0.4 + rng.uniform(0, 0.4)),
            np.radians(np.linspace(-15, 15, 16) + rng.normal(0, 0.3)),
        )
        ray = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)],
            axis=-1,
        ).reshape(-1, 3)
        y0, range_m, down = 0.02 * k, np.full(len(ray), 20.0), ray[:, 2] < -1e-9
        range_m[down] = np.minimum(range_m[down], -1.0 / ray[down, 2])
        box = 16.08 / np.where(ray[:, 0] > 0.1, ray[:, 0], np.inf) if is_there else np.zeros(len(ray))
        hit = (
            (box > 0)
            & (np.abs(box * ray[:, 1] + y0) < 0.5)
            & (box * ray[:, 2] > -1)
            & (box * ray[:, 2] < 0.6)
        )
        range_m = np.where(hit & (box < range_m), box, range_m) + rng.normal(0, 0.02, len(ray))
        return Scan(points=ray * range_m[:, None], T_map_sensor=yaw_pose(0.0, y0, 0.0))

    place = np.array([[16.11, y, z] for y in (-0.3, 0, 0.3) for z in (-0.6, -0.3, 0, 0.3)])
    service = mapper()
    for k in range(10):
        service.integrate(scan(True, k))
    assert service.snapshot.occupancy(place).mean.mean() > 0.9
    for k in range(20):
        service.integrate(scan(False, k))
    assert service.snapshot.occupancy(place).mean.mean() < 0.45


def test_the_rows_beside_faces_are_of_the_robot_that_saw_them() -> None:
    service = mapper()
    for robot, seed in (("a", 1), ("b", 2)):
        service.integrate(dataclasses.replace(wall(5.0, seed=seed), robot_id=robot))
    kinds = {int(k) for tile in service.state.tiled.tiles.values() for k in tile.rows.sort}
    assert kinds >= {evidence.FREE, evidence.HIT, evidence.SHADOW, evidence.NEAR}
    service.remove_robot("b")
    alone = mapper()
    alone.integrate(dataclasses.replace(wall(5.0, seed=1), robot_id="a"))
    points = np.random.default_rng(0).uniform([1, -2, -1], [5.5, 2, 1], (500, 3))
    with_undo, never = (s.snapshot.occupancy(points).mean for s in (service, alone))
    assert np.abs(with_undo - never).mean() < 0.05


def test_a_planar_map_has_true_walls_too() -> None:
    rng = np.random.default_rng(0)
    service = mapper()
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
        service = mapper()
        for k in range(2):
            service.integrate(wall(5.0, seed=k))
        maps.append(service.snapshot.kernels)
    np.testing.assert_array_equal(maps[0].weight_mean, maps[1].weight_mean)
    np.testing.assert_array_equal(maps[0].weight_var, maps[1].weight_var)


def test_two_maps_merge_with_what_they_know_beside_faces() -> None:
    one, other, both = mapper(), mapper(), mapper()
    for k in range(2):
        one.integrate(dataclasses.replace(wall(5.0, seed=k), robot_id="a"))
        other.integrate(dataclasses.replace(wall(5.0, seed=10 + k), robot_id="b"))
    for k in (0, 1, 10, 11):
        both.integrate(dataclasses.replace(wall(5.0, seed=k), robot_id="a" if k < 5 else "b"))
    one.merge(other.state, np.eye(4))
    assert abs(crossing_m(one, 5.0) - crossing_m(both, 5.0)) < 0.04
