"""How evidence saturates, is forgotten, and fades where beams pass through."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.evidence import Rows, add, cells, counts, decay, fade, forget, is_alive, positions

FINE_M = 0.4


def _rows(points, occupied, weight=None) -> Rows:
    points = np.atleast_2d(np.asarray(points, float))
    occupied = np.broadcast_to(occupied, len(points))
    return add(
        Rows.empty(), points, occupied, np.ones(len(points)) if weight is None else weight, FINE_M
    ).rows


def test_taking_off_more_than_there_is_leaves_nothing() -> None:
    rows, gained = add(
        _rows([[0.1, 0.1, 0.1]], True), np.full((1, 3), 0.1), np.array([True]), np.array([-5.0]), FINE_M
    )
    assert rows.sums[0, 3] == 0.0
    assert gained[0] == -1.0
    assert not is_alive(rows).any()


def test_taking_off_what_never_was_adds_no_row() -> None:
    rows, _ = add(
        _rows([[0.1, 0.1, 0.1]], True), np.full((1, 3), 9.0), np.array([True]), np.array([-1.0]), FINE_M
    )
    assert len(rows.occupied) == 1


def test_a_cell_is_a_free_voxel_and_the_hits_in_it() -> None:
    rows = _rows(
        [[0.1, 0.1, 0.1], [0.3, 0.3, 0.3], [0.2, 0.2, 0.1], [0.5, 0.1, 0.1]], [True, True, False, True]
    )
    number, n = cells(rows)
    assert n == 2
    assert number[0] == number[1] == number[2] != number[3]


@pytest.mark.parametrize("looks", [1, 20, 400])
def test_looks_at_one_place_count_less_and_less(looks: int) -> None:
    points = np.tile([[0.1, 0.1, 0.1], [0.2, 0.2, 0.3]], (looks, 1))
    rows = _rows(points, np.tile([True, False], looks))
    count = counts(rows.sums, cells(rows), 20.0)
    np.testing.assert_allclose(count, looks / (1 + 2 * looks / 20.0), rtol=1e-5)
    assert count.sum() < 20.0


def test_old_evidence_gives_way_to_new() -> None:
    rows = _rows(np.tile([0.1, 0.1, 0.1], (100, 1)), True)
    rows, gained = add(rows, np.tile([0.15, 0.1, 0.1], (30, 1)), np.zeros(30, bool), np.ones(30), FINE_M)
    where = positions(rows, FINE_M)
    forget(rows.sums, gained, cells(rows), 50.0)
    np.testing.assert_allclose(rows.sums[:, 3], [20.0, 30.0], rtol=1e-5)
    np.testing.assert_allclose(positions(rows, FINE_M), where, atol=1e-6)
    # one scan alone above the limit is scaled itself
    rows, gained = add(rows, np.tile([0.15, 0.1, 0.1], (200, 1)), np.zeros(200, bool), np.ones(200), FINE_M)
    forget(rows.sums, gained, cells(rows), 50.0)
    np.testing.assert_allclose(rows.sums[:, 3], [0.0, 50.0], atol=1e-3)


def test_cells_without_new_evidence_forget_nothing() -> None:
    rows = _rows(np.tile([0.1, 0.1, 0.1], (100, 1)), True)
    forget(rows.sums, np.zeros(1, np.float32), cells(rows), 50.0)
    assert rows.sums[0, 3] == 100.0


def test_decay_scales_all() -> None:
    rows = _rows([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], [True, False])
    np.testing.assert_allclose(decay(rows, 0.5).sums, 0.5 * rows.sums)


def _fade(rows: Rows, ends, is_return, **changes) -> int:
    ends = np.atleast_2d(np.asarray(ends, float))
    options = {"fine_m": FINE_M, "rate": 0.1, "gap_m": 0.3} | changes
    return fade(rows, ends, np.broadcast_to(is_return, len(ends)).copy(), np.zeros(3), **options)


def test_hits_that_beams_pass_through_fade() -> None:
    rows = _rows(
        [[3.0, 0.01, 0.0], [3.0, 1.0, 0.0], [9.9, 0.0, 0.0], [3.0, 0.01, 0.01]], [True, True, True, False]
    )
    before = rows.sums.copy()
    where = positions(rows, FINE_M)
    assert _fade(rows, np.tile([10.0, 0.0, 0.0], (3, 1)), True) == 1
    np.testing.assert_allclose(rows.sums[0], before[0] * np.exp(-0.3), rtol=1e-5)
    np.testing.assert_array_equal(rows.sums[1:], before[1:])  # beside the beam, at its end, and free
    np.testing.assert_allclose(positions(rows, FINE_M), where, atol=1e-6)


def test_one_scan_fades_a_hit_only_so_far() -> None:
    rows = _rows([[3.0, 0.01, 0.0]], True)
    _fade(rows, np.tile([10.0, 0.0, 0.0], (200, 1)), False)
    np.testing.assert_allclose(rows.sums[0, 3], np.exp(-0.5), rtol=1e-5)


def test_every_other_beam_stands_for_two() -> None:
    one, two = _rows([[3.0, 0.01, 0.0]], True), _rows([[3.0, 0.01, 0.0]], True)
    ends = np.tile([10.0, 0.0, 0.0], (4, 1))
    _fade(one, ends, False)
    _fade(two, ends, False, every=2)
    np.testing.assert_array_equal(one.sums, two.sums)


def test_a_hit_beside_a_new_one_does_not_fade() -> None:
    rows = _rows([[3.0, 0.01, 0.0]], True)
    ends = np.concatenate([np.tile([10.0, 0.0, 0.0], (3, 1)), [[3.0, 0.19, 0.0]]])
    assert _fade(rows, ends, True) == 0


@pytest.mark.parametrize("threads", [2, 5])
def test_passes_are_counted_alike_on_any_number_of_threads(threads: int) -> None:
    rng = np.random.default_rng(0)
    points, ends = rng.uniform(-5, 5, (3000, 3)), rng.normal(0, 8, (2000, 3))
    one, other = _rows(points, True), _rows(points, True)
    assert _fade(one, ends, True) == _fade(other, ends, True, threads=threads) > 100
    np.testing.assert_array_equal(one.sums, other.sums)


def test_nothing_to_fade() -> None:
    assert _fade(Rows.empty(), [[1.0, 0, 0]], True) == 0
    rows = _rows([[3.0, 0.01, 0.0]], True)
    assert (
        fade(rows, np.zeros((0, 3)), np.zeros(0, bool), np.zeros(3), fine_m=FINE_M, rate=0.1, gap_m=0.3) == 0
    )


def test_where_rows_are_many_free_samples_count_at_a_row_beside_them() -> None:
    rows = _rows([[0.1, 0.1, 0.1], [5.0, 5.0, 5.0]], [False, True])
    points = np.array([[0.5, 0.1, 0.1], [0.1, 0.9, 0.1], [5.3, 5.0, 5.0], [0.5, 0.5, 0.5]])
    occupied = np.array([False, False, False, True])
    where = positions(rows, FINE_M)
    spread, _ = add(rows, points, occupied, np.full(4, 0.5), FINE_M)
    assert len(spread.occupied) == 6
    crowded, gained = add(rows, points, occupied, np.full(4, 0.5), FINE_M, crowded=np.ones(4, bool))
    # beside a free row; beyond its neighbours; beside a hit; a hit itself
    assert len(crowded.occupied) == 5
    np.testing.assert_allclose(crowded.sums[:2, 3], [1.5, 1.0])
    np.testing.assert_allclose(positions(crowded, FINE_M)[:2], where, atol=1e-6)
    assert gained.sum() == pytest.approx(2.0)
    assert crowded.sums[:, 3].sum() == pytest.approx(spread.sums[:, 3].sum())


def test_rows_beside_new_hits_are_not_joined() -> None:
    rows = _rows([[0.1, 0.1, 0.1]], False)
    points, occupied = np.array([[0.5, 0.1, 0.1], [0.5, 0.5, 0.1]]), np.array([True, False])
    joined, _ = add(rows, points, occupied, np.ones(2), FINE_M, crowded=np.ones(2, bool))
    assert len(joined.occupied) == 3


def test_rows_of_others_are_not_joined() -> None:
    rows = _rows([[0.1, 0.1, 0.1]], False)
    point = np.array([[0.5, 0.1, 0.1]])
    other, _ = add(rows, point, np.array([False]), np.ones(1), FINE_M, 1, np.ones(1, bool))
    np.testing.assert_array_equal(other.source, [0, 1])
