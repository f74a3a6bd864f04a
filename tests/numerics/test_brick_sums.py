"""Sums over bricks are eq. 1 over their kernels: at points, with gradients, at the cells of grids."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from potserver.numerics.brick_grid import Cells, grid_sums
from potserver.numerics.brick_map import BrickMap
from potserver.numerics.brick_sums import brick_gradients, brick_sums, brick_widths
from tests.numerics.lattice_maps import TILE_M, Kernels, bricks_about, on_lattice, parts_of, points_about

SEEDS = st.integers(0, 2**31)
# Kernels beyond a window add 4e-6 of their weight; some dozens lie there.
CLOSE = 2e-4


def _close(found: object, exact: np.ndarray) -> None:
    for one, other in zip(found, exact, strict=True):  # type: ignore[call-overload]
        np.testing.assert_allclose(one, other, atol=CLOSE, rtol=1e-5)


@settings(max_examples=40)
@given(
    seed=SEEDS,
    nodes=st.lists(st.integers(2, 24), min_size=1, max_size=3, unique=True),
    k=st.integers(1, 1500),
    height=st.none() | st.sampled_from([0.0, 0.3, 3.0, 5.9999999, 6.0, 18.0, -7.0]),
)
def test_sums_are_those_of_every_kernel(seed: int, nodes: list[int], k: int, height: float | None) -> None:
    rng = np.random.default_rng(seed)
    kernels = Kernels.joined([on_lattice(rng, n, k, height_m=height) for n in nodes])
    points = points_about(rng, kernels, 60)
    _close(brick_sums(bricks_about(kernels), points), kernels.sums(points))


@pytest.mark.parametrize("height", [None, 0.0])
def test_a_full_lattice_sums_to_what_all_its_kernels_do(height: float | None) -> None:
    rng = np.random.default_rng(0)
    kernels = on_lattice(rng, 6, 20_000, height_m=height, upper=(3, 3, 1))
    points = points_about(rng, kernels, 300)
    found, exact = brick_sums(bricks_about(kernels), points), kernels.sums(points)
    p, q = 1 / (1 + np.exp(-found.mean.astype(np.float64))), 1 / (1 + np.exp(-exact[0]))
    np.testing.assert_allclose(p, q, atol=2e-5)
    _close(found, exact)


@settings(max_examples=20)
@given(seed=SEEDS, tile=st.tuples(*[st.integers(-3_000_000, 3_000_000)] * 3))
def test_far_from_the_origin_sums_are_the_same(seed: int, tile: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(seed)
    kernels = on_lattice(rng, 8, 300, lower=(0, 0, 0), upper=(2, 2, 1))
    points = points_about(rng, kernels, 50)
    shift = np.array(tile) * TILE_M
    moved = kernels._replace(hinge=kernels.hinge + shift)
    _close(brick_sums(bricks_about(moved), points + shift), kernels.sums(points))


@settings(max_examples=25)
@given(seed=SEEDS, nodes=st.integers(2, 24), height=st.none() | st.sampled_from([0.0, 2.2]))
def test_gradients_are_those_of_every_kernel(seed: int, nodes: int, height: float | None) -> None:
    rng = np.random.default_rng(seed)
    kernels = on_lattice(rng, nodes, 500, height_m=height)
    points = points_about(rng, kernels, 40)
    steep = nodes / TILE_M
    for one, other in zip(
        brick_gradients(bricks_about(kernels), points), kernels.slopes(points), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=20 * steep * CLOSE, rtol=1e-4)


def test_widths_are_weighed_by_activation() -> None:
    rng = np.random.default_rng(0)
    kernels = Kernels.joined([on_lattice(rng, 6, 2000), on_lattice(rng, 15, 2000)])
    points = points_about(rng, kernels, 100)
    phi = np.exp(-kernels.gamma * np.square(points[:, None] - kernels.hinge[None]).sum(axis=2))
    activation, widths = brick_widths(bricks_about(kernels), points)
    width = np.sqrt(0.5 * np.pi / kernels.gamma)
    _close((activation, widths), np.stack([phi @ kernels.known, phi @ (kernels.known * width)]))


@settings(max_examples=30)
@given(
    seed=SEEDS,
    shape=st.tuples(st.integers(1, 7), st.integers(1, 9), st.sampled_from([1, 1, 2, 5, 23])),
    resolution=st.floats(0.02, 1.7),
    height=st.none() | st.just(0.25),
)
def test_cells_of_a_grid_answer_as_points(
    seed: int, shape: tuple[int, int, int], resolution: float, height: float | None
) -> None:
    rng = np.random.default_rng(seed)
    kernels = Kernels.joined([on_lattice(rng, n, 1500, height_m=height) for n in (4, 10)])
    lower = rng.uniform([-8, -8, -8], [22, 22, 10])
    if height is not None:
        lower[2] = 0.3 - 0.5 * resolution
    bricks, n = bricks_about(kernels), int(np.prod(shape))
    cells = np.stack(np.unravel_index(np.arange(n), shape), axis=1)
    exact = kernels.sums(lower + (cells + 0.5) * resolution)
    first = int(rng.integers(0, n))
    last = int(rng.integers(first, n)) + 1
    grid = Cells(lower, resolution, shape)
    _close(grid_sums(bricks, grid, 0, n, threads=2), exact)
    _close(grid_sums(bricks, grid, first, last), exact[:, first:last])


def test_sums_depend_neither_on_threads_nor_on_the_order_of_parts_or_points() -> None:
    rng = np.random.default_rng(0)
    kernels = Kernels.joined([on_lattice(rng, n, 3000) for n in (6, 15)])
    points = points_about(rng, kernels, 4000)
    made, _ = parts_of(kernels)
    one = brick_sums(BrickMap(made), points)
    other = brick_sums(BrickMap(made[::-1]), np.ascontiguousarray(points[::-1]), threads=3)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b[::-1])


def test_nothing_is_found_where_nothing_is() -> None:
    points = np.array([[0.0, 0.0, 0.0], [1e9, -1e9, 1e9], [2e7, 2e7, -2e7]])
    kernels = on_lattice(np.random.default_rng(0), 6, 200, lower=(5, 5, 5), upper=(6, 6, 6))
    for bricks in (BrickMap([]), bricks_about(kernels)):
        assert not np.any(brick_sums(bricks, points))
        assert not np.any(brick_gradients(bricks, points))
        assert not np.any(grid_sums(bricks, Cells(np.full(3, -2e7), 1.0, (2, 2, 2)), 0, 8))
        assert len(brick_sums(bricks, points[:0]).mean) == 0
