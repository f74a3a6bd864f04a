"""When hits that beams pass through are taken out."""

from __future__ import annotations

import math

import numpy as np
import pytest

from potserver.numerics.beams import Beams
from potserver.numerics.evidence import (
    FREE,
    HIT,
    MISSED,
    NEAR,
    PASSED,
    Rows,
    SeenThrough,
    add,
    is_alive,
    kind_of,
    leaving,
    positions,
    see_through,
)
from potserver.numerics.surface import Normals
from tests.numerics.evidence.samples import FINE_M, rows_of

PLACE = [[3.0, 0.01, 0.01]]


def _see_through(rows: Rows, ends, is_return, **changes) -> SeenThrough:
    ends = np.atleast_2d(np.asarray(ends, float))
    options = {"fine_m": FINE_M, "odds": 300.0} | changes
    beams = Beams(ends, np.broadcast_to(is_return, len(ends)).copy())
    faces = options.pop("faces", _faces(ends[beams.is_return]))
    return see_through(rows, beams, faces, np.zeros(3), **options)


def _faces(hits: np.ndarray, normal=(-1.0, 0.0, 0.0), sigma_m: float = 0.02) -> Normals:
    """The hits lie on planes of one direction; x of its normal is minus the cosine of incidence of beams along x."""
    n = len(hits)
    return Normals(np.tile(np.asarray(normal, float), (n, 1)), np.full(n, -normal[0]), np.full(n, sigma_m))


def _looks(rows: Rows, ends, is_return, n: int = 1, **changes) -> Rows:
    """The rows after some scans of the same beams."""
    for _ in range(n):
        seen = _see_through(rows, ends, is_return, **changes)
        rows, _ = add(rows, seen.points, seen.kind, seen.weight, FINE_M)
    return rows


def _fan(n: int, at_m: float = 10.0, width_m: float = 0.1) -> np.ndarray:
    """(N, 3) ends of beams close together along x."""
    return np.stack([np.full(n, at_m), np.linspace(0.02, width_m, n), np.full(n, 0.05)], axis=1)


def _weight(rows: Rows, kind: int) -> float:
    return float(rows.sums[rows.kind == kind, 3].sum())


def _scans_until_gone(hits: float, beams: int, most: int = 60) -> int:
    rows = rows_of(PLACE, True, [hits])
    for scan in range(1, most + 1):
        rows = _looks(rows, _fan(beams), False)
        if _weight(rows, HIT) == 0.0:
            return scan
    return most + 1


def test_what_has_left_is_taken_out_and_free_space_stands_in_its_place() -> None:
    rows = rows_of([*PLACE, [3.0, 1.5, 0.0], [9.9, 0.05, 0.05]], True, [40.0, 1.0, 1.0])
    before, where = rows.sums.copy(), positions(rows, FINE_M)
    seen = _see_through(rows, _fan(24), True)
    assert rows.sums[0, 3] == 0.0
    np.testing.assert_array_equal(rows.sums[1:], before[1:])  # beside the beams, and at their ends
    np.testing.assert_allclose(seen.points[seen.kind == FREE], where[:1], atol=1e-6)
    assert seen.weight[seen.kind == FREE][0] > 1.0


def test_finer_hits_leave_with_the_voxel_of_the_resolution_that_they_lie_in() -> None:
    kind = kind_of(HIT, np.array([2, 2, 1, 0], np.uint8))
    rows = rows_of(
        [[3.0, 0.01, 0.01], [3.09, 0.01, 0.01], [3.0, 0.09, 0.09], [3.05, 0.05, 0.05]], kind, [10.0] * 4
    )
    beside = rows_of([[3.0, 1.5, 0.0]], kind[:1])
    both = Rows.concatenate([rows, beside])
    seen = _see_through(both, _fan(24), True)
    assert (both.sums[: len(rows.kind), 3] == 0.0).all()
    assert both.sums[-1, 3] == 1.0
    assert (seen.kind == FREE).sum() == 1
    assert set(seen.kind.tolist()) <= {FREE, PASSED, MISSED}


