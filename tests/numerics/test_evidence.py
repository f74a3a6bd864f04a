"""How evidence saturates, is forgotten, and fades where beams pass through."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.evidence import (
    _TURNS,
    Rows,
    SeenThrough,
    add,
    add_sparing,
    cells,
    counts,
    decay,
    forget,
    is_alive,
    positions,
    see_through,
)

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


def _see_through(rows: Rows, ends, is_return, **changes) -> SeenThrough:
    ends = np.atleast_2d(np.asarray(ends, float))
    options = {"fine_m": FINE_M, "rate": 0.1, "gap_m": 0.3} | changes
    return see_through(rows, ends, np.broadcast_to(is_return, len(ends)).copy(), np.zeros(3), **options)


def _fan(n: int, at_m: float = 10.0, width_m: float = 0.1) -> np.ndarray:
    """(N, 3) ends of beams close together along x."""
    return np.stack([np.full(n, at_m), np.linspace(0.02, width_m, n), np.full(n, 0.05)], axis=1)


def test_hits_that_beams_pass_through_fade_and_free_space_comes_in_their_place() -> None:
    rows = _rows(
        [[3.0, 0.01, 0.01], [3.0, 1.5, 0.0], [9.9, 0.05, 0.05], [3.0, 0.01, 0.01]],
        [True, True, True, False],
        [4.0, 1.0, 1.0, 0.5],
    )
    before, where = rows.sums.copy(), positions(rows, FINE_M)
    seen = _see_through(rows, _fan(24), True)
    np.testing.assert_allclose(rows.sums[0], before[0] * np.exp(-0.1), rtol=1e-5)
    np.testing.assert_array_equal(rows.sums[1:], before[1:])  # beside the beams, at their ends, and free
    np.testing.assert_allclose(positions(rows, FINE_M), where, atol=1e-6)
    np.testing.assert_allclose(seen.points, where[:1], atol=1e-6)
    assert seen.weight[0] > 1.0


@pytest.mark.parametrize("looks", [1, 100])
def test_free_evidence_outvotes_the_hits_of_a_cell_and_grows_no_further(looks: int) -> None:
    rows = _rows(np.tile([[3.0, 0.01, 0.01], [3.1, 0.01, 0.01]], (looks, 1)), True)
    for _ in range(40):
        seen = _see_through(rows, _fan(30), False, rate=0.05)
        rows, _ = add(rows, seen.points, np.zeros(len(seen.weight), bool), seen.weight, FINE_M)
    free = rows.sums[~rows.occupied, 3].sum()
    hits_before = rows.sums[rows.occupied, 3].sum() * np.exp(0.05 * 40)
    assert hits_before == pytest.approx(2 * looks, rel=1e-3)
    assert looks < free < 3.0 * 2 * looks
    assert _see_through(rows, _fan(30), False, rate=0.05).weight.sum() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("n", [1, 3, 9])
def test_a_few_beams_tell_nothing_of_what_they_pass(n: int) -> None:
    """They may have missed a pole or a wire."""
    rows = _rows([[3.0, 0.01, 0.01]], True)
    before = rows.sums.copy()
    assert len(_see_through(rows, _fan(n), False).weight) == 0
    np.testing.assert_array_equal(rows.sums, before)


def test_beams_that_graze_a_surface_leave_it() -> None:
    """Each passes through many voxels of hits along its way."""
    wall = np.stack([np.arange(2.0, 7.0, 0.1), np.full(50, 0.05), np.full(50, 0.05)], axis=1)
    rows = _rows(wall, True)
    assert len(_see_through(rows, _fan(4), True).weight) == 0
    assert len(_see_through(rows.take(slice(3)), _fan(24), True).weight) == 3, (
        "many that go through a little of it tell"
    )


def test_beams_left_out_are_stood_for() -> None:
    one, two = _rows([[3.0, 0.01, 0.01]], True), _rows([[3.0, 0.01, 0.01]], True)
    ends = _fan(1)
    all_of_them = _see_through(one, np.repeat(ends, 40, axis=0), False)
    a_half = _see_through(two, np.repeat(ends, 40, axis=0), False, most_followed=20)
    np.testing.assert_array_equal(one.sums, two.sums)
    np.testing.assert_array_equal(all_of_them.weight, a_half.weight)


def test_a_hit_beside_a_new_one_does_not_fade() -> None:
    rows = _rows([[3.0, 0.01, 0.0]], True)
    ends = np.concatenate([_fan(20), [[3.0, 0.19, 0.0]]])
    assert len(_see_through(rows, ends, True).weight) == 0


def test_rows_of_all_robots_fade_and_share_the_free_evidence() -> None:
    rows = _rows([[3.0, 0.01, 0.01]], True, [10.0])
    both, _ = add(rows, np.array([[3.0, 0.01, 0.01]]), np.array([True]), np.full(1, 10.0), FINE_M, source=1)
    alone = _see_through(rows, _fan(24), False, rate=0.01)
    shared = _see_through(both, _fan(24), False, rate=0.01)
    np.testing.assert_allclose(both.sums[:, 3], 10.0 * np.exp(-0.01), rtol=1e-5)
    assert alone.weight.sum() < shared.weight.sum() < 2.0 * alone.weight.sum()


@pytest.mark.parametrize("threads", [2, 5])
def test_passes_are_counted_alike_on_any_number_of_threads(threads: int) -> None:
    rng = np.random.default_rng(0)
    points, ends = rng.uniform(-2, 2, (300, 3)), rng.normal(0, 8, (6000, 3))
    one, other = _rows(points, True), _rows(points, True)
    seen, same = _see_through(one, ends, False), _see_through(other, ends, False, threads=threads)
    assert len(seen.weight) > 100
    np.testing.assert_array_equal(seen.weight, same.weight)
    np.testing.assert_array_equal(seen.points, same.points)
    np.testing.assert_array_equal(one.sums, other.sums)


def test_nothing_to_see_through() -> None:
    assert len(_see_through(Rows.empty(), [[1.0, 0, 0]], True).weight) == 0
    assert len(_see_through(_rows([[3.0, 0.01, 0.0]], True), np.zeros((0, 3)), True).weight) == 0
    assert len(_see_through(_rows([[3.0, 0.01, 0.0]], True), [[0.0, 9.0, 0.0]], True).weight) == 0


def _joined(rows: Rows, point, occupied: bool, weight: float = 1 / 3, source: int = 0) -> Rows:
    """The rows after one more sample, let join what is there."""
    joined = add_sparing(rows, np.array([point]), np.array([occupied]), np.array([weight]), FINE_M, source)
    assert joined.n_old == len(rows.occupied)
    assert joined.weight.sum() == pytest.approx(weight)
    assert joined.rows.sums[:, 3].sum() == pytest.approx(rows.sums[:, 3].sum() + weight)
    np.testing.assert_array_equal(joined.rows.voxel[: len(rows.occupied)], rows.voxel)
    return joined.rows


def test_in_clear_space_a_light_row_joins_the_nearest_beside_it() -> None:
    rows = _rows([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], False)
    before = rows.sums.copy()
    joined = _joined(rows, [0.5, 0.1, 0.3], False)
    assert len(joined.occupied) == 2
    np.testing.assert_array_equal(rows.sums, before)  # what was given is not changed
    nearest = int(np.argmax(joined.sums[:, 3]))
    expected = (positions(rows, FINE_M)[nearest] + np.array([0.5, 0.1, 0.3]) / 3) / (4 / 3)
    bounds = rows.voxel[nearest] * FINE_M, (rows.voxel[nearest] + 1) * FINE_M
    np.testing.assert_allclose(positions(joined, FINE_M)[nearest], np.clip(expected, *bounds), atol=1e-5)


@pytest.mark.parametrize(
    ("point", "weight"),
    [([0.5, 0.1, 0.1], 1.5), ([1.3, 0.1, 0.1], 1 / 3), ([0.5, 0.1, 0.1], 1 / 3)],
    ids=["of more than a look", "with nothing beside it", "beside a lighter one"],
)
def test_a_row_keeps_its_place(point: list[float], weight: float) -> None:
    rows = _rows([[0.1, 0.1, 0.1]], False, np.array([2.0 if weight > 1 else 0.3]))
    assert len(_joined(rows, point, False, weight).occupied) == 2


@pytest.mark.parametrize(("times", "n_rows"), [(20.0, 3), (30.0, 2)])
def test_beside_hits_a_free_row_joins_only_what_outweighs_it_far(times: float, n_rows: int) -> None:
    rows = _rows([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], [False, True], np.array([times / 3, 1.0]))
    joined = _joined(rows, [0.5, 0.1, 0.1], False)
    assert len(joined.occupied) == n_rows
    np.testing.assert_array_equal(joined.sums[1], rows.sums[1])  # the hit is as it was


def test_a_free_row_among_hits_stays_whatever_is_beside_it() -> None:
    rows = _rows([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]], [False, True], np.array([100.0, 1.0]))
    joined = _joined(rows, [0.7, 0.1, 0.1], False)
    assert len(joined.occupied) == 3
    np.testing.assert_array_equal(joined.sums[:2], rows.sums)


@pytest.mark.parametrize(("times", "n_rows"), [(20.0, 2), (30.0, 1)])
def test_a_hit_joins_only_what_outweighs_it_far(times: float, n_rows: int) -> None:
    rows = _rows([[0.1, 0.1, 0.1]], True, np.array([times / 3]))
    assert len(_joined(rows, [0.21, 0.1, 0.1], True).occupied) == n_rows


@pytest.mark.parametrize(("times", "hit_x", "n_rows"), [(4.0, 9.0, 2), (2.0, 9.0, 3), (4.0, 2.1, 3)])
def test_far_from_hits_a_row_two_voxels_away_will_do(times: float, hit_x: float, n_rows: int) -> None:
    rows = _rows([[0.1, 0.1, 0.1], [hit_x, 0.1, 0.1]], [False, True], np.array([times / 3, 1.0]))
    assert len(_joined(rows, [0.9, 0.1, 0.1], False).occupied) == n_rows


def test_rows_of_other_sources_are_not_joined_and_their_hits_count() -> None:
    rows = _rows([[0.1, 0.1, 0.1]], False)
    other = _joined(rows, [0.5, 0.1, 0.1], False, source=1)
    np.testing.assert_array_equal(other.source, [0, 1])
    hit = add(rows, np.array([[0.9, 0.1, 0.1]]), np.array([True]), np.ones(1), FINE_M, 1).rows
    assert len(_joined(hit, [0.5, 0.1, 0.1], False).occupied) == 3


_BOX = np.full(3, -4.0), np.full(3, 4.0)


def _after_all_turns(rows: Rows, within=_BOX, source: int = 0) -> Rows:
    """The rows after every old one has been looked at once, without anything new."""
    none = np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0)
    for turn in range(_TURNS):
        joined = add_sparing(rows, *none, FINE_M, source, within=within, turn=turn)
        assert joined.n_old == len(joined.rows.occupied) == len(joined.weight)
        assert joined.rows.sums[:, 3].sum() == pytest.approx(rows.sums[:, 3].sum())
        rows = joined.rows
    return rows


@pytest.mark.parametrize(
    ("occupied", "weight", "times", "n_rows"),
    [
        (False, 1.0, 9.0, 2),
        (False, 1.0, 11.0, 1),
        (False, 3.5, 50.0, 2),
        (True, 1.0, 24.0, 2),
        (True, 1.0, 26.0, 1),
    ],
    ids=["outweighed little", "outweighed", "of many looks", "a hit, outweighed little", "a hit, outweighed"],
)
def test_an_old_light_row_joins_what_has_come_to_outweigh_it(
    occupied: bool, weight: float, times: float, n_rows: int
) -> None:
    x = 0.21 if occupied else 0.5
    rows = _rows([[0.1, 0.1, 0.1], [x, 0.1, 0.1]], occupied, np.array([times * weight, weight]))
    left = _after_all_turns(rows)
    assert len(left.occupied) == n_rows
    if n_rows == 1:
        edge = FINE_M / 2 if occupied else FINE_M
        mean_x = (times * 0.1 + x) / (times + 1)
        assert positions(left, FINE_M)[0, 0] == pytest.approx(min(mean_x, edge), abs=1e-5)


def test_an_old_light_row_stays_among_hits_outside_the_box_or_anothers() -> None:
    among_hits = _rows(
        [[0.1, 0.1, 0.1], [0.5, 0.1, 0.1], [0.7, 0.1, 0.1]], [False, False, True], [100.0, 1, 1]
    )
    assert len(_after_all_turns(among_hits).occupied) == 3
    rows = _rows([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]], False, np.array([100.0, 1.0]))
    assert len(_after_all_turns(rows).occupied) == 1
    assert len(_after_all_turns(rows, None).occupied) == 2
    assert len(_after_all_turns(rows, (np.full(3, -4.0), np.full(3, 0.79))).occupied) == 2
    assert len(_after_all_turns(rows, source=1).occupied) == 2


@pytest.mark.parametrize("robots", [1, 2, 3, 4])
def test_robots_that_take_turns_get_to_all_their_old_rows(robots: int) -> None:
    light = np.stack(np.meshgrid(*[np.arange(-6, 6, 2) + 0.5] * 3), axis=-1).reshape(-1, 3) * FINE_M
    heavy = light + np.array([FINE_M, 0, 0])
    rows = _rows(np.concatenate([light, heavy]), False, np.repeat([1.0, 50.0], len(light)))
    none = np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0)
    for turn in range(0, 3 * robots * _TURNS, robots):
        before = len(rows.occupied)
        rows, _, n_old = add_sparing(
            rows, *none, FINE_M, within=(np.full(3, -9.0), np.full(3, 9.0)), turn=turn
        )
        assert before - n_old < 0.5 * len(light)
    assert len(rows.occupied) == len(heavy)
