"""Evidence: all labelled points ever seen, as one weighted pseudo-datum a voxel, label and source.

A row holds the weight of the samples that fell into its voxel, and their weighted sum of positions, relative to the voxel's
centre. So it stands at their mean, rows of two maps add, and what was added can be taken off again. Hits are kept in voxels of
half the resolution, free samples in voxels of the resolution; each source, a robot, has rows of its own, so that it can be
taken out. There are never more rows than voxels times sources, whatever is seen.

All functions are pure but for `forget` and `see_through`, which scale sums in place.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.numerics.geometry import bounds
from potserver.numerics.threads import parallel_map, spans
from potserver.numerics.voxel_hash import empty_table, enter, find, pack

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int16 = NDArray[np.int16]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

_LEAST_WEIGHT = 1e-3  # a row with less says nothing
_INSIDE = 0.5 - 1e-6  # voxels, from the centre
_LIGHT = 1.01  # looks, parts of which add up with rounding: a new row with more keeps its place
_STILL_LIGHT = 3.0  # looks: an old row with more keeps its place
_CLEAR = 1  # voxels without hits around a free row that may join any other beside it
_WIDE_CLEAR = 3  # the same, for one that may join another two voxels away
_WIDE_OUTWEIGHED = 3.0  # times that the other must weigh then
_OUTWEIGHED = 25.0  # the same, for rows of hits and for new free ones beside hits
_STILL_OUTWEIGHED = 10.0  # the same, for old free rows
_TURNS = 3  # scans in which each old row is looked at once
_BEHIND = 2.0  # resolutions that a beam goes on behind what it passes through; less is a graze, or noise
_AROUND = 2  # voxels of hits to each side: where beams are counted that pass through a place
_DOUBTED, _SURE = 8.0, 20.0  # beams more than voxels: the most that tell nothing, the least that tell all
_FREE_A_HIT, _FREE_ALONE = 2.0, 100.0  # free weight for each hit and for each place, at a rate of 1
_OUTVOTED = 3.0  # free weight for the hits' in a cell, beyond which no more is put there
_WALK = 0.75  # step of a walk along a beam, in voxels of hits
_BLOCK_SHIFT, _MAX_BLOCKS = 1, 2**22  # blocks of 2^shift voxels of hits along an edge
_SPANS = 8  # of beams; fixed, like all spans of work, though these only count


class Rows(NamedTuple):
    """R pseudo-data in one frame."""

    voxel: Int32  # (R, 3) cell numbers from the frame's origin, in cells of the resolution (free) or half of it (hits)
    occupied: Bool  # (R,)
    sums: Float32  # (R, 4) sum of w (x - centre) for each axis, m; sum of w
    source: Int16  # (R,) who saw it

    @staticmethod
    def empty() -> Rows:
        """No rows."""
        return Rows(
            np.zeros((0, 3), np.int32), np.zeros(0, bool), np.zeros((0, 4), np.float32), np.zeros(0, np.int16)
        )

    @staticmethod
    def concatenate(sets: list[Rows]) -> Rows:
        """All rows, in order."""
        return Rows(*(np.concatenate(parts) for parts in zip(*sets, strict=True))) if sets else Rows.empty()

    def take(self, index: NDArray[np.intp] | Bool | slice) -> Rows:
        """The rows that a numpy index picks."""
        return Rows(self.voxel[index], self.occupied[index], self.sums[index], self.source[index])


class Added(NamedTuple):
    """Rows after samples were added."""

    rows: Rows  # the old ones first, in their order
    weight: Float32  # (R,) what each row gained


class Joined(NamedTuple):
    """Rows after samples were added and light rows have joined others."""

    rows: Rows  # those that are left of the old ones first, in their order
    weight: Float32  # (R,) what each row gained by the samples, those of rows that joined it included
    n_old: int


def add(
    rows: Rows,
    points: Float64,
    occupied: Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int = 0,
) -> Added:
    """Add a source's weighted samples to the rows; a negative weight takes samples off, down to nothing and no further.

    Args:
        rows: Each voxel, label and source once.
        points: (N, 3) m, in the rows' frame.
        occupied: (N,) labels.
        weight: (N,) of each sample.
        fine_m: The resolution.
        source: Who saw them; rows of others stay as they are.
    """
    return _with_samples(rows, points, occupied, weight, fine_m, source)[0]


def add_sparing(
    rows: Rows,
    points: Float64,
    occupied: Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int = 0,
    *,
    within: tuple[Float64, Float64] | None = None,
    turn: int = 0,
) -> Joined:
    """Add samples as `add` does, and let rows that say little share one with what is beside them.

    The weight stays, the place becomes a mean: a row that joins another gives it its weight, and the other moves with the mean
    of all its samples as far as its own voxel goes. Rows join the nearest of their label and source in the voxels around.

    New rows of one look at most: in clear space, without hits in the 27 voxels there, the other need not be the lighter one;
    of hits, and of free rows beside hits, only what another outweighs 25 times joins it. Where no hits are within three voxels
    and no row is beside, a row two voxels away will do, if it weighs three times as much. Looks are of one scan: a voxel that a
    scan has looked at more often keeps its row whatever is around, for close to the sensor surfaces may turn up later.

    Old rows of three looks at most join what has come to outweigh them, free rows 10 times and hits 25 times: they have proved
    to be noise, and a place that is seen again and again gets no more rows for it.

    Free rows in voxels with hits stay: they are what tells that something has left.

    Args:
        rows, points, occupied, weight, fine_m, source: As for `add`; they are not changed.
        within: Corners of the box in which old rows may join others, m, in the rows' frame; None leaves old rows alone.
        turn: Of the old rows a part is looked at, with the next number another one.
    """
    added, table, keys = _with_samples(rows, points, occupied, weight, fine_m, source)
    n_before = len(rows.occupied)
    left = np.ones(len(added.weight), bool)
    # voxels of free space whose neighbours are in the box too: of an empty box none
    lower, upper = (np.zeros(3), np.zeros(3)) if within is None else within
    first, last = np.floor(lower / fine_m).astype(np.int64) + 1, np.floor(upper / fine_m).astype(np.int64) - 1
    part = (turn + turn // _TURNS) % _TURNS  # who has every second or third turn gets to all parts, too
    _join_light(
        *added.rows, added.weight, left, n_before, source, fine_m, first, last, part, table, keys,
        empty_table(len(keys)),
    )  # fmt: skip
    return Joined(added.rows.take(left), added.weight[left], int(left[:n_before].sum()))


def _with_samples(
    rows: Rows,
    points: Float64,
    occupied: Bool,
    weight: Float64 | Float32,
    fine_m: float,
    source: int,
) -> tuple[Added, Int32, Int64]:
    """The new rows, and the hash table of the source's with its keys."""
    n_old, n = len(rows.occupied), len(points)
    voxel = np.empty((n_old + n, 3), np.int32)
    label = np.empty(n_old + n, bool)
    sums = np.zeros((n_old + n, 4), np.float32)
    voxel[:n_old], label[:n_old], sums[:n_old] = rows.voxel, rows.occupied, rows.sums
    sources = np.full(n_old + n, source, np.int16)
    sources[:n_old] = rows.source
    gained = np.zeros(n_old + n, np.float32)
    keys, table = np.empty(n_old + n, np.int64), empty_table(n_old + n)
    used = _add(
        voxel, label, sums, sources, gained, n_old, np.ascontiguousarray(points), occupied,
        np.asarray(weight, np.float64), fine_m, source, table, keys,
    )  # fmt: skip
    return Added(Rows(voxel[:used], label[:used], sums[:used], sources[:used]), gained[:used]), table, keys


