"""What all questions share: one map under all parts, and one limit of coordinates."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from potserver.asking.grid import Grid
from potserver.asking.params import Params
from potserver.asking.plan import Plan
from potserver.asking.points import Points, PointsPlan
from potserver.asking.rays import Rays
from potserver.asking.risk import Risk
from potserver.asking.tile_codes import TileMemory
from potserver.asking.tiles import Tiles
from potserver.domain.dictionary import AtomDictionary
from potserver.errors import OutOfRangeError
from potserver.limits import Limits
from potserver.mapping.service import MappingService
from tests.tiled_maps import free_kernels, tiled_state

STATE = tiled_state({(0, 0, 0): (free_kernels(60), 3), (1, 0, 0): (free_kernels(60, 1), 5)}, revision=7)
LATER = tiled_state({(0, 0, 0): (free_kernels(99, 9), 9)}, revision=8)


class Numbers(Plan[range]):
    """The numbers below n."""

    def __init__(self, n: int, part_size: int) -> None:
        self._n, self.part_size = n, part_size

    @property
    def n_items(self) -> int:
        return self._n

    def part(self, i: int) -> range:
        run = self.items(i)
        return range(run.start, run.stop)


@pytest.mark.parametrize(
    ("n", "size", "lengths"),
    [(0, 5, [0]), (1, 5, [1]), (5, 5, [5]), (6, 5, [5, 1]), (10, 5, [5, 5]), (3, 1, [1, 1, 1])],
)
def test_parts_are_runs_that_add_up(n: int, size: int, lengths: list[int]) -> None:
    plan = Numbers(n, size)
    assert plan.n_parts == len(lengths)
    assert [len(part) for part in plan.parts()] == lengths
    assert [number for part in plan.parts() for number in part] == list(range(n))


def numbers_in(part: Any) -> np.ndarray:
    """All numbers of a part in a row."""
    if dataclasses.is_dataclass(part):
        part = [getattr(part, field.name) for field in dataclasses.fields(part)]
    if isinstance(part, tuple | list):
        return np.concatenate([np.zeros(0), *(numbers_in(value) for value in part)])
    return np.zeros(0) if part is None else np.asarray(part, np.float64).reshape(-1)


def test_all_parts_come_from_one_map_whatever_becomes_of_it() -> None:
    mapping = MappingService(AtomDictionary(()), threads=1)
    mapping.state = STATE
    limits, snapshot = Limits(), mapping.snapshot
    plans: list[Plan[Any]] = [
        Points([[1.0, 2, 3]]).plan(snapshot, limits),
        Grid([0, 0, 0], [2, 2, 2], 0.5).plan(snapshot, limits, part_cells=30),
        Rays([[1.0, 1, 1]] * 4, [[1.0, 0, 0]] * 4, 3.0).plan(snapshot, limits, part_samples=1),
        Risk(np.eye(4)[None], [[4.0, 4, 4, 1.0]]).plan(snapshot, limits, part_cells=10),
        Params().plan(snapshot, limits, part_kernels=50),
        Tiles().plan(mapping.state, limits, TileMemory(), tile_size_m=8.0, part_kernels=50),
    ]
    before = [numbers_in(list(plan.parts())) for plan in plans]
    mapping.state = LATER
    for plan, expected in zip(plans, before, strict=True):
        assert plan.n_parts > 1 or isinstance(plan, PointsPlan)
        np.testing.assert_array_equal(numbers_in(list(plan.parts())), expected)


def plan_all_at(x_m: float) -> list[Any]:
    """For every kind of question, what plans one about a place."""
    pose, corner, limits = np.eye(4), [x_m, 0.0, 0.0], Limits()
    pose[0, 3] = x_m
    return [
        lambda: Points([corner]).plan(STATE.snapshot, limits),
        lambda: Grid(corner, corner, 1.0).plan(STATE.snapshot, limits),
        lambda: Rays([corner], [[1.0, 0, 0]], 1.0).plan(STATE.snapshot, limits),
        lambda: Risk(pose[None], [[0.0, 0, 0, 1.0]]).plan(STATE.snapshot, limits),
        lambda: Params(corner).plan(STATE.snapshot, limits),
        lambda: Tiles(lower=corner).plan(STATE, limits, TileMemory(), tile_size_m=8.0),
    ]


def test_there_is_one_limit_of_coordinates_and_it_is_that_of_the_clouds() -> None:
    assert Limits().max_coordinate_m == 2e7
    for near, far in zip(plan_all_at(1.99e7), plan_all_at(2.01e7), strict=True):
        near()
        with pytest.raises(OutOfRangeError):
            far()
