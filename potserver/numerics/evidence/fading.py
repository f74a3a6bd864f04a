"""Fading: hits that beams pass through lose weight, and free evidence comes in their place, because what stood there has left.

One beam through a hit proves little: beams miss poles, wires and edges, and a grazing beam passes through many voxels of a
surface. So hits fade only where more beams pass than there are voxels of hits for them to pass through.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potserver.numerics.arrays import Bool, Float64, Int32, Int64
from potserver.numerics.beams import Beams
from potserver.numerics.evidence.rows import FREE, HIT, Rows, cells, is_alive, positions
from potserver.numerics.geometry import bounds
from potserver.numerics.threads import parallel_map, spans
from potserver.numerics.voxel_hash import any_around, empty_table, find, pack

_BEHIND = 2.0  # resolutions that a beam must go on behind a hit to have passed through it; less is a graze, or noise
_AROUND = 2  # voxels of hits to each side of a hit: where passing beams and voxels are counted
_DOUBTED = 8.0  # beams more than voxels up to which nothing fades
_SURE = 20.0  # the same, from which on hits fade in full
_FREE_A_HIT = 2.0  # free weight that comes for each weight of hits, at a rate of 1
_FREE_ALONE = 100.0  # the same, for each place
_OUTVOTED = 3.0  # free weight in a cell, in weights of its hits, beyond which no more is added
# what a look of each kind adds to the free weight that its cell may still take
_ROOM = np.zeros(4)
_ROOM[HIT], _ROOM[FREE] = _OUTVOTED, -1.0
_WALK = 0.75  # step of a walk along a beam, in voxels of hits
_BLOCK_SHIFT, _MAX_BLOCKS = 1, 2**22  # blocks of 2^shift voxels of hits along an edge
_SPANS = 8  # of beams; the number of threads plays no part in how they are cut


class SeenThrough(NamedTuple):
    """Free samples where hits stood that have left."""

    points: Float64  # (P, 3) m, in the rows' frame
    weight: Float64  # (P,)

    @staticmethod
    def nothing() -> SeenThrough:
        """No samples."""
        return SeenThrough(np.zeros((0, 3)), np.zeros(0))


class _Hits(NamedTuple):
    """The voxels of H rows of hits, ready to be looked up. A voxel is numbered by its last row."""

    voxel: Int32  # (H, 3)
    table: Int32
    keys: Int64  # (H,)
    following: Int64  # (H,) the next row in the same voxel, of another source; -1: none
    corner: Int32  # (3,) voxel at the lower corner of the blocks
    shift: int  # a block has 2^shift voxels along an edge
    is_near: Bool  # (X, Y, Z) which blocks have hits

    @staticmethod
    def of(voxel: Int32) -> _Hits:
        table = empty_table(len(voxel))
        keys, following = _enter_voxels(voxel, table)
        corner, shift, is_near = _blocks_of(voxel)
        return _Hits(voxel, table, keys, following, corner, shift, is_near)


class _Passes(NamedTuple):
    """P passes of a beam through a voxel with hits."""

    hit: Int32  # (P,) the voxel's number
    beam: Int32  # (P,)


def see_through(
    rows: Rows,
    beams: Beams,
    origin: Float64,
    *,
    fine_m: float,
    rate: float,
    gap_m: float,
    most_followed: int = 15_000,
    threads: int = 1,
) -> SeenThrough:
    """Weaken hits that beams have passed through, in place, and say where free space is instead.

    A beam passes through the voxels of hits on its way, up to `gap_m` before its own hit and two resolutions before its end. A
    voxel fades if

    - no hit of the scan lies in it or in a voxel that touches it, and
    - the beams that pass through it or through voxels of hits within two of it outnumber these voxels by more than 8. The
      share s by which it fades grows from 0 at 8 to 1 at 20.

    Its rows are scaled by exp(-rate s). Free evidence of weight rate s (2 w + 100) comes where each stands, until the cell has
    three times as much free weight as hits; w is the row's weight, and the rows of a voxel share the 100. So what was seen once
    fades at the same rate as what stood for long, and a place that was left stays in some doubt.

    Args:
        rows: The sums of hit rows are changed.
        beams: B beams, relative to their start.
        origin: (3,) m, the beams' start in the rows' frame.
        fine_m: The resolution.
        rate: Of the decay, for each scan.
        gap_m: A beam says nothing about this much before its hit.
        most_followed: Beams. Of more, every second, third ... is followed, and counts for those left out.
        threads: Threads to spread the beams over.
    Returns:
        Free samples to add, one a row that was weakened.
    """
    hit_rows = np.flatnonzero(rows.occupied & is_alive(rows))
    if len(hit_rows) == 0 or len(beams.ends) == 0:
        return SeenThrough.nothing()
    hits = _Hits.of(rows.voxel[hit_rows])
    ends = beams.ends + origin
    every = -(-len(ends) // most_followed)
    followed = Beams(ends[::every], beams.is_return[::every])
    passes = _follow(followed, origin, hits, fine_m, gap_m, threads)
    passed = np.flatnonzero(np.bincount(passes.hit, minlength=len(hit_rows)))
    new = np.floor(ends[beams.is_return] / (0.5 * fine_m)).astype(np.int32)
    passed = passed[_is_lonely(hits.voxel[passed], new, empty_table(len(new)))]
    excess = every * _excess_at(passed, passes, hits, len(followed.ends))
    share = np.clip((excess - _DOUBTED) / (_SURE - _DOUBTED), 0.0, 1.0)
    if not share.any():
        return SeenThrough.nothing()
    place, member = _members(passed[share > 0], hits.following)
    return _fade(rows, hit_rows[member], place, share[share > 0][place], rate, fine_m)


def _follow(beams: Beams, origin: Float64, hits: _Hits, fine_m: float, gap_m: float, threads: int) -> _Passes:
    """Where beams pass through voxels with hits; their ends are in the rows' frame."""

    def run(span: tuple[int, int]) -> _Passes:
        a, b = span
        room = 4 * (b - a) + 1024
        while True:
            found, beam = np.empty(room, np.int32), np.empty(room, np.int32)
            n = _passes(beams.ends[a:b], beams.is_return[a:b], origin, hits, fine_m, gap_m, found, beam)
            if n <= room:
                return _Passes(found[:n], beam[:n] + np.int32(a))
            room = n

    parts = parallel_map(run, spans(len(beams.ends), _SPANS), threads)
    return _Passes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _excess_at(passed: Int64, passes: _Passes, hits: _Hits, n_beams: int) -> Int32:
    """(V,) by how much the beams that pass through the voxels in and around each of V voxels outnumber those voxels.

    Args:
        passed: (V,) numbers of the voxels; only these count as voxels with hits.
        passes, hits: All of them.
        n_beams: That were followed.
    """
    slot = np.full(len(hits.voxel), -1, np.int32)
    slot[passed] = np.arange(len(passed))
    kept = np.flatnonzero(slot[passes.hit] >= 0)
    kept = kept[np.argsort(passes.hit[kept], kind="stable")]
    first = np.searchsorted(passes.hit[kept], np.append(passed, len(hits.voxel)))
    return _excess(hits.voxel[passed], first, passes.beam[kept], slot, hits.table, hits.keys, n_beams)


