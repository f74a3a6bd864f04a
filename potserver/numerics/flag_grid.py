"""A grid of flags: which blocks of cells hold anything. Most hold nothing, and a flag is looked up faster than a hash."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Int32
from potserver.numerics.geometry import bounds

_MOST_FLAGS = 2**22


class FlagGrid(NamedTuple):
    """Blocks of cells in a box; beyond the box nothing is flagged."""

    corner: Int32  # (3,) the lowest cell
    shift: int  # a block has 2^shift cells along an edge
    flags: Bool  # (X, Y, Z) which blocks hold something

    @staticmethod
    def of(cells: Int32, shift: int = 0) -> FlagGrid:
        """Flag the blocks of (V, 3) cells. Blocks are larger where flags in the box would be more than four million.

        Args:
            cells: Numbers along the axes.
            shift: The least: blocks have at least 2^shift cells along an edge.
        """
        if len(cells) == 0:
            return FlagGrid(np.zeros(3, np.int32), shift, np.zeros((0, 0, 0), np.bool_))
        corner, last = bounds(cells)
        while np.prod(((last - corner) >> shift).astype(np.float64) + 1.0) > _MOST_FLAGS:
            shift += 1
        flags = np.zeros(((last - corner) >> shift) + 1, np.bool_)
        _flag(cells, corner, shift, flags)
        return FlagGrid(corner, shift, flags)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _flag(cells, corner, shift, flags):
    for i in range(len(cells)):
        flags[
            (cells[i, 0] - corner[0]) >> shift,
            (cells[i, 1] - corner[1]) >> shift,
            (cells[i, 2] - corner[2]) >> shift,
        ] = True


@nb.njit(nogil=True, error_model="numpy", cache=True)
def may_be_around(grid, cell, reach):
    """Whether a block with a cell at most `reach` cells from a (3,) one along each axis is flagged; exact if `shift` is 0."""
    corner, shift, flags = grid
    lower = np.empty(3, np.int64)
    upper = np.empty(3, np.int64)
    for c in range(3):
        at = np.int64(cell[c]) - corner[c]
        lower[c] = max((at - reach) >> shift, 0)
        upper[c] = min((at + reach) >> shift, flags.shape[c] - 1)
    for x in range(lower[0], upper[0] + 1):
        for y in range(lower[1], upper[1] + 1):
            for z in range(lower[2], upper[2] + 1):
                if flags[x, y, z]:
                    return True
    return False