def test_it_takes_longer_for_what_gave_few_echoes_and_for_few_beams() -> None:
    by_hits = [_scans_until_gone(hits, 24) for hits in (1.0, 4.0, 100.0)]
    by_beams = [_scans_until_gone(20.0, beams) for beams in (1, 3, 24)]
    assert by_hits[0] > by_hits[1] > by_hits[2] == 1
    assert by_beams[0] > by_beams[1] >= by_beams[2]
    assert by_beams[0] < 10, "one beam a scan is enough in the end"


@pytest.mark.parametrize(("hits", "passed", "missed"), [(10, 4, 7), (2, 0, 30), (50, 0, 1)])
def test_the_chance_of_missing_is_that_of_a_beta_distribution(hits: int, passed: int, missed: int) -> None:
    """The chances to miss multiply, each after those before; a last beam of one scan makes 3 (1 - exp(-1/3)) misses."""
    place, one = np.array(PLACE), np.ones(1)
    rows = rows_of(PLACE, True, [float(hits)])
    rows, _ = add(rows, place, np.array([PASSED]), passed * one, FINE_M)
    rows, _ = add(rows, place, np.array([MISSED]), missed * one, FINE_M)
    echo, none = hits + 0.5, passed + 0.5
    k = missed + 3.0 * (1.0 - math.exp(-1.0 / 3.0))
    log_chance = _log_beta(echo, none + k) - _log_beta(echo, none)
    whole = math.prod((none + i) / (echo + none + i) for i in range(missed))
    assert log_chance < math.log(whole)
    for odds, is_gone in ((0.99 * math.exp(-log_chance), True), (1.01 * math.exp(-log_chance), False)):
        copy = rows._replace(sums=rows.sums.copy())
        _see_through(copy, _fan(1), False, odds=odds)
        assert (_weight(copy, HIT) == 0.0) == is_gone


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


def test_a_fence_that_lets_most_beams_through_stays() -> None:
    rng = np.random.default_rng(0)
    rows = rows_of(PLACE, True, [1.0])
    echo = np.array([[3.0, 0.05, 0.05]])
    n_alive = 0
    for _ in range(200):  # three beams a scan; one in ten comes back
        n_back = rng.binomial(3, 0.1)
        ends = np.concatenate([_fan(3 - n_back), np.repeat(echo, n_back, axis=0)])
        rows = _looks(rows, ends, True)
        rows, _ = add(rows, np.repeat(echo, n_back, axis=0), np.ones(n_back, bool), np.ones(n_back), FINE_M)
        n_alive += _weight(rows, HIT) > 0.0
    assert n_alive > 190
    assert _weight(rows, PASSED) > 4.0 * _weight(rows, HIT)


def test_an_echo_turns_what_was_missed_into_what_passed() -> None:
    rows = _looks(rows_of(PLACE, True, [5.0]), _fan(1), False, 2)
    missed = _weight(rows, MISSED)
    assert missed > 1.0
    rows = _looks(rows, [[3.0, 0.05, 0.05]], True)
    assert _weight(rows, MISSED) == 0.0
    assert _weight(rows, PASSED) == pytest.approx(missed)


def test_beams_that_graze_a_surface_leave_it() -> None:
    """Each passes through many voxels of hits along its way, and all of these share it."""
    wall = np.stack([np.arange(2.0, 7.0, 0.1), np.full(50, 0.05), np.full(50, 0.05)], axis=1)
    rows = _looks(rows_of(wall, True), _fan(2), True)
    assert _weight(rows, HIT) == 50.0


def _passing(*aside_m: float) -> list[list[float]]:
    """Ends of beams that pass so far beside the place, 7 m farther."""
    return [[10.0, (0.01 + aside) * 10.0 / 3.0, 0.1 / 3.0] for aside in aside_m]