def positions(rows: Rows, fine_m: float) -> Float64:
    """(R, 3) m: where the rows stand, the weighted means of their samples, strictly inside their voxels.

    Samples on a face, as those of a planar map at z = 0, would else be in one voxel and their mean by rounding in the next.
    """
    return np.asarray(_positions(rows.voxel, rows.occupied, rows.sums, fine_m), np.float64)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _positions(voxel, occupied, sums, fine_m):
    out = np.empty((len(occupied), 3))
    for r in range(len(occupied)):
        edge = 0.5 * fine_m if occupied[r] else fine_m
        weight = max(sums[r, 3], np.float32(1e-9))
        for c in range(3):
            offset = min(max(np.float64(sums[r, c] / weight), -_INSIDE * edge), _INSIDE * edge)
            out[r, c] = (voxel[r, c] + 0.5) * edge + offset
    return out


def is_alive(rows: Rows) -> Bool:
    """(R,) which rows still say something."""
    return rows.sums[:, 3] > _LEAST_WEIGHT


def tile_of(rows: Rows, voxels: int, size: Int64) -> tuple[Int64, Int32]:
    """Which tile of a box each row lies in, and its voxel counted from that tile's corner.

    Args:
        rows: In a frame whose origin is the box's lower corner.
        voxels: Of free space along a tile's edge; of hits there are twice as many.
        size: (3,) tiles along the box's axes.
    Returns:
        (R,) numbers of the tiles, z fastest, and (R, 3) voxels.
    """
    return _tile_of(rows.voxel, rows.occupied, voxels, size)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _tile_of(voxel, occupied, voxels, size):
    number = np.zeros(len(occupied), np.int64)
    local = np.empty((len(occupied), 3), np.int32)
    for r in range(len(occupied)):
        edge = 2 * voxels if occupied[r] else voxels
        for c in range(3):
            tile = voxel[r, c] // edge
            number[r] = number[r] * size[c] + tile
            local[r, c] = voxel[r, c] - tile * edge
    return number, local


