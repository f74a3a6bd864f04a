"""Tiles: cut and put together again, nothing is lost, and far from the origin everything is as near it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.domain.kernel_map import KernelMap
from potserver.domain.tiles import (
    CARRIED,
    COARSE,
    MapKernels,
    Region,
    TiledMap,
    TileGrid,
    check_reach,
)
from potserver.domain.types import Float64, KernelSet, yaw_pose
from potserver.errors import OutOfRangeError, SettingsError, ShapeError
from potserver.mapping.placing import kernels_at
from potserver.numerics.evidence import add, positions

GRID = TileGrid.of(10.0, 0.4)
FAR = np.array([5_000_000.0, -4_000_000.0, 300.0])  # m, whole tiles


def _sample(seed: int = 0, n: int = 400) -> tuple[Float64, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform([-14, 3, -2], [21, 18, 4], (n, 3)), rng.random(n) < 0.4, rng.choice([1.0, 1 / 3], n)


def _map(shift: Float64, seed: int = 0) -> TiledMap:
    points, occupied, weight = _sample(seed)
    tiled = TiledMap.empty(GRID)
    lower, upper = points.min(axis=0) + shift, points.max(axis=0) + shift
    region = Region.of(tiled, lower, upper)
    local = points + shift - region.origin_m
    region.rows, _ = add(region.rows, local, occupied, weight, GRID.fine_m)
    region.kernels = MapKernels.concatenate(
        [
            MapKernels.new(kernels_at(local[::3], 1.0, 50.0), COARSE),
            MapKernels.new(kernels_at(local[1::9], 0.4, 7.0), CARRIED),
        ]
    )
    return tiled.with_tiles(region.tiles(lower, upper))


@pytest.mark.parametrize("fine_m", [0.05, 0.2, 0.23, 0.4, 3.0, 50.0])
@pytest.mark.parametrize("size_m", [4.0, 10.0])
def test_every_lattice_divides_a_tile(size_m: float, fine_m: float) -> None:
    grid = TileGrid.of(size_m, fine_m)
    for edge in (0.5 * grid.fine_m, grid.fine_m, grid.coarse_m):
        assert abs(size_m / edge - round(size_m / edge)) < 1e-9
    assert grid.voxels * grid.fine_m == pytest.approx(size_m)
    assert grid.fine_m == pytest.approx(fine_m, rel=0.5) or fine_m > size_m / 5


def test_a_tile_of_too_many_voxels_is_refused() -> None:
    with pytest.raises(SettingsError, match="tile_size_m"):
        TileGrid.of(1000.0, 0.01)


def test_a_region_of_too_many_voxels_is_refused() -> None:
    with pytest.raises(SettingsError, match="max_range_m"):
        Region.of(TiledMap.empty(GRID), np.zeros(3), np.array([1e6, 0, 0]))


@pytest.mark.parametrize("shift", [np.zeros(3), FAR], ids=["here", "far"])
def test_cut_up_and_put_together_again(shift: Float64) -> None:
    tiled = _map(shift)
    assert len(tiled.tiles) == 5 * 2 * 2
    points, occupied, weight = _sample()
    origin = np.array([-20.0, 0.0, -10.0])
    truth, _ = add(
        Region.of(TiledMap.empty(GRID), points.min(axis=0), points.max(axis=0)).rows,
        points - origin,
        occupied,
        weight,
        GRID.fine_m,
    )
    whole = Region.of(tiled, points.min(axis=0) + shift, points.max(axis=0) + shift)
    assert len(whole.rows.occupied) == len(truth.occupied)
    where = positions(whole.rows, GRID.fine_m) + whole.origin_m - shift
    expected = positions(truth, GRID.fine_m) + origin
    np.testing.assert_allclose(where[np.lexsort(where.T)], expected[np.lexsort(expected.T)], atol=1e-5)
    hinge = whole.kernels.kernels.hinge_mean + whole.origin_m - shift
    placed = np.concatenate([points[::3], points[1::9]])
    np.testing.assert_allclose(hinge[np.lexsort(hinge.T)], placed[np.lexsort(placed.T)], atol=1e-8)
    assert (whole.kernels.level == CARRIED).sum() == len(points[1::9])


def test_far_away_everything_is_as_here() -> None:
    here, there = _map(np.zeros(3)), _map(FAR)
    steps = (FAR / GRID.size_m).astype(int)
    for index, tile in here.tiles.items():
        other = there.tiles[(index[0] + steps[0], index[1] + steps[1], index[2] + steps[2])]
        np.testing.assert_array_equal(tile.rows.voxel, other.rows.voxel)
        np.testing.assert_allclose(tile.rows.sums, other.rows.sums, atol=1e-6)
        np.testing.assert_allclose(
            tile.kernels.kernels.hinge_mean, other.kernels.kernels.hinge_mean, atol=1e-8
        )
        for tiles_frame in (tile, other):
            assert (np.abs(tiles_frame.kernels.kernels.hinge_mean - 5.0) <= 5.0).all()


def test_tiles_beyond_the_box_are_left_out() -> None:
    tiled = _map(np.zeros(3))
    region = Region.of(tiled, np.array([-14.0, 3, -2]), np.array([21.0, 18, 4]))
    inner = region.tiles(np.array([1.0, 3, 1]), np.array([9.0, 9, 2]))
    assert list(inner) == [(0, 0, 0)]
    np.testing.assert_array_equal(inner[(0, 0, 0)].rows.sums, tiled.tiles[(0, 0, 0)].rows.sums)


def test_rows_without_weight_are_dropped() -> None:
    tiled = _map(np.zeros(3))
    region = Region.of(tiled, np.array([1.0, 3, 1]), np.array([9.0, 9, 2]))
    region.rows.sums[::2] = 0.0
    tile = region.tiles(np.array([1.0, 3, 1]), np.array([9.0, 9, 2]))[(0, 0, 0)]
    assert len(tile.rows.occupied) == len(region.rows.occupied) // 2
    assert (tiled.tiles[(0, 0, 0)].rows.sums[:, 3] > 0).all(), "a region is a copy"


def test_the_next_map_shares_what_is_the_same_and_the_old_one_stays() -> None:
    tiled = _map(np.zeros(3))
    before = dict(tiled.tiles), dict(tiled.parts)
    changed = {(-2, 0, 0): tiled.tiles[(1, 1, 0)]}
    after = tiled.with_tiles(changed)
    assert (dict(tiled.tiles), dict(tiled.parts)) == before
    same = [n for n in tiled.parts if after.parts[n] is tiled.parts[n]]
    assert [n for n in tiled.parts if n not in same] == [(-1, 0, 0)]
    assert all(after.tiles[i] is tiled.tiles[i] for i in tiled.tiles if i != (-2, 0, 0))


def test_parts_hold_all_kernels_in_the_map_frame() -> None:
    tiled = _map(FAR)
    points = _sample()[0]
    snapshot = KernelMap(list(tiled.parts.values()))
    assert len(snapshot) == len(points[::3]) + len(points[1::9])
    assert snapshot.occupancy(points[::3] + FAR).observed.all()


def test_a_tile_keeps_no_other_tiles_alive() -> None:
    for tile in _map(np.zeros(3)).tiles.values():
        for array in (
            *tile.rows,
            tile.kernels.level,
            tile.kernels.prior_mean,
            tile.kernels.kernels.weight_mean,
        ):
            owner = array
            while isinstance(owner.base, np.ndarray):
                owner = owner.base
            assert owner.nbytes <= 4 * array.nbytes + 64


def test_new_kernels_have_their_weights_as_prior() -> None:
    kernels = MapKernels.new(kernels_at(np.zeros((2, 3)), 1.0, 9.0), COARSE)
    np.testing.assert_array_equal(kernels.prior_var, 9.0)
    np.testing.assert_array_equal(kernels.prior_mean, 0.0)
    assert len(MapKernels.concatenate([])) == 0
    with pytest.raises(ShapeError):
        dataclasses.replace(kernels, kernels=KernelSet.empty())


def test_a_map_may_be_moved_as_far_as_maps_may_be_and_no_further() -> None:
    tiled = _map(np.zeros(3))
    check_reach(tiled, yaw_pose(1000.0, 0.0, 1.0), 1100.0)
    for x_m in (1100.0, -1100.0, 3e10, 1e300):
        with pytest.raises(OutOfRangeError, match="the limit is 1100 m"):
            check_reach(tiled, yaw_pose(x_m, 0.0, 1.0), 1100.0)
    check_reach(TiledMap.empty(tiled.grid), yaw_pose(1e300, 0.0, 0.0), 1100.0)