@pytest.mark.parametrize("passed", [0.0, 4.0])
def test_space_is_free_where_beams_pass_close_beside_hits(passed: float) -> None:
    """One beam echoes there, two pass: a thing that lets every second beam through gets half the weight beside it."""
    place = np.array(PLACE)
    rows = rows_of(place, kind_of(HIT, np.array([1], np.uint8)), [4.0])
    rows, _ = add(rows, place, np.array([PASSED]), np.array([passed]), FINE_M)
    ends = [*PLACE, *_passing(0.08, 0.12)]
    seen = _see_through(rows, ends, [True, False, False], beside_weight=0.5)
    is_near = seen.kind == kind_of(NEAR, np.array([1], np.uint8))
    np.testing.assert_allclose(seen.weight[is_near], 0.5 * 4.0 / (4.0 + passed) / 2.0, rtol=1e-6)
    apart = np.linalg.norm(seen.points[is_near] - place, axis=1)
    np.testing.assert_allclose(apart, [0.08, 0.12], atol=2e-3)
    assert np.abs(np.cross(seen.points[is_near], ends[1:])).max() < 0.01, "on their beams"


@pytest.mark.parametrize(("aside_m", "echoes"), [(0.04, True), (0.1, False)])
def test_beams_that_may_graze_and_hits_without_an_echo_say_nothing_of_edges(
    aside_m: float, echoes: bool
) -> None:
    ends = [*(PLACE if echoes else []), *_passing(aside_m)]
    seen = _see_through(rows_of(PLACE, True, [4.0]), ends, [True] * echoes + [False], beside_weight=0.5)
    assert len(seen.kind) == 1
    assert seen.kind[0] == (PASSED if echoes else MISSED)


def test_beams_left_out_are_stood_for(monkeypatch: pytest.MonkeyPatch) -> None:
    one, two = rows_of(PLACE, True), rows_of(PLACE, True)
    ends = _fan(1)
    all_of_them = _see_through(one, np.repeat(ends, 40, axis=0), False)
    monkeypatch.setattr(leaving, "_MOST_FOLLOWED", 20)
    a_half = _see_through(two, np.repeat(ends, 40, axis=0), False)
    np.testing.assert_array_equal(one.sums, two.sums)
    np.testing.assert_array_equal(all_of_them.weight, a_half.weight)


def test_a_hit_beside_a_new_one_stays() -> None:
    rows = rows_of([[3.0, 0.01, 0.0]], True, [50.0])
    _see_through(rows, np.concatenate([_fan(20), [[3.0, 0.14, 0.0]]]), True)
    assert is_alive(rows).all()


def test_a_face_close_behind_does_not_say_that_what_stood_before_it_is_there() -> None:
    """The hits lie in voxels that touch: the new ones are .17 m farther on, across their own face."""
    rows = rows_of([[3.0, 0.01, 0.01]], True, [50.0])
    _see_through(rows, _fan(20, at_m=3.17), True)
    assert not is_alive(rows).any()
    noisy = rows_of([[3.0, 0.01, 0.01]], True, [50.0])
    ends = _fan(20, at_m=3.17)
    _see_through(noisy, ends, True, faces=_faces(ends, sigma_m=0.05))
    assert is_alive(noisy).all(), "within twice the noise of the face"


def test_what_lies_on_the_face_that_beams_graze_is_not_passed() -> None:
    """.3 m before their ends along the beams, 3 cm across the face. Of a face seen head-on that would be far."""
    tilted, ends = (-0.1, 0.0, math.sqrt(0.99)), _fan(20, at_m=3.5)
    grazed, seen_through = rows_of([[3.2, 0.01, 0.01]], True), rows_of([[3.2, 0.01, 0.01]], True)
    assert len(_see_through(grazed, ends, True, faces=_faces(ends, tilted)).weight) == 0
    assert len(_see_through(seen_through, ends, True).weight) > 0