class Cells(NamedTuple):
    """The cell, a free voxel with the hits in it, of each row: the unit in which evidence saturates and is forgotten."""

    number: Int64  # (R,) from 0
    n: int


def cells(rows: Rows) -> Cells:
    """Number the cells that have rows."""
    number, n = _cells(rows.voxel, rows.occupied, empty_table(len(rows.occupied)))
    return Cells(number, n)


def forget(sums: Float32, gained: Float32, cells: Cells, limit: float) -> None:
    """Let old evidence give way to new, in place: no cell keeps more than `limit` of weight.

    Args:
        sums: (R, 4) of the rows, what was gained included.
        gained: (R,) the part of the weights that is new.
        cells: Of the rows.
        limit: Weight; of new evidence alone as much is kept as fits, in proportion.
    """
    _forget(sums, gained, cells.number, cells.n, limit)


def counts(sums: Float32, cells: Cells, saturation: float) -> Float32:
    """(R,) what each row counts in a fit: its weight / (1 + weight of its cell / saturation).

    Looks at one place repeat each other, so a cell counts for at most `saturation` looks, shared among its rows by weight.
    """
    weight = np.maximum(sums[:, 3], np.float32(0))
    total = np.bincount(cells.number, weight, cells.n)
    return (weight / (1.0 + total[cells.number] / saturation)).astype(np.float32)


class SeenThrough(NamedTuple):
    """Free samples where hits stood that have left."""

    points: Float64  # (P, 3) m, in the rows' frame
    weight: Float64  # (P,)

    @staticmethod
    def nothing() -> SeenThrough:
        """No samples."""
        return SeenThrough(np.zeros((0, 3)), np.zeros(0))


