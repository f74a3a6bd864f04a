"""Grids over a box."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.asking.grid import PART_CELLS, Grid, GridPlan
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from tests.tiled_maps import free_kernels

SNAPSHOT = KernelMap(free_kernels(300), map_revision=7, threads=1)
LIMITS = Limits(max_grid_cells=5_000, max_coordinate_m=1e4)


def grid(lower: list, upper: list, resolution: float, *, part_cells: int = PART_CELLS) -> GridPlan:
    return Grid(lower, upper, resolution).plan(SNAPSHOT, LIMITS, part_cells=part_cells)


def test_grid_parts_are_the_cells_in_order() -> None:
    plan = grid([-2.0, -1.0, 0.0], [1.0, 1.0, 1.0], 0.5, part_cells=17)
    assert plan.shape == (6, 4, 2)
    assert plan.n_items == 48
    assert plan.n_parts == 3
    axes = [low + 0.5 * (np.arange(n) + 0.5) for low, n in zip((-2.0, -1.0, 0.0), plan.shape, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    parts = [plan.part(i) for i in range(plan.n_parts)]
    assert [first for first, _ in parts] == [0, 17, 34]
    np.testing.assert_allclose(
        np.concatenate([a.mean for _, a in parts]), SNAPSHOT.occupancy(centres).mean, atol=1e-4
    )


def test_rounding_makes_no_extra_cells() -> None:
    assert grid([0, 0, 0], [1.0, 0.3, 0.7], 0.1).shape == (10, 3, 7)
    assert grid([0, 0, 0], [1.01, 0.3, 0.7], 0.1).shape == (11, 3, 7)


def test_a_flat_box_is_one_layer() -> None:
    assert grid([0, 0, 1], [2, 2, 1], 0.5).shape == (4, 4, 1)
    assert grid([0, 0, 0], [0, 0, 0], 0.5).n_items == 1


@pytest.mark.parametrize(
    ("lower", "upper", "resolution", "error"),
    [
        ([0, 0, 0], [-1, 1, 1], 0.1, BadPointsError),
        ([0, 0, 0], [1, 1, 1], 0.0, BadPointsError),
        ([0, 0, 0], [1, 1, 1], -0.1, BadPointsError),
        ([0, 0, 0], [1, 1, 1], np.nan, BadPointsError),
        ([0, 0, 0], [1, 1, 1], np.inf, BadPointsError),
        ([0, 0, np.nan], [1, 1, 1], 0.1, BadPointsError),
        ([0, 0], [1, 1], 0.1, ShapeError),
        ([0, 0, 0], [1e5, 1, 1], 0.1, OutOfRangeError),
        ([0, 0, 0], [10, 10, 10], 0.1, TooLargeError),
        ([0, 0, 0], [10, 10, 10], 1e-150, TooLargeError),
        ([0, 0, 0], [10, 10, 10], 1e-320, TooLargeError),
    ],
)
def test_bad_grids(lower: list, upper: list, resolution: float, error: type[Exception]) -> None:
    with pytest.raises(error):
        grid(lower, upper, resolution)


def test_an_empty_map_answers() -> None:
    plan = Grid([0, 0, 0], [1, 1, 1], 0.5).plan(KernelMap(KernelSet.empty()), LIMITS)
    assert not plan.part(0).occupancy.observed.any()
