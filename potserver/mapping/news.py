"""News: where a scan changed the evidence so much that the map is solved there again.

Looks that repeat what is known hardly move the optimum. So a solve waits until the evidence of a tile has grown by a share of
itself since the last one, and comes ever more rarely where a robot stands. Things that appear or leave do not wait: where hits
are new or gone, a few looks are enough. What waits is counted in blocks of two coarse cells, as wide as kernels reach.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.domain.tiles import MapKernels, Region
from potserver.numerics import evidence
from potserver.numerics.arrays import Bool, Float32, Float64, Int64

_GROWN = 0.1  # of the log of 1 + a row's looks, on average over a tile
_NEW_KERNEL = 100.0  # of that growth: so much a kernel tells that was never solved
_GONE = 5.0  # looks that a row of hits which has left is worth
# Looks of hits of a block that are new or gone: so many, and so many for each row of hits there.
_NEW_HITS, _SHARE_NEW = 4.0, 0.1


class Due(NamedTuple):
    """Blocks of a region that are solved now."""

    flags: Bool  # (X, Y, Z)
    edge_m: float  # of a block

    def around(self, points: Float64, reach: int) -> Bool:
        """(N,) which of (N, 3) points, m, in the region's frame, lie at most `reach` blocks from one that is due."""
        flags = self.flags.copy()
        for _ in range(reach):
            _grow(flags)
        return np.asarray(_flags_at(np.ascontiguousarray(points), self.edge_m, flags), np.bool_)


def due(
    region: Region, where: Float64, counts: Float32, added: MapKernels, saturation: float, *, all_of_it: bool
) -> Due:
    """Add what a scan brought to a region's news, and take from it what is solved now.

    Args:
        region: With the scan's evidence and kernels; its news change in place.
        where: (R, 3) m, where its rows stand.
        counts: (R,) what they count.
        added: The kernels that the scan brought.
        saturation: As for `evidence.counts`.
        all_of_it: Solve it whatever is new.
    """
    assert region.cells is not None, "evidence was added"
    sums = region.rows.sums.copy()
    sums[:, 3] -= np.maximum(region.gained, 0.0)
    before = evidence.counts(region.rows._replace(sums=sums), region.cells, saturation)
    edge_m = region.grid.block_m
    rows, hits = _count(where, region.rows.sort, before, counts, edge_m, region.news)
    np.add.at(region.news[0], tuple(_block_of(added.kernels.hinge_mean, edge_m, rows)), _NEW_KERNEL)
    n = region.grid.blocks
    by_tile = (region.news[0], rows)
    grown, of = (a.reshape(len(a) // n, n, -1, n, a.shape[2] // n, n).sum(axis=(1, 3, 5)) for a in by_tile)
    flags = (grown > _GROWN * of).repeat(n, 0).repeat(n, 1).repeat(n, 2)
    flags |= region.news[1] > _NEW_HITS + _SHARE_NEW * hits
    flags |= all_of_it
    region.news[:, flags] = 0.0
    return Due(flags, edge_m)


def _block_of(points: Float64, edge_m: float, blocks: Float32) -> Int64:
    """(3, N) numbers of blocks; rounding may put a kernel of the outermost ones just outside."""
    last = np.array(blocks.shape) - 1
    return np.clip(np.floor(points / edge_m).astype(np.int64), 0, last).T


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _count(where, sort, before, after, edge, news):
    """Bring the news of blocks up to date by what rows changed, in place; (2, X, Y, Z) rows that count, and hits among them."""
    out = np.zeros((2, *news.shape[1:]), np.float32)
    rows, hits = out
    for r in range(len(sort)):
        x, y, z = np.int64(where[r, 0] / edge), np.int64(where[r, 1] / edge), np.int64(where[r, 2] / edge)
        is_hit = sort[r] == evidence.HIT
        if after[r] > 0.0:
            rows[x, y, z] += 1.0
            ratio = (np.float32(1) + after[r]) / (np.float32(1) + max(before[r], np.float32(0)))
            news[0, x, y, z] += abs(np.log(ratio))
            hits[x, y, z] += is_hit
        if is_hit and (after[r] <= 0.0 or before[r] <= 1e-3):
            news[1, x, y, z] += after[r] if after[r] > 0.0 else _GONE
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _flags_at(points, edge, flags):
    out = np.empty(len(points), np.bool_)
    for i in range(len(points)):
        x = min(max(np.int64(points[i, 0] / edge), 0), flags.shape[0] - 1)
        y = min(max(np.int64(points[i, 1] / edge), 0), flags.shape[1] - 1)
        z = min(max(np.int64(points[i, 2] / edge), 0), flags.shape[2] - 1)
        out[i] = flags[x, y, z]
    return out


def _grow(flags: Bool) -> None:
    """Flag the 26 blocks around each flagged one too, in place."""
    for axis in range(3):
        along = np.moveaxis(flags, axis, 0)
        was = along.copy()
        along[1:] |= was[:-1]
        along[:-1] |= was[1:]