def see_through(
    rows: Rows,
    ends: Float64,
    is_return: Bool,
    origin: Float64,
    *,
    fine_m: float,
    rate: float,
    gap_m: float,
    most_followed: int = 15_000,
    threads: int = 1,
) -> SeenThrough:
    """Weaken hits that beams have passed through, in place, and say where free space is instead: what stood there has left.

    A beam passes through the voxels of hits on its way, up to well before its end. One that misses a pole, a wire or an edge
    does so too, and one that grazes a surface passes through many. So a scan sees through a hit only if no hit of its own lies
    in the same or a touching voxel, and if the beams that pass through voxels of hits at and around it, a resolution to each
    side, outnumber these voxels. From 8 more to 20 more its word grows from 0 to 1. At 1 the row is scaled by exp(-rate), and
    free evidence of rate (2 weight + 100) comes where it stands, as long as its cell has less than three times the hits'.
    So what was seen once goes no slower than what stood for long, and a place that was left stays in some doubt.

    Args:
        rows: The sums of hit rows are changed.
        ends: (B, 3) m, ends of the beams in the rows' frame.
        is_return: (B,) whether they are hits.
        origin: (3,) m, start of the beams in the rows' frame.
        fine_m: The resolution.
        rate: Of the decay, for each scan.
        gap_m: A beam says nothing about this much before its hit.
        most_followed: Beams; of more, every second, third ... is followed, and stands for those left out.
        threads: Threads to spread the beams over.
    Returns:
        Free samples to add, one a row that was weakened.
    """
    hits = np.flatnonzero(rows.occupied & is_alive(rows))
    if len(hits) == 0 or len(ends) == 0:
        return SeenThrough.nothing()
    voxel = rows.voxel[hits]
    table = empty_table(len(hits))
    keys, following = _enter_voxels(voxel, table)
    corner, shift, is_near = _blocks_of(voxel)
    every = -(-len(ends) // most_followed)
    followed, returned = ends[::every], is_return[::every]

    def run(span: tuple[int, int]) -> tuple[Int32, Int32]:
        a, b = span
        room = 4 * (b - a) + 1024
        while True:
            found, beam = np.empty(room, np.int32), np.empty(room, np.int32)
            n = _passes(
                followed[a:b], returned[a:b], origin, table, keys, corner, shift, is_near, fine_m, gap_m, found,
                beam,
            )  # fmt: skip
            if n <= room:
                return found[:n], beam[:n] + np.int32(a)
            room = n

    parts = parallel_map(run, spans(len(followed), _SPANS), threads)
    found, beam = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    passed = np.flatnonzero(np.bincount(found, minlength=len(hits)))
    new = np.floor(ends[is_return] / (0.5 * fine_m)).astype(np.int32)
    passed = passed[_is_lonely(voxel[passed], new, empty_table(len(new)))]
    slot = np.full(len(hits), -1, np.int32)
    slot[passed] = np.arange(len(passed))
    kept = np.flatnonzero(slot[found] >= 0)
    kept = kept[np.argsort(found[kept], kind="stable")]
    first = np.searchsorted(found[kept], np.append(passed, len(hits)))
    excess = every * _excess(voxel[passed], first, beam[kept], slot, table, keys, len(followed))
    word = np.clip((excess - _DOUBTED) / (_SURE - _DOUBTED), 0.0, 1.0)
    if not word.any():
        return SeenThrough.nothing()
    place, member = _members(passed[word > 0], following)
    gone = hits[member]
    word = word[word > 0][place]
    alone = _FREE_ALONE / np.bincount(place)[place]
    weight = rate * word * (_FREE_A_HIT * rows.sums[gone, 3] + alone)
    rows.sums[gone] *= np.exp(-rate * word)[:, None].astype(np.float32)
    # no cell's free weight may grow beyond its bound
    number, n_cells = cells(rows)
    room = np.bincount(number, np.where(rows.occupied, _OUTVOTED, -1.0) * rows.sums[:, 3], n_cells)
    wanted = np.bincount(number[gone], weight, n_cells)
    weight *= np.minimum(1.0, np.maximum(room[number[gone]], 0.0) / wanted[number[gone]])
    return SeenThrough(positions(rows.take(gone), fine_m), weight)


def decay(rows: Rows, factor: float) -> Rows:
    """All evidence scaled, say by age; the same rows if by 1, as on every scan of a map that does not age."""
    if factor == 1.0:
        return rows
    return rows._replace(sums=rows.sums * np.float32(factor))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _add(voxel, label, sums, sources, gained, n, points, occupied, weight, fine_m, source, table, keys):
    for r in range(n):
        if sources[r] == source:
            keys[r] = pack(label[r], voxel[r, 0], voxel[r, 1], voxel[r, 2])
            table[find(table, keys, keys[r])] = r
    cell = np.empty(3, np.int64)
    for i in range(len(points)):
        edge = 0.5 * fine_m if occupied[i] else fine_m
        for c in range(3):
            cell[c] = np.int64(np.floor(points[i, c] / edge))
        key = pack(occupied[i], cell[0], cell[1], cell[2])
        place = find(table, keys, key)
        r = table[place]
        if r < 0:
            if weight[i] <= 0.0:
                continue  # nothing to take off
            r = n
            table[place] = r
            keys[r] = key
            label[r] = occupied[i]
            for c in range(3):
                voxel[r, c] = cell[c]
            n += 1
        w = weight[i]
        if w < 0.0 and sums[r, 3] + w <= _LEAST_WEIGHT:
            gained[r] -= sums[r, 3]
            sums[r, :] = 0.0
            continue
        for c in range(3):
            sums[r, c] += w * (points[i, c] - (cell[c] + 0.5) * edge)
        sums[r, 3] += w
        gained[r] += w
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _join_light(
    voxel, occupied, sums, sources, gained, left, n_old, source, fine_m, first, last, part, table, keys, hit_table
):  # fmt: skip
    """Join rows, in place; `left` says afterwards which are left. Old ones join in voxels from `first` to `last` alone."""
    hit_cells = np.empty(len(occupied), np.int64)  # free voxels with hits in them, of any source
    n_hit_cells = 0
    for r in range(len(occupied)):
        if occupied[r]:
            key = pack(0, voxel[r, 0] >> 1, voxel[r, 1] >> 1, voxel[r, 2] >> 1)
            n_hit_cells = max(n_hit_cells, enter(hit_table, hit_cells, n_hit_cells, key) + 1)
    for r in range(len(occupied)):
        w = sums[r, 3]
        is_old = r < n_old
        if not 0.0 < w <= (_STILL_LIGHT if is_old else _LIGHT):
            continue
        if is_old:
            if sources[r] != source or (voxel[r, 0] + 2 * voxel[r, 1] + 3 * voxel[r, 2]) % _TURNS != part:
                continue
            if not _is_between(voxel[r], 1 if occupied[r] else 0, first, last):
                continue
        label, edge = np.int64(occupied[r]), 0.5 * fine_m if occupied[r] else fine_m
        if occupied[r]:
            to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 1, _OUTWEIGHED * w)
        elif _has_around(hit_table, hit_cells, 0, voxel[r], 0):
            continue
        elif is_old:
            to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 1, _STILL_OUTWEIGHED * w)
        elif _has_around(hit_table, hit_cells, 0, voxel[r], _CLEAR):
            to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 1, _OUTWEIGHED * w)
        else:
            to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 1, w)
            if to < 0 and not _has_around(hit_table, hit_cells, 0, voxel[r], _WIDE_CLEAR):
                to = _nearest_around(table, keys, voxel, sums, left, edge, r, label, 2, _WIDE_OUTWEIGHED * w)
        if to < 0:
            continue
        for c in range(3):
            sums[to, c] += sums[r, c] + w * (voxel[r, c] - voxel[to, c]) * edge
        sums[to, 3] += w
        gained[to] += gained[r]
        left[r] = False


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_between(voxel, shift, first, last):
    """Whether a voxel, 1 / 2^shift as long as one of free space, lies in a box of those."""
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


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _has_around(table, keys, kind, voxel, reach):
    """Whether a voxel of a kind, or one within `reach` voxels of it, has an entry."""
    for dx in range(-reach, reach + 1):
        for dy in range(-reach, reach + 1):
            for dz in range(-reach, reach + 1):
                key = pack(kind, voxel[0] + dx, voxel[1] + dy, voxel[2] + dz)
                if table[find(table, keys, key)] >= 0:
                    return True
    return False


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _cells(voxel, occupied, table):
    n_rows = len(occupied)
    number = np.empty(n_rows, np.int64)
    keys = np.empty(n_rows, np.int64)
    n = 0
    for r in range(n_rows):
        shift = 1 if occupied[r] else 0
        key = pack(0, voxel[r, 0] >> shift, voxel[r, 1] >> shift, voxel[r, 2] >> shift)
        number[r] = enter(table, keys, n, key)
        n = max(n, number[r] + 1)
    return number, n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _forget(sums, gained, cell, n_cells, limit):
    total = np.zeros(n_cells)
    new = np.zeros(n_cells)
    for r in range(len(cell)):
        total[cell[r]] += sums[r, 3]
        new[cell[r]] += max(gained[r], 0.0)
    for r in range(len(cell)):
        t, g = total[cell[r]], new[cell[r]]
        if g <= 0.0 or t <= limit or sums[r, 3] <= 0.0:
            continue
        keep_new = min(1.0, limit / g)
        keep_old = max(limit - g, 0.0) / (t - g) if t - g > 1e-9 else 0.0
        gain = max(gained[r], 0.0)
        # old and new share one mean
        sums[r] *= ((sums[r, 3] - gain) * keep_old + gain * keep_new) / sums[r, 3]


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter_voxels(voxel, table):
    """Keys, and for each row the next one in the same voxel: sources have rows of their own."""
    keys = np.empty(len(voxel), np.int64)
    following = np.empty(len(voxel), np.int64)
    for i in range(len(voxel)):
        keys[i] = pack(1, voxel[i, 0], voxel[i, 1], voxel[i, 2])
        place = find(table, keys, keys[i])
        following[i] = table[place]
        table[place] = i
    return keys, following


