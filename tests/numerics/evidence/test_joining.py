"""Which light rows of evidence join others."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.evidence import TURNS, Rows, add, add_sparing, positions
from tests.numerics.evidence.samples import FINE_M, rows_of


def _joined(rows: Rows, point, occupied: bool, weight: float = 1 / 3, source: int = 0) -> Rows:
    """The rows after one more sample, let join what is there."""
    joined = add_sparing(rows, np.array([point]), np.array([occupied]), np.array([weight]), FINE_M, source)
    assert joined.n_old == len(rows.occupied)
    assert joined.weight.sum() == pytest.approx(weight)
    assert joined.rows.sums[:, 3].sum() == pytest.approx(rows.sums[:, 3].sum() + weight)
    np.testing.assert_array_equal(joined.rows.voxel[: len(rows.occupied)], rows.voxel)
    return joined.rows


def test_in_clear_space_a_light_row_joins_the_nearest_beside_it() -> None:
    rows = rows_of([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], False)
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
    rows = rows_of([[0.1, 0.1, 0.1]], False, np.array([2.0 if weight > 1 else 0.3]))
    assert len(_joined(rows, point, False, weight).occupied) == 2


@pytest.mark.parametrize(("heavier", "n_rows"), [(0.99, 2), (1.0, 1), (1.01, 1)])
def test_in_clear_space_the_row_that_is_joined_must_not_be_the_lighter_one(
    heavier: float, n_rows: int
) -> None:
    rows = rows_of([[0.1, 0.1, 0.1]], False, np.array([heavier * 0.5]))
    assert len(_joined(rows, [0.5, 0.1, 0.1], False, weight=0.5).occupied) == n_rows


@pytest.mark.parametrize(("times", "n_rows"), [(20.0, 3), (30.0, 2)])
def test_beside_hits_a_free_row_joins_only_what_outweighs_it_far(times: float, n_rows: int) -> None:
    rows = rows_of([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1]], [False, True], np.array([times / 3, 1.0]))
    joined = _joined(rows, [0.5, 0.1, 0.1], False)
    assert len(joined.occupied) == n_rows
    np.testing.assert_array_equal(joined.sums[1], rows.sums[1])  # the hit is as it was


def test_a_free_row_among_hits_stays_whatever_is_beside_it() -> None:
    rows = rows_of([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]], [False, True], np.array([100.0, 1.0]))
    joined = _joined(rows, [0.7, 0.1, 0.1], False)
    assert len(joined.occupied) == 3
    np.testing.assert_array_equal(joined.sums[:2], rows.sums)


@pytest.mark.parametrize(("times", "n_rows"), [(20.0, 2), (30.0, 1)])
def test_a_hit_joins_only_what_outweighs_it_far(times: float, n_rows: int) -> None:
    rows = rows_of([[0.1, 0.1, 0.1]], True, np.array([times / 3]))
    assert len(_joined(rows, [0.21, 0.1, 0.1], True).occupied) == n_rows


@pytest.mark.parametrize(("times", "hit_x", "n_rows"), [(4.0, 9.0, 2), (2.0, 9.0, 3), (4.0, 2.1, 3)])
def test_far_from_hits_a_row_two_voxels_away_will_do(times: float, hit_x: float, n_rows: int) -> None:
    rows = rows_of([[0.1, 0.1, 0.1], [hit_x, 0.1, 0.1]], [False, True], np.array([times / 3, 1.0]))
    assert len(_joined(rows, [0.9, 0.1, 0.1], False).occupied) == n_rows


def test_rows_of_other_sources_are_not_joined_and_their_hits_count() -> None:
    rows = rows_of([[0.1, 0.1, 0.1]], False)
    other = _joined(rows, [0.5, 0.1, 0.1], False, source=1)
    np.testing.assert_array_equal(other.source, [0, 1])
    hit = add(rows, np.array([[0.9, 0.1, 0.1]]), np.array([True]), np.ones(1), FINE_M, 1).rows
    assert len(_joined(hit, [0.5, 0.1, 0.1], False).occupied) == 3


_BOX = np.full(3, -4.0), np.full(3, 4.0)


def _after_all_turns(rows: Rows, within=_BOX, source: int = 0) -> Rows:
    """The rows after every old one has been looked at once, without anything new."""
    none = np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0)
    for turn in range(TURNS):
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
    rows = rows_of([[0.1, 0.1, 0.1], [x, 0.1, 0.1]], occupied, np.array([times * weight, weight]))
    left = _after_all_turns(rows)
    assert len(left.occupied) == n_rows
    if n_rows == 1:
        edge = FINE_M / 2 if occupied else FINE_M
        mean_x = (times * 0.1 + x) / (times + 1)
        assert positions(left, FINE_M)[0, 0] == pytest.approx(min(mean_x, edge), abs=1e-5)


def test_an_old_light_row_stays_among_hits_outside_the_box_or_anothers() -> None:
    among_hits = rows_of(
        [[0.1, 0.1, 0.1], [0.5, 0.1, 0.1], [0.7, 0.1, 0.1]], [False, False, True], [100.0, 1, 1]
    )
    assert len(_after_all_turns(among_hits).occupied) == 3
    rows = rows_of([[0.1, 0.1, 0.1], [0.5, 0.1, 0.1]], False, np.array([100.0, 1.0]))
    assert len(_after_all_turns(rows).occupied) == 1
    assert len(_after_all_turns(rows, None).occupied) == 2
    assert len(_after_all_turns(rows, (np.full(3, -4.0), np.full(3, 0.79))).occupied) == 2
    assert len(_after_all_turns(rows, source=1).occupied) == 2


@pytest.mark.parametrize("robots", [1, 2, 3, 4])
def test_robots_that_take_turns_get_to_all_their_oldrows_of(robots: int) -> None:
    light = np.stack(np.meshgrid(*[np.arange(-6, 6, 2) + 0.5] * 3), axis=-1).reshape(-1, 3) * FINE_M
    heavy = light + np.array([FINE_M, 0, 0])
    rows = rows_of(np.concatenate([light, heavy]), False, np.repeat([1.0, 50.0], len(light)))
    none = np.zeros((0, 3)), np.zeros(0, bool), np.zeros(0)
    for turn in range(0, 3 * robots * TURNS, robots):
        before = len(rows.occupied)
        rows, _, n_old, _ = add_sparing(
            rows, *none, FINE_M, within=(np.full(3, -9.0), np.full(3, 9.0)), turn=turn
        )
        assert before - n_old < 0.5 * len(light)
    assert len(rows.occupied) == len(heavy)
