"""How evidence of hits fades where beams pass through."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.beams import Beams
from potserver.numerics.evidence import Rows, SeenThrough, add, positions, see_through
from tests.numerics.evidence.samples import FINE_M, rows_of


def _see_through(rows: Rows, ends, is_return, **changes) -> SeenThrough:
    ends = np.atleast_2d(np.asarray(ends, float))
    options = {"fine_m": FINE_M, "rate": 0.1, "gap_m": 0.3} | changes
    beams = Beams(ends, np.broadcast_to(is_return, len(ends)).copy())
    return see_through(rows, beams, np.zeros(3), **options)


def _fan(n: int, at_m: float = 10.0, width_m: float = 0.1) -> np.ndarray:
    """(N, 3) ends of beams close together along x."""
    return np.stack([np.full(n, at_m), np.linspace(0.02, width_m, n), np.full(n, 0.05)], axis=1)


def test_hits_that_beams_pass_through_fade_and_free_space_comes_in_their_place() -> None:
    rows = rows_of(
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
    rows = rows_of(np.tile([[3.0, 0.01, 0.01], [3.1, 0.01, 0.01]], (looks, 1)), True)
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
    rows = rows_of([[3.0, 0.01, 0.01]], True)
    before = rows.sums.copy()
    assert len(_see_through(rows, _fan(n), False).weight) == 0
    np.testing.assert_array_equal(rows.sums, before)


def test_beams_that_graze_a_surface_leave_it() -> None:
    """Each passes through many voxels of hits along its way."""
    wall = np.stack([np.arange(2.0, 7.0, 0.1), np.full(50, 0.05), np.full(50, 0.05)], axis=1)
    rows = rows_of(wall, True)
    assert len(_see_through(rows, _fan(4), True).weight) == 0
    assert len(_see_through(rows.take(slice(3)), _fan(24), True).weight) == 3, (
        "many that go through a little of it tell"
    )


def test_beams_left_out_are_stood_for() -> None:
    one, two = rows_of([[3.0, 0.01, 0.01]], True), rows_of([[3.0, 0.01, 0.01]], True)
    ends = _fan(1)
    all_of_them = _see_through(one, np.repeat(ends, 40, axis=0), False)
    a_half = _see_through(two, np.repeat(ends, 40, axis=0), False, most_followed=20)
    np.testing.assert_array_equal(one.sums, two.sums)
    np.testing.assert_array_equal(all_of_them.weight, a_half.weight)


def test_a_hit_beside_a_new_one_does_not_fade() -> None:
    rows = rows_of([[3.0, 0.01, 0.0]], True)
    ends = np.concatenate([_fan(20), [[3.0, 0.19, 0.0]]])
    assert len(_see_through(rows, ends, True).weight) == 0


def test_rows_of_all_robots_fade_and_share_the_free_evidence() -> None:
    rows = rows_of([[3.0, 0.01, 0.01]], True, [10.0])
    both, _ = add(rows, np.array([[3.0, 0.01, 0.01]]), np.array([True]), np.full(1, 10.0), FINE_M, source=1)
    alone = _see_through(rows, _fan(24), False, rate=0.01)
    shared = _see_through(both, _fan(24), False, rate=0.01)
    np.testing.assert_allclose(both.sums[:, 3], 10.0 * np.exp(-0.01), rtol=1e-5)
    assert alone.weight.sum() < shared.weight.sum() < 2.0 * alone.weight.sum()


@pytest.mark.parametrize("threads", [2, 5])
def test_passes_are_counted_alike_on_any_number_of_threads(threads: int) -> None:
    rng = np.random.default_rng(0)
    points, ends = rng.uniform(-2, 2, (300, 3)), rng.normal(0, 8, (6000, 3))
    one, other = rows_of(points, True), rows_of(points, True)
    seen, same = _see_through(one, ends, False), _see_through(other, ends, False, threads=threads)
    assert len(seen.weight) > 100
    np.testing.assert_array_equal(seen.weight, same.weight)
    np.testing.assert_array_equal(seen.points, same.points)
    np.testing.assert_array_equal(one.sums, other.sums)


def test_nothing_to_see_through() -> None:
    assert len(_see_through(Rows.empty(), [[1.0, 0, 0]], True).weight) == 0
    assert len(_see_through(rows_of([[3.0, 0.01, 0.0]], True), np.zeros((0, 3)), True).weight) == 0
    assert len(_see_through(rows_of([[3.0, 0.01, 0.0]], True), [[0.0, 9.0, 0.0]], True).weight) == 0


def test_beams_are_relative_to_their_origin() -> None:
    origin = np.array([1.0, -2.0, 0.5])
    at_home, moved = (
        rows_of([[3.0, 0.01, 0.01]], True),
        rows_of(np.array([[3.0, 0.01, 0.01]]) + 2.0 * origin, True),
    )
    expected = _see_through(at_home, _fan(24), True)
    beams = Beams(_fan(24), np.ones(24, bool))
    seen = see_through(moved, beams, 2.0 * origin, fine_m=FINE_M, rate=0.1, gap_m=0.3)
    np.testing.assert_allclose(seen.points - 2.0 * origin, expected.points, atol=1e-5)
    np.testing.assert_allclose(seen.weight, expected.weight, rtol=1e-5)
