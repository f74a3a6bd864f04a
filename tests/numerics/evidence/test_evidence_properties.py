"""Evidence against a dictionary of voxels: whatever is added or taken off, rows are the weighted means of their samples."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from potserver.numerics.evidence import Rows, add, add_sparing, positions

FINE_M = 0.4


def _samples(seed: int, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-2.0, 3.0, (n, 3)), rng.random(n) < 0.4, rng.choice([1.0, 1 / 3, 0.25], n)


def _reference(points, occupied, weight) -> dict[tuple, np.ndarray]:
    """Voxel and label -> (sum w x, sum w y, sum w z, sum w), float64."""
    sums: dict[tuple, np.ndarray] = {}
    for p, y, w in zip(points, occupied, weight, strict=True):
        edge = FINE_M / 2 if y else FINE_M
        key = (bool(y), *np.floor(p / edge).astype(int).tolist())
        sums[key] = sums.get(key, np.zeros(4)) + w * np.append(p, 1.0)
    return sums


def _as_dict(rows: Rows) -> dict[tuple, np.ndarray]:
    where = positions(rows, FINE_M)
    return {
        (bool(y), *voxel.tolist()): np.append(w * p, w)
        for y, voxel, p, w in zip(
            rows.occupied, rows.voxel, where, rows.sums[:, 3].astype(float), strict=True
        )
    }


def _check_same(one: dict[tuple, np.ndarray], other: dict[tuple, np.ndarray]) -> None:
    assert one.keys() == other.keys()
    for key, sums in one.items():
        np.testing.assert_allclose(sums, other[key], atol=1e-4)


@given(seed=st.integers(0, 2**31), n=st.integers(0, 300), parts=st.integers(1, 4))
def test_rows_are_what_a_dictionary_would_hold(seed: int, n: int, parts: int) -> None:
    points, occupied, weight = _samples(seed, n)
    rows, gained = Rows.empty(), np.zeros(0, np.float32)
    for part in np.array_split(np.arange(n), parts):
        before = rows
        rows, gained = add(rows, points[part], occupied[part], weight[part], FINE_M)
        np.testing.assert_array_equal(rows.voxel[: len(before.occupied)], before.voxel)
        assert gained.sum() == np.float32(weight[part].sum()) or abs(gained.sum() - weight[part].sum()) < 1e-3
    _check_same(_as_dict(rows), _reference(points, occupied, weight))


@given(seed=st.integers(0, 2**31), n=st.integers(1, 200), m=st.integers(1, 200))
def test_what_was_added_can_be_taken_off_again(seed: int, n: int, m: int) -> None:
    mine, theirs = _samples(seed, n), _samples(seed + 1, m)
    alone, _ = add(Rows.empty(), *mine, FINE_M)
    both, _ = add(alone, *theirs, FINE_M)
    undone, gained = add(both, theirs[0], theirs[1], -theirs[2], FINE_M)
    assert gained.sum() <= 0
    left = undone.take(undone.sums[:, 3] > 1e-3)
    _check_same(_as_dict(left), _as_dict(alone))


@given(seed=st.integers(0, 2**31), n=st.integers(1, 200), m=st.integers(1, 200))
def test_rows_of_another_map_merge_as_weighted_points(seed: int, n: int, m: int) -> None:
    mine, theirs = _samples(seed, n), _samples(seed + 1, m)
    alone, _ = add(Rows.empty(), *mine, FINE_M)
    other, _ = add(Rows.empty(), *theirs, FINE_M)
    merged, _ = add(alone, positions(other, FINE_M), other.occupied, other.sums[:, 3], FINE_M)
    truth = _as_dict(alone)
    for key, sums in _as_dict(other).items():
        truth[key] = truth.get(key, np.zeros(4)) + sums
    _check_same(_as_dict(merged), truth)


@given(seed=st.integers(0, 2**31), n=st.integers(1, 300), m=st.integers(1, 300), turn=st.integers(-1, 5))
def test_joining_keeps_weights_means_and_what_tells_of_change(seed: int, n: int, m: int, turn: int) -> None:
    points, occupied, weight = _samples(seed, n)
    weight[::2] *= 40.0  # beside these, others are negligible
    before, _ = add(Rows.empty(), points, occupied, weight, FINE_M)
    added = add(before, *_samples(seed + 1, m), FINE_M)
    within = (np.full(3, -9.0), np.full(3, 9.0)) if turn >= 0 else None
    joined = add_sparing(before, *_samples(seed + 1, m), FINE_M, within=within, turn=turn)
    rows, n_old = joined.rows, joined.n_old
    old = {(bool(o), *v) for o, v in zip(before.occupied, before.voxel.tolist(), strict=True)}
    kept = {(bool(o), *v) for o, v in zip(rows.occupied[:n_old], rows.voxel[:n_old].tolist(), strict=True)}
    assert len(kept) == n_old
    assert kept == old if within is None else kept <= old
    np.testing.assert_allclose(joined.weight.sum(), added.weight.sum(), rtol=1e-4)
    for label in (False, True):
        moments = []
        for some in (rows, added.rows):
            mine = some.take(some.occupied == label)
            edge = FINE_M / 2 if label else FINE_M
            centre = (mine.voxel + 0.5) * edge
            moments.append((mine.sums[:, :3] + mine.sums[:, 3:] * centre).sum(axis=0).tolist())
            moments[-1].append(mine.sums[:, 3].sum())
        np.testing.assert_allclose(moments[0], moments[1], rtol=1e-5, atol=1e-3)
    hit_voxels = {tuple(v) for v in (added.rows.voxel[added.rows.occupied] >> 1).tolist()}
    assert _free_among(rows, hit_voxels) == _free_among(added.rows, hit_voxels)


def _free_among(rows: Rows, hit_voxels: set[tuple]) -> set[tuple]:
    """Voxels with free rows that have hits too."""
    return hit_voxels & {tuple(v) for v in rows.voxel[~rows.occupied].tolist()}


@given(seed=st.integers(0, 2**31), scans=st.integers(1, 30))
def test_clear_space_that_is_covered_gets_no_more_rows(seed: int, scans: int) -> None:
    """A row in every third voxel along each axis is beside all others: however long one looks, there are no more."""
    rng = np.random.default_rng(seed)
    every_third = np.stack(np.meshgrid(*[[1, 4, 7]] * 3), axis=-1).reshape(-1, 3)
    n = len(every_third)
    rows, _ = add(Rows.empty(), (every_third + 0.5) * FINE_M, np.zeros(n, bool), np.full(n, 2.0), FINE_M)
    for _ in range(scans):
        points = rng.uniform(0, 9 * FINE_M, (3, 3))
        rows = add_sparing(rows, points, np.zeros(3, bool), np.full(3, 1 / 3), FINE_M).rows
        assert len(rows.occupied) == n
    np.testing.assert_allclose(rows.sums[:, 3].sum(), 2.0 * n + scans, rtol=1e-4)