def _fade(
    rows: Rows, gone: NDArray[np.intp], place: Int64, share: Float64, rate: float, fine_m: float
) -> SeenThrough:
    """Scale rows, in place; the free evidence that comes where they stand.

    Args:
        rows: All rows.
        gone: (G,) numbers of the rows that fade.
        place: (G,) the number of each one's voxel.
        share: (G,) how far it fades, in [0, 1].
        rate, fine_m: See `see_through`.
    """
    alone = _FREE_ALONE / np.bincount(place)[place]
    weight = rate * share * (_FREE_A_HIT * rows.sums[gone, 3] + alone)
    rows.sums[gone] *= np.exp(-rate * share)[:, None].astype(np.float32)
    # no cell's free weight may grow beyond its bound
    number, n_cells = cells(rows)
    room = np.bincount(number, _ROOM[rows.kind] * rows.sums[:, 3], n_cells)
    wanted = np.bincount(number[gone], weight, n_cells)
    weight *= np.minimum(1.0, np.maximum(room[number[gone]], 0.0) / wanted[number[gone]])
    return SeenThrough(positions(rows.take(gone), fine_m), weight)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter_voxels(voxel, table):
    """Keys, and for each row the next one in the same voxel: each source has a row of its own."""
    keys = np.empty(len(voxel), np.int64)
    following = np.empty(len(voxel), np.int64)
    for i in range(len(voxel)):
        keys[i] = pack(1, voxel[i, 0], voxel[i, 1], voxel[i, 2])
        place = find(table, keys, keys[i])
        following[i] = table[place]
        table[place] = i
    return keys, following


def _blocks_of(voxel: Int32) -> tuple[Int32, int, Bool]:
    """Which blocks of 2^shift voxels along an edge hold any of (V, 3) voxels: their lower corner, the shift, a flag a block.

    Most of a beam's way leads through blocks without hits, and a flag is looked up faster than a voxel.
    """
    corner, last = bounds(voxel)
    shift = _BLOCK_SHIFT
    while np.prod(((last - corner) >> shift).astype(np.float64) + 1.0) > _MAX_BLOCKS:
        shift += 1
    is_near = np.zeros(((last - corner) >> shift) + 1, bool)
    is_near[tuple(((voxel - corner) >> shift).T)] = True
    return corner, shift, is_near


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _passes(ends, is_return, origin, hits, fine_m, gap_m, found, beam):
    """How often beams pass through voxels with hits; which voxels and beams, as far as `found` and `beam` have room.

    The buffers do not grow in here: numba would count references in every step, which takes three times as long.
    """
    table, keys, corner, shift, is_near = hits.table, hits.keys, hits.corner, hits.shift, hits.is_near
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
    """See `_excess_at`; the passes of voxel v are beam[first[slot]:first[slot + 1]] with slot = slot[v]."""
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
    """All rows of voxels that are given by their last rows: (M,) which of the voxels each row is in, (M,) the rows."""
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
    """(V,) whether none of the new voxels is a voxel or touches it."""
    keys = np.empty(len(new), np.int64)
    for i in range(len(new)):
        keys[i] = pack(1, new[i, 0], new[i, 1], new[i, 2])
        place = find(table, keys, keys[i])
        if table[place] < 0:
            table[place] = i
    lonely = np.empty(len(voxel), np.bool_)
    for i in range(len(voxel)):
        lonely[i] = not any_around(table, keys, 1, voxel[i], 1)
    return lonely