def _blocks_of(voxel: Int32) -> tuple[Int32, int, Bool]:
    """Which blocks of 2^shift voxels have any of (V, 3) voxels: their lower corner, the shift, a flag for each block.

    Most of a beam's way leads through blocks without hits, and a flag is found faster than a voxel.
    """
    corner, last = bounds(voxel)
    shift = _BLOCK_SHIFT
    while np.prod(((last - corner) >> shift).astype(np.float64) + 1.0) > _MAX_BLOCKS:
        shift += 1
    is_near = np.zeros(((last - corner) >> shift) + 1, bool)
    is_near[tuple(((voxel - corner) >> shift).T)] = True
    return corner, shift, is_near


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _passes(ends, is_return, origin, table, keys, corner, shift, is_near, fine_m, gap_m, found, beam):
    """How often beams pass through voxels with hits; as many as there is room for, each as its last row, and the beams.

    Arrays that grew in here would be references that are counted in every step, and take three times as long.
    """
    n = 0
    edge = 0.5 * fine_m
    ox, oy, oz = origin[0] / edge, origin[1] / edge, origin[2] / edge  # from here on in voxels
    for b in range(len(ends)):
        dx, dy, dz = ends[b, 0] / edge - ox, ends[b, 1] / edge - oy, ends[b, 2] / edge - oz
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= 0.0:
            continue
        dx /= length
        dy /= length
        dz /= length
        stop = length - max(gap_m if is_return[b] else 0.0, _BEHIND * fine_m) / edge
        s = 0.5 * _WALK
        last = np.int64(-1)
        while s < stop:
            x = np.int64(np.floor(ox + dx * s))
            y = np.int64(np.floor(oy + dy * s))
            z = np.int64(np.floor(oz + dz * s))
            s += _WALK
            i, j, k = (x - corner[0]) >> shift, (y - corner[1]) >> shift, (z - corner[2]) >> shift
            if not (0 <= i < is_near.shape[0] and 0 <= j < is_near.shape[1] and 0 <= k < is_near.shape[2]):
                continue
            if not is_near[i, j, k]:
                continue
            key = pack(1, x, y, z)
            if key == last:
                continue
            last = key
            r = table[find(table, keys, key)]
            if r < 0:
                continue
            if n < len(found):
                found[n] = r
                beam[n] = b
            n += 1
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _excess(voxel, first, beam, slot, table, keys, n_beams):
    """(V,) by how much the beams that pass through the voxels in and around each voxel outnumber those voxels."""
    excess = np.zeros(len(voxel), np.int32)
    stamp = np.full(n_beams, -1, np.int32)
    for v in range(len(voxel)):
        for dx in range(-_AROUND, _AROUND + 1):
            for dy in range(-_AROUND, _AROUND + 1):
                for dz in range(-_AROUND, _AROUND + 1):
                    key = pack(1, voxel[v, 0] + dx, voxel[v, 1] + dy, voxel[v, 2] + dz)
                    r = table[find(table, keys, key)]
                    if r < 0 or slot[r] < 0:
                        continue
                    excess[v] -= 1
                    for i in range(first[slot[r]], first[slot[r] + 1]):
                        if stamp[beam[i]] != v:
                            stamp[beam[i]] = v
                            excess[v] += 1
    return excess


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _members(last, following):
    """All rows of voxels that are given as their last rows: (M,) numbers of the voxels, (M,) rows."""
    n = 0
    for i in range(len(last)):
        r = np.int64(last[i])
        while r >= 0:
            n += 1
            r = following[r]
    place = np.empty(n, np.int64)
    member = np.empty(n, np.int64)
    n = 0
    for i in range(len(last)):
        r = np.int64(last[i])
        while r >= 0:
            place[n] = i
            member[n] = r
            n += 1
            r = following[r]
    return place, member


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_lonely(voxel, new, table):
    """(V,) which voxels have no new voxel at or beside them."""
    keys = np.empty(len(new), np.int64)
    for i in range(len(new)):
        keys[i] = pack(1, new[i, 0], new[i, 1], new[i, 2])
        place = find(table, keys, keys[i])
        if table[place] < 0:
            table[place] = i
    lonely = np.empty(len(voxel), np.bool_)
    for i in range(len(voxel)):
        lonely[i] = not _has_around(table, keys, 1, voxel[i], 1)
    return lonely
