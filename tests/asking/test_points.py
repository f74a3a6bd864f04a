"""Occupancy at any points."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.asking.points import Points
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import KernelSet, Occupancy
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from tests.tiled_maps import free_kernels

SNAPSHOT = KernelMap(free_kernels(300), map_revision=7, threads=1)
LIMITS = Limits(max_query_points=100, max_coordinate_m=1e4)


def ask(points: object, snapshot: KernelMap = SNAPSHOT) -> Occupancy:
    (answer,) = Points(points).plan(snapshot, LIMITS).parts()  # type: ignore[arg-type]
    return answer


def test_points_are_answered_by_the_snapshot() -> None:
    points = np.random.default_rng(1).uniform(-5, 5, (100, 3))
    answer, truth = ask(points), SNAPSHOT.occupancy(points)
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
def test_bad_points(points: object, error: type[Exception]) -> None:
    with pytest.raises(error):
        ask(points)


def test_no_points_is_a_question_too() -> None:
    assert len(ask(np.zeros((0, 3))).mean) == 0


def test_an_empty_map_answers() -> None:
    assert not ask([[0.0, 0, 0]], KernelMap(KernelSet.empty(), map_revision=1)).observed.any()
