"""The hash of voxels against a dictionary."""

from __future__ import annotations

import numpy as np
import pytest

from potserver.numerics.voxel_hash import any_around, empty_table, enter, find, pack


def test_every_voxel_gets_one_number() -> None:
    cells = np.random.default_rng(0).integers(-5, 6, (400, 3))
    table, keys, known = empty_table(len(cells)), np.empty(len(cells), np.int64), {}
    for x, y, z in cells.tolist():
        number = enter(table, keys, len(known), pack(2, x, y, z))
        assert number == known.setdefault((x, y, z), len(known))
        assert table[find(table, keys, pack(3, x, y, z))] < 0, "of another kind"


@pytest.mark.parametrize("reach", [0, 1, 3])
def test_voxels_are_found_around_a_voxel(reach: int) -> None:
    table, keys = empty_table(1), np.empty(1, np.int64)
    enter(table, keys, 0, pack(1, 4, -2, 7))
    for away in range(5):
        for axis in range(3):
            voxel = np.array([4, -2, 7])
            voxel[axis] += away
            assert any_around(table, keys, 1, voxel, reach) == (away <= reach)
            assert not any_around(table, keys, 0, voxel, reach), "of another kind"
