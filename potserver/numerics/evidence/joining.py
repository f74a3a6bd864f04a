"""Adding samples sparingly: light rows join heavier ones beside them, so that a map gets few rows in clear space."""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Bool, Float32, Float64, UInt8
from potserver.numerics.evidence.rows import FREE, HIT, Rows, fill
from potserver.numerics.voxel_hash import any_around, empty_table, enter, find, pack

TURNS = 3  # scans in which each old row is looked at once: a third of the old rows a scan keeps the cost low
_LIGHT = 1.01  # looks: the most weight of a new row that may join another; its parts add up with rounding
_STILL_LIGHT = 3.0  # looks: the same for an old row
# How much heavier, as a factor, the row must be that another joins.
_BESIDE_IN_THE_CLEAR = 1.0  # a new free row, no hits in the voxels around
_AWAY_IN_THE_CLEAR = 3.0  # the same, two voxels away
_OLD_FREE = 10.0  # an old free row: much heavier neighbours show that it is noise
_BESIDE_HITS = 25.0  # a new free row beside hits, and every row of hits: surfaces need their detail
_CLEAR = 1  # voxels around a free row without hits, for it to join a row beside it
_WIDE_CLEAR = 3  # the same, to join a row two voxels away


class Joined(NamedTuple):
    """Rows after samples were added and light rows joined others."""

    rows: Rows  # those that are left of the old ones first, in their order
    weight: Float32  # (R,) what each row gained by the samples, with what joined it
    n_old: int


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
    _join_light(
        added.rows, added.weight, left, n_before, source, fine_m, first, last, part, added.table, added.keys,
        empty_table(len(added.keys)),
    )  # fmt: skip
    return Joined(added.rows.take(left), added.weight[left], int(left[:n_before].sum()))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _join_light(rows, gained, left, n_old, source, fine_m, first, last, part, table, keys, hit_table):
    """Join rows, in place; `left` says afterwards which are left. Old ones join only in voxels from `first` to `last`."""
    voxel, kind, sums, sources = rows
    hit_cells = np.empty(len(kind), np.int64)  # free voxels with hits in them, of any source
    n_hit_cells = 0
    for r in range(len(kind)):
        if kind[r] == HIT:
            key = pack(0, voxel[r, 0] >> 1, voxel[r, 1] >> 1, voxel[r, 2] >> 1)
            n_hit_cells = max(n_hit_cells, enter(hit_table, hit_cells, n_hit_cells, key) + 1)
    for r in range(len(kind)):
        w = sums[r, 3]
        is_old = r < n_old
        is_hit = kind[r] == HIT
        if not (is_hit or kind[r] == FREE) or not 0.0 < w <= (_STILL_LIGHT if is_old else _LIGHT):
            continue
        if is_old:
            if sources[r] != source or (voxel[r, 0] + 2 * voxel[r, 1] + 3 * voxel[r, 2]) % TURNS != part:
                continue
            if not _is_between(voxel[r], 1 if is_hit else 0, first, last):
                continue
        label, edge = np.int64(kind[r]), 0.5 * fine_m if is_hit else fine_m
        if not is_hit and any_around(hit_table, hit_cells, 0, voxel[r], 0):
            continue
        factor = _BESIDE_HITS
        if not is_hit:
            if is_old:
                factor = _OLD_FREE
            elif not any_around(hit_table, hit_cells, 0, voxel[r], _CLEAR):
                factor = _BESIDE_IN_THE_CLEAR
        to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 1, factor * w)
        if (
            to < 0
            and factor == _BESIDE_IN_THE_CLEAR
            and not any_around(hit_table, hit_cells, 0, voxel[r], _WIDE_CLEAR)
        ):
            to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 2, _AWAY_IN_THE_CLEAR * w)
        if to < 0:
            continue
        for c in range(3):
            sums[to, c] += sums[r, c] + w * (voxel[r, c] - voxel[to, c]) * edge
        sums[to, 3] += w
        gained[to] += gained[r]
        left[r] = False


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_between(voxel, shift, first, last):
    """Whether a voxel, whose edge is that of free space / 2^shift, lies in a box of voxels of free space."""
    for c in range(3):
        v = voxel[c] >> shift
        if v < first[c] or v > last[c]:
            return False
    return True


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nearest_around(table, keys, voxel, sums, left, edge, r, label, reach, least_weight):
    """Of the other rows of a label within `reach` voxels of row r, the nearest of at least such weight; -1 if there is none."""
    nearest = np.int64(-1)
    least = np.inf
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            for dz in range(-reach, reach + 1):
                key = pack(label, voxel[r, 0] + dx, voxel[r, 1] + dy, voxel[r, 2] + dz)
                q = np.int64(table[find(table, keys, key)])
                if q < 0 or q == r or not left[q] or sums[q, 3] < least_weight:
                    continue
                d2 = 0.0
                for c in range(3):
                    off = sums[q, c] / sums[q, 3] - sums[r, c] / sums[r, 3]
                    d2 += ((voxel[q, c] - voxel[r, c]) * edge + off) ** 2
                if d2 < least:
                    least, nearest = d2, q
    return nearest
