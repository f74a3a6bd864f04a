"""Which tiles an asker needs."""

from __future__ import annotations

import dataclasses
import gc
from typing import Any

import numpy as np
import pytest

from potserver.asking.tile_codes import TileMemory
from potserver.asking.tiles import KnownTiles, Tiles, TilesPlan
from potserver.domain.map_state import MapState
from potserver.domain.types import KernelSet
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from tests.tiled_maps import GRID, free_kernels, tiled_state

TILES = {
    (0, 0, 0): (free_kernels(30), 3),
    (1, 0, 0): (free_kernels(40, 1), 5),
    (-1, 2, 0): (free_kernels(50, 2), 7),
}


STATE = tiled_state(TILES, epoch=9, revision=7)


class FewTiles(Limits):
    max_query_tiles = 4


FEW = FewTiles(max_coordinate_m=1e4)


def plan_of(
    known: KnownTiles | None = None,
    *,
    state: MapState = STATE,
    part_kernels: int = 20_000,
    limits: Limits = FEW,
    **asked: Any,
) -> TilesPlan:
    return Tiles(known, **asked).plan(
        state, limits, TileMemory(), tile_size_m=GRID.size_m, part_kernels=part_kernels
    )


def known(*tiles: tuple[int, int, int, int], epoch: int = 9) -> KnownTiles:
    columns = np.array(tiles, np.int64).reshape(-1, 4)
    return KnownTiles(epoch, columns[:, :3], columns[:, 3])


def sent(plan: TilesPlan) -> set[tuple[int, int, int]]:
    return {index for index, _ in plan.tiles}


def test_who_knows_nothing_gets_everything() -> None:
    plan = plan_of()
    assert (plan.is_whole, plan.epoch, plan.map_revision, plan.n_parts) == (True, 9, 7, 1)
    assert sent(plan) == set(TILES)
    run = plan.part(0)
    assert run.counts.tolist() == [len(TILES[tuple(i)][0]) for i in run.indices.tolist()]
    assert run.revisions.tolist() == [TILES[tuple(i)][1] for i in run.indices.tolist()]
    whole = KernelSet.concatenate([TILES[tuple(i)][0] for i in run.indices.tolist()])
    np.testing.assert_array_equal(run.kernels.hinge_mean, whole.hinge_mean)
    np.testing.assert_array_equal(run.kernels.weight_mean, whole.weight_mean)


def test_only_tiles_of_another_revision_are_sent_and_those_gone_are_named() -> None:
    plan = plan_of(known((0, 0, 0, 3), (1, 0, 0, 4), (5, 5, 5, 2)))
    assert not plan.is_whole
    assert sent(plan) == {(1, 0, 0), (-1, 2, 0)}
    assert plan.gone.tolist() == [[5, 5, 5]]
    # a revision that is ahead of ours is another one too
    assert sent(plan_of(known((0, 0, 0, 4)))) == set(TILES)


def test_what_an_asker_has_is_compared_whatever_it_says() -> None:
    """With tiles of any numbers, some of them twice: what it says last of a tile counts."""
    rng = np.random.default_rng(0)
    ends = np.iinfo(np.int64)
    rows = rng.integers(-2, 3, (200, 4))
    rows[:20, :3] = rng.choice([ends.min, ends.max, 0], (20, 3))
    plan = plan_of(known(*map(tuple, rows.tolist())), limits=Limits())
    last = {(x, y, z): revision for x, y, z, revision in rows.tolist()}
    assert sent(plan) == {index for index, (_, revision) in TILES.items() if last.get(index) != revision}
    assert len(plan.gone) == len(set(map(tuple, plan.gone.tolist())))
    assert set(map(tuple, plan.gone.tolist())) == set(last) - set(TILES)


def test_the_interpreter_is_not_held_for_as_many_tiles_as_an_asker_may_have() -> None:
    """Lists of 100,000 tiles took it for a fifth of a second, in which no other question was answered: arrays make none."""
    n = Limits.max_query_tiles
    rows = np.append(
        np.random.default_rng(0).integers(-1000, 1000, (n, 3)), np.ones((n, 1), np.int64), axis=1
    )
    have = KnownTiles(9, rows[:, :3], rows[:, 3])
    plan_of(have, limits=Limits())
    collections = []
    gc.callbacks.append(lambda phase, _: collections.append(phase))
    try:
        plan = plan_of(have, limits=Limits())
    finally:
        gc.callbacks.pop()
    assert len(plan.gone) > 0.99 * n
    assert len(collections) < 10, "every 700 tuples begin one"


