"""Adding samples sparingly: light rows join heavier ones beside them, so that a map gets few rows in clear space."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float32, Float64, UInt8
from potserver.numerics.evidence.rows import (
    FREE,
    HIT,
    KIND_MASK,
    SCALE_SHIFT,
    Cells,
    Rows,
    fill,
    halvings,
)
from potserver.numerics.flag_grid import FlagGrid, may_be_around
from potserver.numerics.voxel_hash import find, pack

TURNS = 3  # scans in which each old row is looked at once: a third of the old rows a scan keeps the cost low
_LIGHT = 1.01  # looks: the most weight of a new row that may join another; its parts add up with rounding
_STILL_LIGHT = 3.0  # looks: the same for an old row
# How much heavier, as a factor, the row must be that another joins.
_BESIDE_IN_THE_CLEAR = 1.0  # a new free row, no hits in the voxels around
_AWAY_IN_THE_CLEAR = 3.0  # the same, two voxels away
_OLD_FREE = 10.0  # an old free row: much heavier neighbours show that it is noise
_BESIDE_HITS = 25.0  # a new free row beside hits, and every row of hits: surfaces need their detail
_CLEAR = 1  # voxels of the resolution around a free row without hits, for it to join a row beside it
_WIDE_CLEAR = 3  # the same, to join a row two voxels away


class Joined(NamedTuple):
    """Rows after samples were added and light rows joined others."""

    rows: Rows  # those that are left of the old ones first, in their order
    weight: Float32  # (R,) what each row gained by the samples, with what joined it
    n_old: int
    cells: Cells  # of the rows


def add_sparing(
    rows: Rows,
    points: Float64,
    kind: UInt8 | Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int = 0,
    *,
    within: tuple[Float64, Float64] | None = None,
    turn: int = 0,
) -> Joined:
    """Add samples as `add` does, then let light rows join heavier ones of their kind and source.

    A row that joins another gives it its weight. The other moves to the mean of all samples, but stays in its own voxel. The
    nearest row that is heavy enough is joined.

    Which rows join:

    - New rows of at most one look. A free row without hits in the 27 voxels at and around it joins a row beside it that is at
      least as heavy. If there is none, and no hits lie within three voxels, it joins a row two voxels away that is three times
      as heavy. A free row beside hits, and a row of hits, joins only a row beside it that is 25 times as heavy.
    - Old rows of at most three looks, in the box `within`: a free row joins a row beside it that is 10 times as heavy, a row of
      hits one that is 25 times as heavy. So places that are seen again and again get no more rows for noise.
    - Free rows in voxels with hits never join: they tell that something has left. Nor do near rows and shadows.

    A look is the weight of one beam's hit. A voxel that one scan has looked at more than once keeps its row: close to the
    sensor surfaces may turn up later.

    Args:
        rows, points, kind, weight, fine_m, source: As for `add`; they are not changed.
        within: Corners of the box in which old rows may join others, m, in the rows' frame; None leaves old rows alone.
        turn: Number of the scan: one part in `TURNS` of the old rows is looked at in each.
    """
    added = fill(rows, points, kind, weight, fine_m, source)
    n_before = len(rows.kind)
    left = np.ones(len(added.weight), bool)
    # voxels of free space whose neighbours are in the box too; an empty box has none
    lower, upper = (np.zeros(3), np.zeros(3)) if within is None else within
    first, last = np.floor(lower / fine_m).astype(np.int64) + 1, np.floor(upper / fine_m).astype(np.int64) - 1
    # the part shifts with every round, so that a source that has every third turn gets to all parts too
    part = (turn + turn // TURNS) % TURNS
    is_hit = np.flatnonzero(added.rows.occupied)
    places = added.rows.voxel[is_hit] >> added.rows.halvings[is_hit, None]
    hits, wide = FlagGrid.of(places), FlagGrid.of(places, 1)
    _join_light(
        added.rows, added.weight, left, n_before, source, fine_m, first, last, part, added.places, hits, wide
    )
    cells = Cells.of(added.places, added.n_cells)
    cells = cells._replace(number=cells.number[left])
    return Joined(added.rows.take(left), added.weight[left], int(left[:n_before].sum()), cells)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _join_light(rows, gained, left, n_old, source, fine_m, first, last, part, index, hits, wide):
    """Join rows, in place; `left` says afterwards which are left. Old ones join only in voxels from `first` to `last`.

    Args:
        rows, gained, n_old, source, fine_m: See `add_sparing`; the rows have the samples.
        index: Of the rows.
        hits: Voxels of the resolution with hits in them, of any source and scale. Where they are flagged in blocks, fewer rows
            join.
        wide: The same in blocks, which are looked up faster.
    """
    voxel, kind, sums, sources = rows
    most = _heaviest(kind, sums, index)
    place = np.empty(3, np.int64)
    for r in range(len(kind)):
        w = sums[r, 3]
        is_old = r < n_old
        sort = kind[r] & KIND_MASK
        is_hit = sort == HIT
        if not (is_hit or sort == FREE) or not 0.0 < w <= (_STILL_LIGHT if is_old else _LIGHT):
            continue
        if is_old:
            if sources[r] != source or (voxel[r, 0] + 2 * voxel[r, 1] + 3 * voxel[r, 2]) % TURNS != part:
                continue
            if not _is_between(voxel[r], halvings(kind[r]), first, last):
                continue
        edge = fine_m / (1 << halvings(kind[r]))
        for c in range(3):
            place[c] = voxel[r, c] >> halvings(kind[r])
        if not is_hit and may_be_around(hits, place, 0):
            continue
        factor = _BESIDE_HITS
        if not is_hit:
            if is_old:
                factor = _OLD_FREE
            elif not may_be_around(hits, place, _CLEAR):
                factor = _BESIDE_IN_THE_CLEAR
        to = _nearest_around(rows, left, edge, r, 1, factor * w, index, most)
        if to < 0 and factor == _BESIDE_IN_THE_CLEAR and not may_be_around(wide, place, _WIDE_CLEAR):
            to = _nearest_around(rows, left, edge, r, 2, _AWAY_IN_THE_CLEAR * w, index, most)
        if to < 0:
            continue
        for c in range(3):
            sums[to, c] += sums[r, c] + w * (voxel[r, c] - voxel[to, c]) * edge
        sums[to, 3] += w
        cell = index.number[to]
        most[np.int64(is_hit), cell] = max(most[np.int64(is_hit), cell], sums[to, 3])
        gained[to] += gained[r]
        left[r] = False


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_between(voxel, shift, first, last):
    """Whether a voxel, whose edge is the resolution / 2^shift, lies in a box of voxels of the resolution."""
    for c in range(3):
        v = voxel[c] >> shift
        if v < first[c] or v > last[c]:
            return False
    return True


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _heaviest(kind, sums, index):
    """(2, C) what the heaviest row of free space, and of hits, of each cell weighs: in most none is heavy enough."""
    out = np.zeros((2, len(index.head)), np.float32)
    for r in range(len(kind)):
        sort, cell = kind[r] & KIND_MASK, index.number[r]
        if sort in (HIT, FREE):
            is_hit = np.int64(sort == HIT)
            out[is_hit, cell] = max(out[is_hit, cell], sums[r, 3])
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nearest_around(rows, left, edge, r, reach, least_weight, index, most):
    """Of the other rows of its kind and source within `reach` voxels of row r, the nearest of at least such weight; or -1.

    Args:
        most: See `_heaviest`.
    """
    voxel, kind, sums, sources = rows
    heaviest = most[np.int64(kind[r] & KIND_MASK == HIT)]
    _, following, head, keys, table = index
    shift, scale = np.int64(kind[r] & 1), kind[r] >> SCALE_SHIFT
    x, y, z = np.int64(voxel[r, 0]), np.int64(voxel[r, 1]), np.int64(voxel[r, 2])
    nearest = np.int64(-1)
    least = np.inf
    for cx in range((x - reach) >> shift, ((x + reach) >> shift) + 1):
        for cy in range((y - reach) >> shift, ((y + reach) >> shift) + 1):
            for cz in range((z - reach) >> shift, ((z + reach) >> shift) + 1):
                cell = table[find(table, keys, pack(scale, cx, cy, cz))]
                if cell < 0 or heaviest[cell] < least_weight:
                    continue
                q = head[cell]
                while q >= 0:
                    if (
                        kind[q] == kind[r]
                        and sources[q] == sources[r]
                        and q != r
                        and left[q]
                        and sums[q, 3] >= least_weight
                        and max(abs(voxel[q, 0] - x), abs(voxel[q, 1] - y), abs(voxel[q, 2] - z)) <= reach
                    ):
                        d2 = 0.0
                        for c in range(3):
                            off = sums[q, c] / sums[q, 3] - sums[r, c] / sums[r, 3]
                            d2 += ((voxel[q, c] - voxel[r, c]) * edge + off) ** 2
                        if d2 < least:
                            least, nearest = d2, np.int64(q)
                    q = following[q]
    return nearest
