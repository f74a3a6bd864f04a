"""How evidence is added and taken off, saturates and is forgotten."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.evidence import (
    FREE,
    HIT,
    LABELS,
    NEAR,
    PASSED,
    SCALES,
    SHADOW,
    add,
    cells,
    clip,
    counts,
    decay,
    forget,
    is_alive,
    kind_of,
    positions,
)
from tests.numerics.evidence.samples import FINE_M, rows_of


def test_taking_off_more_than_there_is_leaves_nothing() -> None:
    rows, gained = add(
        rows_of([[0.1, 0.1, 0.1]], True), np.full((1, 3), 0.1), np.array([True]), np.array([-5.0]), FINE_M
    )
    assert rows.sums[0, 3] == 0.0
    assert gained[0] == -1.0
    assert not is_alive(rows).any()


def test_taking_off_what_never_was_adds_no_row() -> None:
    rows, _ = add(
        rows_of([[0.1, 0.1, 0.1]], True), np.full((1, 3), 9.0), np.array([True]), np.array([-1.0]), FINE_M
    )
    assert len(rows.occupied) == 1


def test_a_cell_is_a_free_voxel_and_the_hits_in_it() -> None:
    rows = rows_of(
        [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [0.2, 0.2, 0.1], [0.5, 0.1, 0.1]], [True, True, False, True]
    )
    number, _, n = cells(rows)
    assert n == 2
    assert number[0] == number[1] == number[2] != number[3]


@pytest.mark.parametrize("looks", [1, 20, 400])
def test_looks_at_one_place_count_less_and_less(looks: int) -> None:
    points = np.tile([[0.1, 0.1, 0.1], [0.2, 0.2, 0.3]], (looks, 1))
    rows = rows_of(points, np.tile([True, False], looks))
    count = counts(rows, cells(rows), 20.0)
    np.testing.assert_allclose(count, looks / (1 + 2 * looks / 20.0), rtol=1e-5)
    assert count.sum() < 20.0


def test_old_evidence_gives_way_to_new() -> None:
    rows = rows_of(np.tile([0.1, 0.1, 0.1], (100, 1)), True)
    rows, gained = add(rows, np.tile([0.15, 0.1, 0.1], (30, 1)), np.zeros(30, bool), np.ones(30), FINE_M)
    where = positions(rows, FINE_M)
    forget(rows, gained, cells(rows), 50.0)
    np.testing.assert_allclose(rows.sums[:, 3], [20.0, 30.0], rtol=1e-5)
    np.testing.assert_allclose(positions(rows, FINE_M), where, atol=1e-6)
    # one scan alone above the limit is scaled itself
    rows, gained = add(rows, np.tile([0.15, 0.1, 0.1], (200, 1)), np.zeros(200, bool), np.ones(200), FINE_M)
    forget(rows, gained, cells(rows), 50.0)
    np.testing.assert_allclose(rows.sums[:, 3], [0.0, 50.0], atol=1e-3)


def test_cells_without_new_evidence_forget_nothing() -> None:
    rows = rows_of(np.tile([0.1, 0.1, 0.1], (100, 1)), True)
    forget(rows, np.zeros(1, np.float32), cells(rows), 50.0)
    assert rows.sums[0, 3] == 100.0


def test_decay_scales_all() -> None:
    rows = rows_of([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], [True, False])
    np.testing.assert_allclose(decay(rows, 0.5).sums, 0.5 * rows.sums)


def test_kinds_have_rows_of_their_own_in_voxels_of_their_own() -> None:
    points = np.tile([0.1, 0.1, 0.1], (4, 1))
    kind = np.array([FREE, HIT, SHADOW, NEAR], np.uint8)
    rows = rows_of(points, kind)
    assert sorted(rows.kind.tolist()) == [FREE, HIT, SHADOW, NEAR]
    assert rows.occupied.tolist() == [k == HIT for k in rows.kind]
    assert rows.halvings.tolist() == [k in (HIT, NEAR) for k in rows.kind]
    np.testing.assert_allclose(positions(rows, FINE_M), points, atol=1e-6)
    assert LABELS[[FREE, HIT, SHADOW, NEAR]].tolist() == [0.0, 1.0, 0.5, 0.0]


def test_rows_of_a_scale_have_voxels_of_half_the_edge() -> None:
    kind = kind_of(HIT, np.arange(SCALES, dtype=np.uint8))
    for apart_m, n in ((0.24, (2, 2, 2)), (0.12, (1, 2, 2)), (0.06, (1, 1, 2))):
        for scale in range(SCALES):
            points = np.array([[0.01, 0.01, 0.01], [0.01 + apart_m, 0.01, 0.01]])
            rows = rows_of(points, np.repeat(kind[scale : scale + 1], 2))
            assert len(rows.kind) == n[scale]
            assert rows.scale.tolist() == [scale] * n[scale]
            assert rows.occupied.all()
            np.testing.assert_allclose(positions(rows, FINE_M).mean(axis=0), points.mean(axis=0), atol=1e-6)


@pytest.mark.parametrize("scale", [1, 2])
def test_a_shadow_is_none_where_another_scale_saw_free_space(scale: int) -> None:
    """A thin plate, seen from both sides by beams that lie closely on one of them."""
    fine, coarse = np.array([scale, 0], np.uint8), np.array([0, scale], np.uint8)
    for scales in (fine, coarse):
        kind = np.array([kind_of(SHADOW, scales[:1])[0], kind_of(NEAR, scales[1:])[0]])
        rows = rows_of(np.tile([0.1, 0.1, 0.1], (2, 1)), kind)
        count = dict(zip(rows.sort.tolist(), counts(rows, cells(rows), 20.0).tolist(), strict=True))
        assert count[SHADOW] == 0.0
        assert count[NEAR] > 0.0


def test_rows_keep_their_size_in_a_map_of_another_resolution() -> None:
    sort = np.array([FREE, HIT, NEAR, SHADOW, PASSED], np.uint8)
    rows = rows_of(np.arange(15.0).reshape(5, 3), sort + kind_of(0, np.array([0, 1, 1, 1, 0], np.uint8)))
    assert rows.rescaled(1.1).kind.tolist() == rows.kind.tolist()
    assert rows.rescaled(2.0).kind.tolist() == rows.sort.tolist()
    assert rows.rescaled(0.5).scale.tolist() == [2 * (k in (HIT, NEAR, SHADOW)) for k in rows.sort]
    assert rows.rescaled(2.0).sort.tolist() == rows.sort.tolist()


def test_a_shadow_counts_only_where_nobody_looked() -> None:
    alone = rows_of([[0.1, 0.1, 0.1]], np.array([SHADOW], np.uint8))
    assert 0.0 < counts(alone, cells(alone), 20.0)[0] < 0.2
    seen = rows_of(np.tile([0.1, 0.1, 0.1], (2, 1)), np.array([SHADOW, FREE], np.uint8))
    count = dict(zip(seen.kind.tolist(), counts(seen, cells(seen), 20.0).tolist(), strict=True))
    assert count[SHADOW] == 0.0
    assert count[FREE] == pytest.approx(1 / (1 + 1 / 20.0)), "a shadow takes nothing from what was seen"


def test_a_shadow_weighs_one_look_however_often_it_falls() -> None:
    rows = rows_of(np.tile([0.1, 0.1, 0.1], (9, 1)), np.full(9, SHADOW, np.uint8))
    where = positions(rows, FINE_M)
    clip(rows, 200.0)
    assert rows.sums[0, 3] == pytest.approx(1.0)
    np.testing.assert_allclose(positions(rows, FINE_M), where, atol=1e-6)