def test_what_touches_leaves_as_a_whole() -> None:
    """Beams pass the middle only. What has few hits beside it goes along, though none passed it; no beam says it is free."""
    middle, edge, far = [3.0, 0.01, 0.01], [3.0, 0.01, 0.25], [3.0, 0.01, 0.65]
    rows = rows_of([middle, edge, far], True, [40.0, 2.0, 40.0])
    seen = _see_through(rows, _fan(24), False)
    assert rows.sums[:, 3].tolist() == [0.0, 0.0, 40.0]
    np.testing.assert_allclose(seen.points[seen.kind == FREE], [middle], atol=1e-6)


def test_what_an_echo_confirms_keeps_what_touches_it() -> None:
    """Before a wall a thing with many hits leaves; the wall behind it stays, where rings meet it and between them."""
    thing, wall = [3.0, 0.01, 0.01], [[3.1, 0.01, 0.01], [3.1, 0.01, 0.11], [3.1, 0.01, -0.09]]
    rows = rows_of([thing, *wall], True, [60.0, 20.0, 20.0, 20.0])
    ends = np.concatenate([_fan(24), np.array([[3.1, 0.01, 0.01]])])
    _see_through(rows, ends, True)
    assert (rows.sums[1:, 3] > 0.0).all()


def test_what_stands_just_before_a_wall_can_leave_too() -> None:
    rows = rows_of([[3.0, 0.01, 0.01], [3.1, 0.01, 0.01]], True, [50.0, 50.0])
    _see_through(rows, _fan(20, at_m=3.42), True)
    assert not is_alive(rows).all()


def test_rows_of_all_robots_are_taken_out() -> None:
    rows = rows_of(PLACE, True, [40.0])
    both, _ = add(rows, np.array(PLACE), np.array([True]), np.full(1, 40.0), FINE_M, source=1)
    seen = _see_through(both, _fan(24), False)
    assert (both.sums == 0.0).all()
    assert (seen.kind == FREE).sum() == 1


@pytest.mark.parametrize("threads", [2, 5])
def test_passes_are_counted_alike_on_any_number_of_threads(threads: int) -> None:
    rng = np.random.default_rng(0)
    points, ends = rng.uniform(-2, 2, (300, 3)), rng.normal(0, 8, (6000, 3))
    one, other = rows_of(points, True), rows_of(points, True)
    seen, same = _see_through(one, ends, False), _see_through(other, ends, False, threads=threads)
    assert len(seen.weight) > 100
    for ours, theirs in zip(seen, same, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(one.sums, other.sums)


def test_nothing_to_see_through() -> None:
    assert len(_see_through(Rows.empty(), [[1.0, 0, 0]], True).weight) == 0
    assert len(_see_through(rows_of([[3.0, 0.01, 0.0]], True), np.zeros((0, 3)), True).weight) == 0
    assert len(_see_through(rows_of([[3.0, 0.01, 0.0]], True), [[0.0, 9.0, 0.0]], True).weight) == 0


def test_beams_are_relative_to_their_origin() -> None:
    origin = np.array([1.0, -2.0, 0.5])
    at_home, moved = (
        rows_of(PLACE, True, [40.0]),
        rows_of(np.array(PLACE) + 2.0 * origin, True, [40.0]),
    )
    expected = _see_through(at_home, _fan(24), True)
    beams = Beams(_fan(24), np.ones(24, bool))
    seen = see_through(moved, beams, _faces(beams.ends), 2.0 * origin, fine_m=FINE_M, odds=300.0)
    np.testing.assert_allclose(seen.points - 2.0 * origin, expected.points, atol=1e-5)
    np.testing.assert_array_equal(seen.kind, expected.kind)
    np.testing.assert_allclose(seen.weight, expected.weight, rtol=1e-5)