def test_of_another_epoch_nothing_is_known() -> None:
    plan = plan_of(known((0, 0, 0, 3), (5, 5, 5, 2), epoch=8))
    assert plan.is_whole
    assert sent(plan) == set(TILES)
    assert len(plan.gone) == 0


def test_a_box_means_the_tiles_that_it_touches() -> None:
    size = GRID.size_m
    box = {"lower": [0.5, 0.5, 0.5], "upper": [size, 1.0, 1.0]}
    everything = ((0, 0, 0, 1), (1, 0, 0, 1), (-1, 2, 0, 1), (2, 0, 0, 1))
    assert sent(plan_of(**box)) == {(0, 0, 0), (1, 0, 0)}
    plan = plan_of(known(*everything), **box)
    assert sent(plan) == {(0, 0, 0), (1, 0, 0)}
    assert len(plan.gone) == 0, "tiles beyond the box are neither sent nor gone"
    assert sent(plan_of(upper=[-0.1, 99.0, 99.0])) == {(-1, 2, 0)}
    assert plan_of(known(*everything), lower=[size, 0, 0]).gone.tolist() == [[2, 0, 0]]


def test_a_tile_without_kernels_is_none() -> None:
    state = tiled_state(TILES | {(0, 0, 0): (KernelSet.empty(), 8)}, epoch=9, revision=8)
    plan = plan_of(known((0, 0, 0, 3)), state=state)
    assert (0, 0, 0) not in sent(plan)
    assert plan.gone.tolist() == [[0, 0, 0]]


def test_an_empty_map_has_no_tiles() -> None:
    plan = plan_of(known((0, 0, 0, 3)), state=dataclasses.replace(tiled_state({}, epoch=9), tiled=None))
    assert plan.tile_size_m == GRID.size_m
    assert (plan.n_parts, plan.gone.tolist()) == (1, [[0, 0, 0]])
    run = plan.part(0)
    assert (len(run.kernels), len(run.counts), run.indices.shape) == (0, 0, (0, 3))


@pytest.mark.parametrize("part_kernels", [1, 7, 30, 119, 120, 500])
def test_parts_hold_no_more_than_asked_for_and_together_all(part_kernels: int) -> None:
    plan = plan_of(part_kernels=part_kernels)
    runs = [plan.part(i) for i in range(plan.n_parts)]
    assert plan.n_parts == -(-120 // part_kernels)
    assert all(0 < len(run.kernels) == run.counts.sum() <= part_kernels for run in runs)
    together, whole = KernelSet.concatenate([run.kernels for run in runs]), plan_of().part(0)
    np.testing.assert_array_equal(together.hinge_mean, whole.kernels.hinge_mean)
    counts: dict[tuple[int, ...], int] = {}
    for run in runs:
        for index, n in zip(run.indices.tolist(), run.counts.tolist(), strict=True):
            counts[tuple(index)] = counts.get(tuple(index), 0) + n
    assert counts == {index: len(kernels) for index, (kernels, _) in TILES.items()}


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        ({"known": known(*[(i, 0, 0, 1) for i in range(5)])}, TooLargeError),
        ({"known": KnownTiles(9, np.zeros((2, 3), np.int64), np.zeros(3, np.int64))}, ShapeError),
        ({"known": KnownTiles(9, np.zeros((2, 2), np.int64), np.zeros(2, np.int64))}, ShapeError),
        ({"lower": [np.nan, 0, 0]}, BadPointsError),
        ({"upper": [1e5, 0, 0]}, OutOfRangeError),
        ({"lower": [0, 0]}, ShapeError),
        ({"step": 0.0}, BadPointsError),
        ({"step": 11.0}, BadPointsError),
        ({"step": float("nan")}, BadPointsError),
    ],
)
def test_bad_questions(arguments: dict, error: type[Exception]) -> None:
    with pytest.raises(error):
        plan_of(**arguments)
