"""Leaving: hits that beams pass through without an echo are gone once chance no longer explains it.

Each voxel of hits keeps two tallies beside its hits. `PASSED` counts the beams that went through while the place still gave
echoes: much of it means a fence, a bush, a thin pole, or a surface at a grazing angle. `MISSED` counts those since the last
echo. How often a beam gives an echo there is not known but from h hits and m passed, so it has a Beta distribution, and k
beams in a row miss what is still there with a probability of

    B(h + 1/2, m + k + 1/2) / B(h + 1/2, m + 1/2)                                               (Jeffreys' prior)

When that falls below one in `odds`, what stood there has left. Nothing in this depends on the range, the sensor or the
background: a far box of few echoes takes more scans than a near one of many, and a fence that lets nine of ten beams through
stays. Voxels of missed hits that touch each other count together: they are one thing. They are not independent, and neither
are the beams of one scan, so `odds` must be far higher than what one would bet.

Things leave as a whole. Where a share of the hits around a voxel has left, no more than `odds` to the power of the share that
stays is asked against it; where next to none stays, nothing. So what lies between the rings goes with what they see through.

Lengths are those of the data: a beam passes what lies before the face that it ends on, across that face and by more than its
noise. So floors and walls at a grazing angle are not passed, and what stood close before a wall is.

The same passes tell where things end: a beam that passes beside the hits of what is still there is free as close to its edge.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64, Int32, Int64, UInt8
from potserver.numerics.beams import Beams
from potserver.numerics.evidence.rows import (
    FREE,
    HIT,
    KIND_MASK,
    MISSED,
    NEAR,
    PASSED,
    SCALE_SHIFT,
    Rows,
    is_alive,
    kind_of,
    positions,
)
from potserver.numerics.flag_grid import FlagGrid
from potserver.numerics.surface import Normals
from potserver.numerics.threads import parallel_map, spans
from potserver.numerics.voxel_hash import empty_table, find, pack

# How far before a face, across it, something else stands: so much, and so many standard deviations of the face's noise.
_MARGIN_M, _SIGMAS = 0.1, 2.0
_LEAST_COSINE = 0.05  # of the incidence of a beam
_NEAR = 0.75  # resolutions from an echo to hits that it confirms, at most
_ALONG = 2  # voxels: hits that a beam passes so near to each other share its one pass, for it may graze
_PRIOR = 0.5  # of an echo, and of none: beams that each voxel has had before any were counted
_ONE_SCAN = 3.0  # misses, at most: beams of one scan lie in the same ring, and miss a wire together
_ALONE = 0.2  # of the hits around a voxel: if no more stay, it goes along though no beam missed it
_UNSEEN = 0.25  # of a hit that no echo confirms: so much it counts among those that stay
_WALK = 0.75  # step of a walk along a beam, in voxels of hits
_BESIDE_M = 0.06  # from hits, at least: closer beams may graze them
_MOST_FOLLOWED = (
    15_000  # beams of a scan; of more, every second, third ... is followed, and counts for those left out
)
_BLOCK_SHIFT = 1  # blocks of 2^shift voxels of hits along an edge, at least
_SPANS = 8  # of beams; the number of threads plays no part in how they are cut


class SeenThrough(NamedTuple):
    """Samples that say where beams went through hits: tallies, and free space where things have left."""

    points: Float64  # (P, 3) m, in the rows' frame
    kind: UInt8  # (P,) PASSED, MISSED, FREE or NEAR
    weight: Float64  # (P,) beams, or looks of NEAR

    @staticmethod
    def nothing() -> SeenThrough:
        """No samples."""
        return SeenThrough(np.zeros((0, 3)), np.zeros(0, np.uint8), np.zeros(0))


class _Hits(NamedTuple):
    """The voxels of H rows of hits, ready to be looked up. A voxel is numbered by its last row."""

    voxel: Int32  # (H, 3)
    at: Float64  # (H, 3) m, where the hits lie
    table: Int32
    keys: Int64  # (H,)
    near: FlagGrid  # which blocks of voxels have hits: most of a beam's way leads through blocks without

    @staticmethod
    def of(voxel: Int32, at: Float64) -> _Hits:
        table = empty_table(len(voxel))
        keys = _enter_voxels(voxel, table)
        return _Hits(voxel, at, table, keys, FlagGrid.of(voxel, _BLOCK_SHIFT))


class _Echoes(NamedTuple):
    """The E echoes of a scan, ready to be looked up by their voxels."""

    hits: _Hits
    following: Int32  # (E,) another echo in the same voxel; -1 after the last
    normal: Float64  # (E, 3) of the face that it came from
    margin_m: Float64  # (E,) what lies so near to the plane of that face belongs to it

    @staticmethod
    def of(at: Float64, faces: Normals, fine_m: float) -> _Echoes:
        hits = _Hits.of(np.floor(at / (0.5 * fine_m)).astype(np.int32), at)
        return _Echoes(hits, _chain(hits.keys, hits.table), faces.normal, _MARGIN_M + _SIGMAS * faces.sigma_m)


class _Passes(NamedTuple):
    """P passes of a beam through a voxel with hits, in the order in which each beam goes."""

    hit: Int32  # (P,) the voxel's number
    beam: Int32  # (P,)


class _Tallies(NamedTuple):
    """What each of H voxels of hits has had so far, by its number."""

    of_row: Int64  # (R,) the number of the voxel that a row of hits or tallies belongs to; -1: none
    hits: Float64  # (H,)
    passed: Float64  # (H,)
    missed: Float64  # (H,)


def see_through(
    rows: Rows,
    beams: Beams,
    faces: Normals,
    origin: Float64,
    *,
    fine_m: float,
    odds: float,
    beside_weight: float = 0.0,
    threads: int = 1,
) -> SeenThrough:
    """Take out hits that have left, in place, and say what else the beams of a scan tell about hits that they pass through.

    A beam passes through the voxels of hits on its way, but for those on the face that it ends on. Where it passes several
    within two voxels of each other, each gets its share of one beam: it may graze a surface. A voxel is still there if an echo
    of the scan lies in it or in one that touches it, on the same face.

    Args:
        rows: The sums of rows of hits and tallies are changed.
        beams: B beams, relative to their start.
        faces: That their E echoes lie on.
        origin: (3,) m, the beams' start in the rows' frame.
        fine_m: The resolution.
        odds: Against missing what is still there; beyond them it has left.
        beside_weight: Looks of free space that beams of the scan give beside the hits of a voxel, all together.
        threads: Threads to spread the beams over.
    Returns:
        Samples to add: tallies at the centres of their voxels, free space where beams passed the rows that were taken out, and
        near samples on the beams that passed beside hits of what is still there.
    """
    hit_rows = np.flatnonzero(rows.occupied & is_alive(rows))
    ends = beams.ends + origin
    echoes = _Echoes.of(ends[beams.is_return], faces, fine_m)
    known = rows.take(hit_rows)
    voxel = np.concatenate([echoes.hits.voxel, known.voxel >> known.scale[:, None]])
    if len(voxel) == 0 or len(ends) == 0:
        return SeenThrough.nothing()
    hits = _Hits.of(voxel, np.concatenate([echoes.hits.at, positions(known, fine_m)]))
    every = -(-len(ends) // _MOST_FOLLOWED)
    before = np.zeros(len(ends))
    before[beams.is_return] = echoes.margin_m / np.maximum(faces.cosine, _LEAST_COSINE)
    passes = _follow(
        np.ascontiguousarray(ends[::every]), before[::every].copy(), origin, hits, fine_m, threads
    )
    tallies = _Tallies(*_tallies(rows.voxel, rows.kind, rows.sums[:, 3], hits.table, hits.keys))
    passing = every * np.bincount(passes.hit, _shares(hits.voxel, *passes), len(voxel))
    asked = np.flatnonzero((passing > 0) | (tallies.missed > 0))
    is_missed = _is_lonely(asked, hits, echoes, _NEAR * fine_m)
    there, missed = asked[~is_missed], asked[is_missed]
    beams_around, hits_around, passed_around = (
        _around(missed, of_voxel, hits.voxel, hits.table, hits.keys)
        for of_voxel in (passing, tallies.hits, tallies.passed)
    )
    new_misses = -_ONE_SCAN * np.expm1(-beams_around / _ONE_SCAN)
    in_a_row = tallies.missed[missed] + new_misses
    chance = np.zeros(len(voxel))  # log; of those that no beam missed it is that of the certain
    chance[missed] = _log_missed(hits_around, passed_around, in_a_row)
    gone = chance < -np.log(odds)
    _take_along(gone, chance, tallies.hits, hits, echoes, _NEAR * fine_m, np.log(odds))
    has_left = gone[missed]
    free, still = missed[has_left], missed[~has_left]
    where = positions(rows.take(hit_rows[free - len(echoes.margin_m)]), fine_m)
    _take_out(rows, tallies, there, np.flatnonzero(gone))
    centres = (hits.voxel + 0.5) * (0.5 * fine_m)
    is_known = np.zeros(len(voxel), bool)  # of voxels of this scan's echoes alone no beam says where they end
    is_known[there[there >= len(echoes.margin_m)]] = True
    scale = np.concatenate([np.zeros(len(echoes.margin_m), np.uint8), known.scale])
    beside = _beside(
        _Passes(passes.hit[is_known[passes.hit]], passes.beam[is_known[passes.hit]]),
        ends[::every], origin, hits, tallies, scale, beside_weight,
    )  # fmt: skip
    return SeenThrough(
        np.concatenate([centres[there], centres[still], where, beside.points]),
        np.concatenate(
            [
                np.repeat(np.array([PASSED, MISSED, FREE], np.uint8), [len(there), len(still), len(free)]),
                beside.kind,
            ]
        ),
        np.concatenate(
            [(tallies.missed + passing)[there], new_misses[~has_left], in_a_row[has_left], beside.weight]
        ),
    )


def _beside(
    passes: _Passes,
    ends: Float64,
    origin: Float64,
    hits: _Hits,
    tallies: _Tallies,
    scale: UInt8,
    weight: float,
) -> SeenThrough:
    """Near samples where beams are closest to hits that they pass beside.

    What lets most beams through is thin, and there is more room beside it than it takes: it has so much less weight.
    """
    if not weight:
        return SeenThrough.nothing()
    hit, beam = passes
    along = ends[beam] - origin
    along /= np.linalg.norm(along, axis=1)[:, None]
    closest = origin + np.einsum("ij,ij->i", hits.at[hit] - origin, along)[:, None] * along
    is_clear = np.linalg.norm(closest - hits.at[hit], axis=1) >= _BESIDE_M
    hit, closest = hit[is_clear], closest[is_clear]
    solid = tallies.hits[hit] / (tallies.hits[hit] + tallies.passed[hit])
    each = weight * solid / np.bincount(hit, minlength=len(scale))[hit]
    return SeenThrough(closest, kind_of(NEAR, scale[hit]), each)


def _take_out(rows: Rows, tallies: _Tallies, there: Int64, gone: Int64) -> None:
    """Empty rows in place: what was missed where something is still there, and all of what has left."""
    is_there, is_gone = np.zeros((2, len(tallies.hits) + 1), np.bool_)  # the last one is of rows of no voxel
    is_there[there], is_gone[gone] = True, True
    is_missed = rows.kind == MISSED
    is_tally = is_missed | (rows.kind == PASSED)
    out = is_gone[tallies.of_row] | (is_missed & is_there[tallies.of_row]) | (is_tally & (tallies.of_row < 0))
    rows.sums[out] = 0.0


def _follow(
    ends: Float64, before: Float64, origin: Float64, hits: _Hits, fine_m: float, threads: int
) -> _Passes:
    """Where beams pass through voxels with hits, so far before their ends; all in the rows' frame."""

    def run(span: tuple[int, int]) -> _Passes:
        a, b = span
        room = 4 * (b - a) + 1024
        while True:
            found, beam = np.empty(room, np.int32), np.empty(room, np.int32)
            n = _passes(ends[a:b], before[a:b], origin, hits, fine_m, found, beam)
            if n <= room:
                return _Passes(found[:n], beam[:n] + np.int32(a))
            room = n

    parts = parallel_map(run, spans(len(ends), _SPANS), threads)
    return _Passes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _log_missed(hits, passed, in_a_row):
    """(V,) log of the probability that so many beams in a row miss a voxel of so many hits and passes that is still there."""
    out = np.empty(len(hits))
    for v in range(len(hits)):
        echo, none = hits[v] + _PRIOR, passed[v] + _PRIOR
        out[v] = (
            math.lgamma(none + in_a_row[v])
            - math.lgamma(none)
            + math.lgamma(echo + none)
            - math.lgamma(echo + none + in_a_row[v])
        )
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter_voxels(voxel, table):
    """Keys; a voxel's entry is its last row: each source has a row of its own."""
    keys = np.empty(len(voxel), np.int64)
    for i in range(len(voxel)):
        keys[i] = pack(1, voxel[i, 0], voxel[i, 1], voxel[i, 2])
        table[find(table, keys, keys[i])] = i
    return keys


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _tallies(voxel, kind, weight, table, keys):
    """See `_Tallies`; the table and the keys are of the voxels of hits."""
    of_row = np.full(len(kind), -1, np.int64)
    hits, passed, missed = np.zeros(len(keys)), np.zeros(len(keys)), np.zeros(len(keys))
    for r in range(len(kind)):
        sort, scale = kind[r] & KIND_MASK, kind[r] >> SCALE_SHIFT
        if sort not in (HIT, PASSED, MISSED):
            continue
        key = pack(1, voxel[r, 0] >> scale, voxel[r, 1] >> scale, voxel[r, 2] >> scale)
        number = table[find(table, keys, key)]
        of_row[r] = number
        if number < 0:
            continue
        if sort == HIT:
            hits[number] += weight[r]
        elif sort == PASSED:
            passed[number] += weight[r]
        else:
            missed[number] += weight[r]
    return of_row, hits, passed, missed


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _around(chosen, of_voxel, voxel, table, keys):
    """(C,) sums of a number that each voxel has, over those of the chosen voxels that are each one or touch it."""
    is_chosen = np.zeros(len(voxel), np.bool_)
    is_chosen[chosen] = True
    out = np.zeros(len(chosen))
    for i in range(len(chosen)):
        x, y, z = voxel[chosen[i]]
        for dx in range(-1, 2):
            for dy in range(-1, 2):
                for dz in range(-1, 2):
                    number = table[find(table, keys, pack(1, x + dx, y + dy, z + dz))]
                    if number >= 0 and is_chosen[number]:
                        out[i] += of_voxel[number]
    return out


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _shares(voxel, hit, beam):
    """(P,) the share of its beam that each pass gets: passes through voxels near each other are one."""
    shares = np.empty(len(hit))
    for i in range(len(hit)):
        n = 1
        for step in (-1, 1):
            j = i + step
            while 0 <= j < len(hit) and beam[j] == beam[i]:
                apart = 0
                for c in range(3):
                    apart = max(apart, abs(voxel[hit[j], c] - voxel[hit[i], c]))
                if apart > _ALONG:
                    break
                n += 1
                j += step
        shares[i] = 1.0 / n
    return shares


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _passes(ends, before, origin, hits, fine_m, found, beam):
    """How often beams pass through voxels with hits; which voxels and beams, as far as `found` and `beam` have room.

    The buffers do not grow in here: numba would count references in every step, which takes three times as long.
    """
    table, keys, at, (corner, shift, is_near) = hits.table, hits.keys, hits.at, hits.near
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
        stop = length - before[b] / edge
        s = 0.5 * _WALK
        last = np.int64(-1)
        while s < stop + 1.0:
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
            if (
                r < 0
                or (at[r, 0] / edge - ox) * dx + (at[r, 1] / edge - oy) * dy + (at[r, 2] / edge - oz) * dz
                > stop
            ):
                continue
            if n < len(found):
                found[n] = r
                beam[n] = b
            n += 1
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _chain(keys, table):
    """(E,) for each entry another one of its key, so that all are met from the one in the table; -1 after the last."""
    following = np.full(len(keys), -1, np.int32)
    before = np.full(len(table), -1, np.int32)
    for i in range(len(keys)):
        place = find(table, keys, keys[i])
        following[i] = before[place]
        before[place] = i
    return following


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_there(v, hits, echoes, reach_m):
    """Whether an echo lies in a voxel or in one that touches it, on a face that what stood in the voxel belongs to."""
    table, keys = echoes.hits.table, echoes.hits.keys
    x, y, z = hits.voxel[v]
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                e = table[find(table, keys, pack(1, x + dx, y + dy, z + dz))]
                while e >= 0:
                    across, apart = 0.0, 0.0
                    for c in range(3):
                        d = echoes.hits.at[e, c] - hits.at[v, c]
                        across += d * echoes.normal[e, c]
                        apart += d * d
                    if abs(across) <= echoes.margin_m[e] and apart <= reach_m * reach_m:
                        return True
                    e = echoes.following[e]
    return False


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_lonely(asked, hits, echoes, reach_m):
    """(A,) whether no echo of the scan says that a voxel of hits is still there."""
    lonely = np.empty(len(asked), np.bool_)
    for i in range(len(asked)):
        lonely[i] = not _is_there(asked[i], hits, echoes, reach_m)
    return lonely


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _take_along(gone, chance, weight, hits, echoes, reach_m, log_odds):
    """Let voxels that touch what has left go with it, in place: a thing leaves as a whole.

    Args:
        gone: (V,) which voxels have left by themselves.
        chance: (V,) log of the probability that the beams missed what is still there.
        weight: (V,) of their hits.
        hits, echoes: The voxels; what the scan found.
        reach_m: From an echo to hits that it confirms.
        log_odds: Against missing what is still there.
    """
    voxel, table, keys = hits.voxel, hits.table, hits.keys
    state = np.zeros(len(gone), np.uint8)
    queue = np.flatnonzero(gone)
    waiting = [queue[i] for i in range(len(queue))]
    around = np.empty(27, np.int64)
    beside = np.empty(27, np.int64)
    while len(waiting) > 0:
        v = waiting.pop()
        for i in range(_touching(voxel[v], table, keys, around)):
            u = around[i]
            if gone[u] or weight[u] <= 0.0 or _is_staying(u, state, hits, echoes, reach_m):
                continue
            stays, left = 0.0, 0.0
            for j in range(_touching(voxel[u], table, keys, beside)):
                w = beside[j]
                if gone[w]:
                    left += weight[w]
                elif weight[w] > 0.0:
                    stays += weight[w] * (1.0 if _is_staying(w, state, hits, echoes, reach_m) else _UNSEEN)
            if chance[u] <= -log_odds * max(0.0, stays / (stays + left) - _ALONE):
                gone[u] = True
                waiting.append(u)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _touching(at, table, keys, found):
    """How many voxels are or touch a (3,) one; their numbers, into `found` (27,)."""
    n = 0
    for dx in range(-1, 2):
        for dy in range(-1, 2):
            for dz in range(-1, 2):
                v = table[find(table, keys, pack(1, at[0] + dx, at[1] + dy, at[2] + dz))]
                if v >= 0:
                    found[n] = v
                    n += 1
    return n


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _is_staying(v, state, hits, echoes, reach_m):
    """`_is_there`, found out once."""
    if state[v] == 0:
        state[v] = 1 if _is_there(v, hits, echoes, reach_m) else 2
    return state[v] == 1
