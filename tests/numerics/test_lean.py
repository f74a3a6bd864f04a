"""The lean, compiled: what `potschemas.lean` says, at any point, whatever the tiles are."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from potschemas.lean import LEAN_UNIT, MAX_LEAN, LeanTiles, lean_at, to_bytes
from potserver.errors import ShapeError
from potserver.numerics.lean import Lean

RNG = np.random.default_rng(0)
SHAPE = (5, 4, 41)
TILES = {
    index: RNG.integers(0, 256, SHAPE).astype(np.uint8)
    for index in [(0, 0, 0), (-1, 2, 0), (10**6, -(10**6), 3)]
}
POINTS = np.concatenate(
    [RNG.uniform(-12, 32, (3000, 3)), np.array([1e7, -1e7, 30.0]) + RNG.uniform(0, 10, (500, 3))]
)


def test_compiled_and_shared_rule_are_one() -> None:
    told = lean_at(POINTS, LeanTiles(10.0, TILES)).log_odds
    got = Lean(10.0, TILES).at(POINTS)
    np.testing.assert_array_equal(np.isnan(told), np.isnan(got))
    np.testing.assert_allclose(got, told, atol=1e-6)
    assert 500 < np.isfinite(got).sum() < len(got)


def test_a_node_says_its_byte() -> None:
    nodes = TILES[0, 0, 0]
    index = RNG.integers(0, np.array(SHAPE) - 1, (50, 3))
    at = index * (10.0 / (np.array(SHAPE) - 1))
    np.testing.assert_allclose(
        Lean(10.0, TILES).at(at), (nodes[tuple(index.T)].astype(float) - 128) * LEAN_UNIT, atol=1e-5
    )
    values = np.array([-99.0, -3.1, 0.0, 2.0, 99.0])
    told = to_bytes(values)
    np.testing.assert_allclose(
        (told - 128.0) * LEAN_UNIT, np.clip(values, -MAX_LEAN, MAX_LEAN), atol=LEAN_UNIT / 2
    )


def test_gradients_are_central_differences() -> None:
    points = RNG.uniform(0.2, 9.8, (400, 3))
    cell = points / (10.0 / (np.array(SHAPE) - 1))
    smooth = (np.abs(cell - np.rint(cell)) > 1e-3).all(axis=1)
    told = lean_at(points, LeanTiles(10.0, TILES))
    for axis in range(3):
        step = 1e-3 * np.eye(3)[axis]
        ahead, behind = (lean_at(points + s, LeanTiles(10.0, TILES)).log_odds for s in (step, -step))
        near = smooth & (np.abs(cell - np.rint(cell))[:, axis] > 0.01)
        difference = (ahead.astype(float) - behind) / 2e-3
        np.testing.assert_allclose(told.gradient[near, axis], difference[near], rtol=0.02, atol=0.05)


def test_a_change_leaves_the_former_as_it_was() -> None:
    before = Lean(10.0, TILES)
    after = before.with_tiles({(0, 0, 0): None, (5, 5, 5): TILES[0, 0, 0]})
    middle = np.array([[5.0, 5.0, 5.0], [55.0, 55.0, 55.0]])
    assert np.isnan(before.at(middle)).tolist() == [False, True]
    assert np.isnan(after.at(middle)).tolist() == [True, False]
    assert before.with_tiles({(0, 0, 0): TILES[0, 0, 0], (9, 9, 9): None}) is before
    assert np.isnan(Lean(10.0, {}).at(middle)).all()


def test_what_compiled_code_could_not_read_is_refused() -> None:
    with pytest.raises(ShapeError, match="several shapes"):
        Lean(10.0, TILES | {(7, 7, 7): np.zeros((2, 2, 2), np.uint8)})
    with pytest.raises(TypeError, match="addresses"):
        pickle.dumps(Lean(10.0, TILES))
