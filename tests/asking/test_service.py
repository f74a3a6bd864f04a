"""Bounded questions to a map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from potserver.asking.service import QueryService
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.mapping.service import MappingService


def _kernels(k: int = 300, seed: int = 0) -> KernelSet:
    rng = np.random.default_rng(seed)
    return KernelSet(
        hinge_mean=rng.uniform(-5, 5, (k, 3)),
        hinge_var=rng.random((k, 3)).astype(np.float32),
        gamma_shape=np.full(k, 10.0, np.float32),
        gamma_rate=np.full(k, 10.0, np.float32),
        weight_mean=rng.normal(size=k).astype(np.float32),
        weight_var=np.ones(k, np.float32),
    )


@pytest.fixture
def mapping() -> MappingService:
    service = MappingService(AtomDictionary(()), threads=1)
    service.state = MapState(snapshot=KernelMap(_kernels(), map_revision=7, threads=1))
    return service


@pytest.fixture
def query(mapping: MappingService) -> QueryService:
    return QueryService(mapping, max_points=100, max_grid_cells=5_000, max_coordinate_m=1e4)


def test_points_are_answered_by_the_snapshot(mapping: MappingService, query: QueryService) -> None:
    points = np.random.default_rng(1).uniform(-5, 5, (100, 3))
    answer, truth = query.occupancy(points), mapping.snapshot.occupancy(points)
    np.testing.assert_array_equal(answer.mean, truth.mean)
    assert answer.map_revision == 7


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((101, 3)), TooLargeError),
        ([[1.01e4, 0, 0]], OutOfRangeError),
        ([[0, 0, -2e4]], OutOfRangeError),
        ([[np.nan, 0, 0]], BadPointsError),
        ([[np.inf, 0, 0]], BadPointsError),
        (np.zeros((3, 4)), ShapeError),
        ([], ShapeError),
    ],
)
def test_bad_points(query: QueryService, points: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        query.occupancy(points)


def test_no_points_is_a_question_too(query: QueryService) -> None:
    assert len(query.occupancy(np.zeros((0, 3))).mean) == 0


def test_grid_parts_are_the_cells_in_order(query: QueryService, mapping: MappingService) -> None:
    plan = query.grid([-2.0, -1.0, 0.0], [1.0, 1.0, 1.0], 0.5, part_cells=17)
    assert plan.shape == (6, 4, 2)
    assert plan.n_cells == 48
    assert plan.n_parts == 3
    axes = [low + 0.5 * (np.arange(n) + 0.5) for low, n in zip((-2.0, -1.0, 0.0), plan.shape, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    parts = [plan.part(i) for i in range(plan.n_parts)]
    assert [first for first, _ in parts] == [0, 17, 34]
    np.testing.assert_allclose(
        np.concatenate([a.mean for _, a in parts]), mapping.snapshot.occupancy(centres).mean, atol=1e-4
    )


def test_all_parts_come_from_one_snapshot(query: QueryService, mapping: MappingService) -> None:
    plan = query.grid([-1, -1, -1], [1, 1, 1], 0.5, part_cells=30)
    first = plan.part(0)[1]
    mapping.state = MapState(snapshot=KernelMap(_kernels(seed=9), map_revision=8))
    again, last = plan.part(0)[1], plan.part(plan.n_parts - 1)[1]
    np.testing.assert_array_equal(first.mean, again.mean)
    assert first.map_revision == last.map_revision == 7


def test_rounding_makes_no_extra_cells(query: QueryService) -> None:
    assert query.grid([0, 0, 0], [1.0, 0.3, 0.7], 0.1).shape == (10, 3, 7)
    assert query.grid([0, 0, 0], [1.01, 0.3, 0.7], 0.1).shape == (11, 3, 7)


def test_a_flat_box_is_one_layer(query: QueryService) -> None:
    assert query.grid([0, 0, 1], [2, 2, 1], 0.5).shape == (4, 4, 1)
    assert query.grid([0, 0, 0], [0, 0, 0], 0.5).n_cells == 1


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
def test_bad_grids(
    query: QueryService, lower: list, upper: list, resolution: float, error: type[Exception]
) -> None:
    with pytest.raises(error):
        query.grid(lower, upper, resolution)


@pytest.mark.parametrize("part_kernels", [1, 7, 150, 10_000])
def test_params_come_in_parts_that_add_up(query: QueryService, part_kernels: int) -> None:
    parts, revision = query.params(part_kernels=part_kernels)
    assert revision == 7
    assert all(len(p) <= part_kernels for p in parts)
    joined = KernelSet.concatenate(parts)
    for field in dataclasses.fields(KernelSet):
        np.testing.assert_array_equal(getattr(joined, field.name), getattr(_kernels(), field.name))


def test_params_in_a_box(query: QueryService) -> None:
    hinge = _kernels().hinge_mean
    inside = ((hinge >= -1) & (hinge <= 2)).all(axis=1)
    parts, _ = query.params([-1, -1, -1], [2, 2, 2])
    np.testing.assert_array_equal(KernelSet.concatenate(parts).hinge_mean, hinge[inside])
    assert 0 < inside.sum() < 300
    nothing, _ = query.params([8, 8, 8], [9, 9, 9])
    assert [len(p) for p in nothing] == [0], "one empty part, not silence"


@pytest.mark.parametrize("corner", [[np.nan, 0, 0], [0, 0], [1e9, 0, 0]])
def test_params_with_a_bad_corner(query: QueryService, corner: list) -> None:
    with pytest.raises((BadPointsError, ShapeError, OutOfRangeError)):
        query.params(corner, None)


def test_an_empty_map_answers(mapping: MappingService, query: QueryService) -> None:
    mapping.state = MapState(snapshot=KernelMap(KernelSet.empty(), map_revision=1))
    assert not query.occupancy([[0.0, 0, 0]]).observed.any()
    assert not query.grid([0, 0, 0], [1, 1, 1], 0.5).part(0)[1].observed.any()
    parts, revision = query.params()
    assert (sum(len(p) for p in parts), revision) == (0, 1)
