"""Rows of evidence: how samples are added, where rows stand, what they count, and how they give way to newer ones.

A row belongs to one voxel, one kind and one source (a robot). It holds the weight of the samples that fell there, and the
weighted sum of their positions relative to the voxel's centre. So a row stands at the mean of its samples, rows of two maps can
be added, and a source's samples can be taken off again. There are at most as many rows as voxels times kinds times sources.

There are six kinds. Four are labels: `HIT` is where an echo came from, label 1. `FREE` is what a beam crossed, label 0. `NEAR`
is free space just before a face, label 0, kept apart so that faces stay sharp. `SHADOW` is what lies behind a hit: nobody saw
it, so its label is one half, it counts next to nothing, and only where nothing was seen to be free. `PASSED` and `MISSED` are
no labels but tallies of beams, beside hits, see `leaving`. Free samples and shadows have voxels of the resolution, the others
of half of it.

All functions are pure but for `forget`, which scales sums in place.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.numerics.arrays import Bool, Float32, Float64, Int16, Int32, Int64, UInt8
from potserver.numerics.voxel_hash import empty_table, enter, find, pack, unpack

FREE, HIT, SHADOW, NEAR = 0, 1, 2, 3  # kinds; the odd ones have voxels of half the edge
PASSED, MISSED = 5, 7
KINDS = (FREE, HIT, SHADOW, NEAR, PASSED, MISSED)
SCALES = 3  # a row of scale s has voxels of the resolution / 2^s: beams that lie closely see more detail
SCALE_SHIFT = 3  # a row's kind is that of its sample, one of `KINDS`, and its scale from this bit on
KIND_MASK = 2**SCALE_SHIFT - 1
# of the kinds: the share of occupied looks that they stand for
LABELS = np.full(8, np.nan, np.float32)
LABELS[[FREE, HIT, SHADOW, NEAR]] = 0.0, 1.0, 0.5, 0.0

_SEEN = 0.05  # looks of a cell from which on it counts as seen
_SHADOW_COUNT = 0.15  # looks that a shadow counts as in a fit
_LEAST_WEIGHT = 1e-3  # a row with less is taken for empty
_INSIDE = 0.5 - 1e-6  # voxels: how far from the centre a row may stand


def kind_of(sort: int, scale: UInt8) -> UInt8:
    """(N,) the kinds of rows of a sort, one of `KINDS`, and these scales."""
    return np.uint8(sort) + (scale << np.uint8(SCALE_SHIFT))


def halvings_of(kind: UInt8) -> UInt8:
    """See `Rows.halvings`."""
    return (kind >> np.uint8(SCALE_SHIFT)) + (kind & np.uint8(1))


class Rows(NamedTuple):
    """R pseudo-data in one frame."""

    voxel: Int32  # (R, 3) voxel numbers from the frame's origin, in voxels of the row's kind
    kind: UInt8  # (R,) one of `KINDS` + (scale << SCALE_SHIFT)
    sums: Float32  # (R, 4) sum of w (x - centre) for each axis, m; sum of w
    source: Int16  # (R,) number of the robot that saw it

    @staticmethod
    def empty() -> Rows:
        """No rows."""
        return Rows(
            np.zeros((0, 3), np.int32),
            np.zeros(0, np.uint8),
            np.zeros((0, 4), np.float32),
            np.zeros(0, np.int16),
        )

    @staticmethod
    def concatenate(sets: list[Rows]) -> Rows:
        """All rows, in order."""
        return Rows(*(np.concatenate(parts) for parts in zip(*sets, strict=True))) if sets else Rows.empty()

    def take(self, index: NDArray[np.intp] | Bool | slice) -> Rows:
        """The rows that a numpy index picks; a slice shares memory with them."""
        if isinstance(index, slice):
            return Rows(self.voxel[index], self.kind[index], self.sums[index], self.source[index])
        return Rows(*_take(*self, np.flatnonzero(index) if index.dtype == np.bool_ else index))

    @property
    def occupied(self) -> Bool:
        """(R,) which rows are hits."""
        return self.sort == HIT

    @property
    def sort(self) -> UInt8:
        """(R,) the kind without the scale."""
        return self.kind & np.uint8(KIND_MASK)

    @property
    def scale(self) -> UInt8:
        """(R,) how often the resolution was halved for it."""
        return self.kind >> np.uint8(SCALE_SHIFT)

    @property
    def halvings(self) -> UInt8:
        """(R,) how often the resolution was halved for the edge of its voxel."""
        return halvings_of(self.kind)

    def rescaled(self, ratio: float) -> Rows:
        """The same rows for a map whose resolution is `ratio` times finer, but for their voxels: those are of the new kinds.

        Hits, and what is told next to them, keep voxels of about their size; free space takes the map's.
        """
        scale = np.clip(self.scale.astype(np.int64) - round(math.log2(ratio)), 0, SCALES - 1).astype(np.uint8)
        is_of_hit = np.isin(self.sort, (HIT, SHADOW, NEAR))
        return self._replace(kind=np.where(is_of_hit, kind_of(0, scale) + self.sort, self.sort))


class Added(NamedTuple):
    """Rows after samples were added."""

    rows: Rows  # the old ones first, in their order
    weight: Float32  # (R,) what each row gained


class CellIndex(NamedTuple):
    """The cells that rows lie in, and the rows of each. A cell is a voxel of free space with the eight half ones in it."""

    number: Int32  # (R,) the cell of each row
    following: Int32  # (R,) the next row in the same cell; -1 after the last
    head: Int32  # (C,) a first row of each cell
    keys: Int64  # (C,) see `voxel_hash`
    table: Int32


class Filled(NamedTuple):
    """Rows after samples were added."""

    rows: Rows  # the old ones first, in their order
    weight: Float32  # (R,) what each row gained
    places: CellIndex
    n_cells: int


def add(
    rows: Rows,
    points: Float64,
    kind: UInt8 | Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int = 0,
) -> Added:
    """Add a source's weighted samples to the rows.

    A negative weight takes samples off; a row whose weight would fall below zero is left empty.

    Args:
        rows: Each voxel, kind and source once.
        points: (N, 3) m, in the rows' frame.
        kind: (N,) of the samples; a boolean label is `HIT` where it is true, `FREE` elsewhere.
        weight: (N,) of each sample.
        fine_m: The resolution.
        source: Who saw them; rows of other sources stay as they are.
    """
    filled = fill(rows, points, kind, weight, fine_m, source)
    return Added(filled.rows, filled.weight)


def fill(
    rows: Rows,
    points: Float64,
    kind: UInt8 | Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int,
) -> Filled:
    """`add`, for callers that go on looking for rows by cell."""
    n_old, n = len(rows.kind), len(points)
    voxel = np.empty((n_old + n, 3), np.int32)
    kinds = np.empty(n_old + n, np.uint8)
    sums = np.zeros((n_old + n, 4), np.float32)
    voxel[:n_old], kinds[:n_old], sums[:n_old] = rows.voxel, rows.kind, rows.sums
    sources = np.full(n_old + n, source, np.int16)
    sources[:n_old] = rows.source
    room = Rows(voxel, kinds, sums, sources)
    gained = np.zeros(n_old + n, np.float32)
    index, n_cells = _index_of(rows, room_for=n)
    used, n_cells = _add(
        room, gained, n_old, np.ascontiguousarray(points), np.asarray(kind, np.uint8), np.asarray(weight, np.float64),
        fine_m, source, index, n_cells,
    )  # fmt: skip
    index = index._replace(
        number=index.number[:used],
        following=index.following[:used],
        head=index.head[:n_cells],
        keys=index.keys[:n_cells],
    )
    return Filled(room.take(slice(used)), gained[:used], index, n_cells)


def _index_of(rows: Rows, *, room_for: int = 0) -> tuple[CellIndex, int]:
    """The cells of rows, with room for more rows and their cells; and how many cells there are."""
    size = len(rows.kind) + room_for
    index = CellIndex(
        number=np.empty(size, np.int32),
        following=np.empty(size, np.int32),
        head=np.empty(size, np.int32),
        keys=np.empty(size, np.int64),
        table=empty_table(_n_runs(rows.voxel, rows.kind) + room_for),
    )
    return index, _enter_cells(rows.voxel, rows.kind, index)


def positions(rows: Rows, fine_m: float) -> Float64:
    """(R, 3) m: where the rows stand, at the weighted means of their samples, strictly inside their voxels.

    Without that limit rounding could put the mean of samples on a face, as in a planar map at z = 0, into the next voxel.
    """
    return np.asarray(_positions(rows.voxel, rows.kind, rows.sums, fine_m), np.float64)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def halvings(kind):
    """As `halvings_of`, of one kind in compiled code."""
    return np.int64(kind >> SCALE_SHIFT) + np.int64(kind & 1)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _positions(voxel, kind, sums, fine_m):
    out = np.empty((len(kind), 3))
    for r in range(len(kind)):
        edge = fine_m / (1 << halvings(kind[r]))
        weight = max(sums[r, 3], np.float32(1e-9))
        for c in range(3):
            offset = min(max(np.float64(sums[r, c] / weight), -_INSIDE * edge), _INSIDE * edge)
            out[r, c] = (voxel[r, c] + 0.5) * edge + offset
    return out


def is_label(rows: Rows) -> Bool:
    """(R,) which rows say whether their place is occupied; the others are tallies."""
    return rows.sort < PASSED


def is_alive(rows: Rows) -> Bool:
    """(R,) which rows have weight left."""
    return rows.sums[:, 3] > _LEAST_WEIGHT


def tile_of(rows: Rows, voxels: int, size: Int64) -> tuple[Int64, Int32]:
    """Which tile of a box each row lies in, and its voxel counted from that tile's corner.

    Args:
        rows: In a frame whose origin is the box's lower corner.
        voxels: Of free space along a tile's edge; of those of half the resolution there are twice as many.
        size: (3,) tiles along the box's axes.
    Returns:
        (R,) numbers of the tiles, z fastest, and (R, 3) voxels.
    """
    return _tile_of(rows.voxel, rows.kind, voxels, size)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _tile_of(voxel, kind, voxels, size):
    number = np.zeros(len(kind), np.int64)
    local = np.empty((len(kind), 3), np.int32)
    for r in range(len(kind)):
        edge = voxels << halvings(kind[r])
        for c in range(3):
            tile = voxel[r, c] // edge
            number[r] = number[r] * size[c] + tile
            local[r, c] = voxel[r, c] - tile * edge
    return number, local


class Cells(NamedTuple):
    """The cell of each row: a voxel of free space and the voxels of hits in it. Evidence saturates and is forgotten by cell."""

    number: Int32  # (R,) from 0
    around: (
        Int32  # (C, SCALES - 1) the cell of each coarser scale that one lies in; -1 where that has no rows
    )
    n: int

    @staticmethod
    def of(index: CellIndex, n: int) -> Cells:
        """Those of an index of n cells."""
        return Cells(index.number, _cells_around(index.keys[:n], index.table, n), n)


def cells(rows: Rows) -> Cells:
    """Number the cells that have rows."""
    return Cells.of(*_index_of(rows))


def forget(rows: Rows, gained: Float32, cells: Cells, limit: float) -> None:
    """Scale old evidence down, in place, so that no cell keeps more than `limit` of weight. Cells without new evidence stay.

    Args:
        rows: What was gained included; tallies are left alone.
        gained: (R,) the part of the weights that is new.
        cells: Of the rows.
        limit: Weight of a cell. New evidence that exceeds it alone is scaled down to it.
    """
    _forget(rows.sums, gained, is_label(rows), cells.number, cells.n, limit)


def counts(rows: Rows, cells: Cells, saturation: float) -> Float32:
    """(R,) what each row counts in a fit: its weight / (1 + weight of its cell / saturation).

    Looks at one place repeat each other. So a cell counts for less than `saturation` looks, shared among its rows by weight.
    Shadows count a part of a look where nothing in their cell was seen to be free, and nothing elsewhere; tallies never count.
    """
    return np.asarray(
        _counts(rows.kind, rows.sums, cells.number, cells.around, cells.n, saturation), np.float32
    )


def clip(rows: Rows, memory: float) -> None:
    """Bound what rows weigh that are not forgotten by cell, in place.

    A shadow weighs one look at most: that nobody saw a place says no more when it is said again. A tally keeps `memory` beams.
    """
    most = np.full(len(LABELS), np.inf, np.float32)
    most[SHADOW], most[[PASSED, MISSED]] = 1.0, memory
    at_most = most[rows.sort]
    heavy = np.flatnonzero(rows.sums[:, 3] > at_most)
    rows.sums[heavy] *= (at_most[heavy] / rows.sums[heavy, 3])[:, None]


def decay(rows: Rows, factor: float) -> Rows:
    """All weights times a factor, e.g. for their age. A factor of 1 returns the rows themselves."""
    if factor == 1.0:
        return rows
    return rows._replace(sums=rows.sums * np.float32(factor))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _take(voxel, kind, sums, source, index):
    n = len(index)
    out_voxel, out_kind = np.empty((n, 3), np.int32), np.empty(n, np.uint8)
    out_sums, out_source = np.empty((n, 4), np.float32), np.empty(n, np.int16)
    for i in range(n):
        r = index[i]
        out_kind[i], out_source[i] = kind[r], source[r]
        for c in range(3):
            out_voxel[i, c] = voxel[r, c]
        for c in range(4):
            out_sums[i, c] = sums[r, c]
    return out_voxel, out_kind, out_sums, out_source


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _n_runs(voxel, kind):
    """Runs of rows of one cell, which are no fewer than cells."""
    n, last = 0, np.int64(-1)
    for r in range(len(kind)):
        shift = kind[r] & 1
        key = pack(kind[r] >> SCALE_SHIFT, voxel[r, 0] >> shift, voxel[r, 1] >> shift, voxel[r, 2] >> shift)
        n += key != last
        last = key
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _cells_around(keys, table, n):
    """See `Cells.around`."""
    out = np.full((n, SCALES - 1), -1, np.int32)
    for cell in range(n):
        scale, x, y, z = unpack(keys[cell])
        for coarser in range(scale):
            shift = scale - coarser
            out[cell, coarser] = table[find(table, keys, pack(coarser, x >> shift, y >> shift, z >> shift))]
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter_cells(voxel, kind, index):
    """Enter rows into an index that has room for them, in place; how many cells they lie in.

    A cell is looked up once a run of its rows; in tiles that is once.
    """
    number, following, head, keys, table = index
    n, cell, last = 0, np.int64(-1), np.int64(-1)
    for r in range(len(kind)):
        shift = kind[r] & 1
        key = pack(kind[r] >> SCALE_SHIFT, voxel[r, 0] >> shift, voxel[r, 1] >> shift, voxel[r, 2] >> shift)
        if key != last:
            cell = enter(table, keys, n, key)
            if cell == n:
                head[n] = -1
                n += 1
            last = key
        number[r] = cell
        following[r] = head[cell]
        head[cell] = r
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _add(rows, gained, n, points, kind, weight, fine_m, source, index, n_cells):
    """Fill `rows` from row n on, in place, with the index; how many rows and cells are used."""
    voxel, kinds, sums, sources = rows
    number, following, head, keys, table = index
    at = np.empty(3, np.int64)
    for i in range(len(points)):
        k = kind[i]
        edge = fine_m / (1 << halvings(k))
        for c in range(3):
            at[c] = np.int64(np.floor(points[i, c] / edge))
        key = pack(k >> SCALE_SHIFT, at[0] >> (k & 1), at[1] >> (k & 1), at[2] >> (k & 1))
        place = find(table, keys, key)
        cell = table[place]
        r = np.int32(-1) if cell < 0 else head[cell]
        while r >= 0 and not (
            kinds[r] == k
            and sources[r] == source
            and voxel[r, 0] == at[0]
            and voxel[r, 1] == at[1]
            and voxel[r, 2] == at[2]
        ):
            r = following[r]
        w = weight[i]
        if r < 0:
            if w <= 0.0:
                continue  # nothing to take off
            if cell < 0:
                cell = n_cells
                table[place], keys[cell], head[cell] = cell, key, -1
                n_cells += 1
            r = n
            number[r], following[r], head[cell] = cell, head[cell], r
            kinds[r] = k
            for c in range(3):
                voxel[r, c] = at[c]
            n += 1
        if w < 0.0 and sums[r, 3] + w <= _LEAST_WEIGHT:
            gained[r] -= sums[r, 3]
            sums[r, :] = 0.0
            continue
        for c in range(3):
            sums[r, c] += w * (points[i, c] - (at[c] + 0.5) * edge)
        sums[r, 3] += w
        gained[r] += w
    return n, n_cells


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _counts(kind, sums, cell, around, n_cells, saturation):
    total, free = np.zeros(n_cells), np.zeros(n_cells)
    for r in range(len(kind)):
        sort = kind[r] & KIND_MASK
        if sort < PASSED and sort != SHADOW:
            weight = max(sums[r, 3], np.float32(0))
            total[cell[r]] += weight
            if sort != HIT:
                free[cell[r]] += weight
    seen = free >= _SEEN
    for c in range(n_cells):
        for coarser in around[c]:
            if coarser >= 0 and free[c] >= _SEEN:
                seen[coarser] = True
    for c in range(n_cells):
        for coarser in around[c]:
            if coarser >= 0 and free[coarser] >= _SEEN:
                seen[c] = True
    out = np.zeros(len(kind), np.float32)
    for r in range(len(kind)):
        sort = kind[r] & KIND_MASK
        if sort == SHADOW:
            if not seen[cell[r]]:
                out[r] = _SHADOW_COUNT
        elif sort < PASSED:
            out[r] = max(sums[r, 3], np.float32(0)) / (1.0 + total[cell[r]] / saturation)
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _forget(sums, gained, is_label, cell, n_cells, limit):
    total = np.zeros(n_cells)
    new = np.zeros(n_cells)
    for r in range(len(cell)):
        if is_label[r]:
            total[cell[r]] += sums[r, 3]
            new[cell[r]] += max(gained[r], 0.0)
    for r in range(len(cell)):
        t, g = total[cell[r]], new[cell[r]]
        if not is_label[r] or g <= 0.0 or t <= limit or sums[r, 3] <= 0.0:
            continue
        keep_new = min(1.0, limit / g)
        keep_old = max(limit - g, 0.0) / (t - g) if t - g > 1e-9 else 0.0
        gain = max(gained[r], 0.0)
        # one factor for the row: its old and its new samples share one mean
        sums[r] *= ((sums[r, 3] - gain) * keep_old + gain * keep_new) / sums[r, 3]
