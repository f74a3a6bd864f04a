"""Lattice nodes against a plain search over all cells."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from potserver.numerics.lattice_nodes import new_nodes


def _search(points: np.ndarray, spacing: float, within: float, planar: bool) -> set[tuple[int, ...]]:
    steps = (-1, 0, 1) if within else (0,)
    wanted = set()
    for p in points:
        cell = np.floor(p / spacing).astype(int)
        for d in itertools.product(steps, steps, (0,) if planar else steps):
            off = (cell + d + 0.5) * spacing - p
            if planar:
                off[2] = 0.0
            if d == (0, 0, 0) or np.linalg.norm(off) < within * spacing:
                wanted.add(tuple(cell + d))
    return wanted


@pytest.mark.parametrize("within", [0.0, 1.0])
@pytest.mark.parametrize("planar", [False, True])
def test_the_nodes_that_points_ask_for(within: float, planar: bool) -> None:
    points = np.random.default_rng(0).uniform(-4, 4, (60, 3))
    if planar:
        points[:, 2] = 1.3
    nodes = new_nodes(points, np.zeros((0, 3)), 0.7, within=within, planar=planar)
    cells = [tuple(c) for c in np.floor(nodes / 0.7).astype(int)]
    assert len(set(cells)) == len(cells)
    assert set(cells) == _search(points, 0.7, within, planar)
    middle = (np.array(cells) + 0.5) * 0.7
    if planar:
        middle[:, 2] = 1.3
    np.testing.assert_allclose(nodes, middle, atol=1e-12)


def test_nodes_that_are_there_are_not_asked_for_again() -> None:
    points = np.random.default_rng(0).uniform(-4, 4, (60, 3))
    first = new_nodes(points[:30], np.zeros((0, 3)), 0.7, within=1.0, planar=False)
    more = new_nodes(points, first, 0.7, within=1.0, planar=False)
    at_once = new_nodes(points, np.zeros((0, 3)), 0.7, within=1.0, planar=False)
    both = np.concatenate([first, more])
    np.testing.assert_allclose(both[np.lexsort(both.T)], at_once[np.lexsort(at_once.T)])
    assert len(new_nodes(points, both, 0.7, within=1.0, planar=False)) == 0


def test_more_nodes_than_the_first_table_holds() -> None:
    points = np.arange(300)[:, None] * np.array([7.0, 0.0, 0.0]) + 0.35
    assert len(new_nodes(points, np.zeros((0, 3)), 0.7, within=1.6, planar=False)) == 27 * 300 - 8 * 300


def test_no_points_ask_for_nothing() -> None:
    assert new_nodes(np.zeros((0, 3)), np.zeros((0, 3)), 1.0, within=1.0, planar=False).shape == (0, 3)
