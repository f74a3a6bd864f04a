"""Sums over the kernels of bricks, and their gradients, at points: see `bricks`.

Each point is summed by itself, in the order of lattices and rows, so its sums depend neither on other points nor on threads.
"""

from __future__ import annotations

from collections.abc import Callable

import numba as nb
import numpy as np

from potschemas.answers import LatentGradients, LatentSums
from potserver.numerics.arrays import Float32, Float64
from potserver.numerics.brick_map import (
    AT_BRICK,
    AT_LANE,
    AT_Y,
    AT_Z,
    BRICK_LAYERS,
    BRICK_ROW_OF,
    BRICK_ROWS,
    FALL,
    FROM_Y,
    FROM_Z,
    LATTICE_BYTES,
    LOWER,
    NODES_A_METRE,
    PHASE,
    TO_Y,
    TO_Z,
    UPPER,
    WIDTH,
    WINDOW_BYTES,
    BrickMap,
    BrickTable,
    find_windows,
)
from potserver.numerics.bricks import BEFORE, BYTES_OF_ROW, ROW, ROWS, WINDOW
from potserver.numerics.cubes import sort_into_cubes
from potserver.numerics.simd import (
    LANES,
    exp8,
    fma8,
    load8,
    load_f32,
    load_f64,
    load_i16,
    load_i64,
    minus8,
    splat8,
    store8,
    store_i64,
    sum8,
    times8,
)
from potserver.numerics.threads import parallel_map, spans

_WORTH_THREADS = 2048  # points; with fewer one thread is as fast as several
# So many points, in a map of more bytes than a processor's own cache has, are asked cube by cube.
_WORTH_SORTING, _CACHE_BYTES, _CUBE_M = 4096, 2**20, 4.0
TO_VARIANCES, TO_KNOWN = (
    4 * ROW,
    8 * ROW,
)  # bytes from a row's weights to its variances, and to its known shares
# Bytes in the room of a thread: the window's nodes; factors of a point along x, y and z, and their slopes over themselves,
# 1/spacing; eight numbers; and some lattices' last windows: number, node along x, y and z, how many bricks, and these.
_NODES, FACTORS, _SLOPES, SPARE, _LAST = (4 * LANES * n for n in (0, 1, 4, 7, 8))
_N_LAST, _BYTES_OF_LAST, _BRICKS_OF_LAST = 4, 40 + 8 * WINDOW_BYTES, 40
WINDOWS = _LAST + _N_LAST * _BYTES_OF_LAST  # those of a grid's column
_ROOM = WINDOWS + 8 * WINDOW_BYTES
BYTES_OF_AXIS = 4 * LANES  # bytes from the factors of one axis to those of the next
_BEYOND = 100.0  # spacings: lanes beyond the window get a factor of 0 by this

_jit = nb.njit(nogil=True, error_model="numpy", cache=True)


def brick_sums(bricks: BrickMap, points: Float64, *, threads: int = 1, lane: str = "map") -> LatentSums:
    """The sums of eq. 1 over all kernels in bricks.

    Args:
        bricks: The kernels.
        points: (N, 3) m, map frame.
        threads, lane: See `kernel_index.latent_sums`.
    Returns:
        float32.
    """
    return LatentSums(*_by_spans(_sum_points, bricks, points, 4, threads, lane)[:3])


def brick_widths(
    bricks: BrickMap, points: Float64, *, threads: int = 1, lane: str = "map"
) -> tuple[Float32, Float32]:
    """(N,) activation, and the kernels' widths, m, summed by what each adds to it; arguments as `brick_sums`."""
    out = _by_spans(_sum_points, bricks, points, 4, threads, lane)
    return out[2], out[3]


def brick_gradients(
    bricks: BrickMap, points: Float64, *, threads: int = 1, lane: str = "map"
) -> LatentGradients:
    """Gradients of `brick_sums`, per metre; arguments as there."""
    out = _by_spans(_slope_points, bricks, points, 9, threads, lane)
    return LatentGradients(out[:3].T, out[3:6].T, out[6:].T)


def _by_spans(
    function: Callable[[Float64, BrickTable, Float32, Float32], None],
    bricks: BrickMap,
    points: Float64,
    n_sums: int,
    threads: int,
    lane: str,
) -> Float32:
    """(n_sums, N) what a function adds to zeros, at N points."""
    n = len(points)
    out = np.zeros((n_sums, n), np.float32)
    if n == 0 or len(bricks) == 0:
        return out
    is_far_apart = n >= _WORTH_SORTING and bricks.n_bytes >= _CACHE_BYTES
    order = sort_into_cubes(points, _CUBE_M)[0] if is_far_apart else None

    def run(span: tuple[int, int]) -> None:
        # points and sums lie in the order in which they are asked: jumps among them take as long as the sums
        which = slice(*span) if order is None else order[slice(*span)]
        asked = points[which] if isinstance(which, slice) else points.take(which, axis=0)
        found = np.zeros((n_sums, len(asked)), np.float32)
        function(asked, bricks.table, room_for_a_thread(), found)
        for sums, here in zip(out, found, strict=True):
            sums[which] = here

    threads = threads if n >= _WORTH_THREADS else 1
    parallel_map(run, spans(n, 4 * threads if threads > 1 else 1), threads, lane)
    return out


def room_for_a_thread() -> Float32:
    """What the functions below take as `room`, by its address. Compiled code would free it before its last use."""
    room = np.zeros(_ROOM // 4, np.float32)
    room[:LANES] = [*range(WINDOW), *[_BEYOND] * (LANES - WINDOW)]
    room[_LAST // 4 :] = np.nan  # no lattice's number
    return room


@_jit
def is_near(lattice, x, y, z):
    """Whether nodes of a lattice, by the address of its record, may be in the window of a point."""
    return (
        (load_f64(lattice + LOWER) <= x <= load_f64(lattice + UPPER))
        and (load_f64(lattice + LOWER + 8) <= y <= load_f64(lattice + UPPER + 8))
        and (load_f64(lattice + LOWER + 16) <= z <= load_f64(lattice + UPPER + 16))
    )


@_jit
def set_factors(lattice, off, axis, room):
    """The factors along one axis of a point `off` spacings from its window's first node, and their slopes over themselves."""
    distance = minus8(splat8(np.float32(off)), load8(room + _NODES))
    fall = np.float32(-load_f64(lattice + FALL))
    store8(room + FACTORS + axis * BYTES_OF_AXIS, exp8(times8(splat8(fall), times8(distance, distance))))
    store8(room + _SLOPES + axis * BYTES_OF_AXIS, times8(splat8(np.float32(2.0) * fall), distance))


@_jit
def windows_of(t, number, x, y, z, room):
    """Find the bricks for a point, and set its factors; how many bricks there are, and the address of what finds them."""
    lattice = t.lattices + LATTICE_BYTES * number
    scale = load_f64(lattice + NODES_A_METRE)
    u = x * scale - load_f64(lattice + PHASE)
    v = y * scale - load_f64(lattice + PHASE + 8)
    w = z * scale - load_f64(lattice + PHASE + 16)
    i, j, k = np.int64(np.floor(u)) - BEFORE, np.int64(np.floor(v)) - BEFORE, np.int64(np.floor(w)) - BEFORE
    last = room + _LAST + _BYTES_OF_LAST * (number % _N_LAST)
    if not (
        load_i64(last) == number
        and load_i64(last + 8) == i
        and load_i64(last + 16) == j
        and load_i64(last + 24) == k
    ):
        store_i64(last, number)
        store_i64(last + 8, i)
        store_i64(last + 16, j)
        store_i64(last + 24, k)
        store_i64(last + 32, find_windows(t, number, i, j, k, last + _BRICKS_OF_LAST))
    n = load_i64(last + 32)
    if n:
        set_factors(lattice, u - i, 0, room)
        set_factors(lattice, v - j, 1, room)
        set_factors(lattice, w - k, 2, room)
    return n, last + _BRICKS_OF_LAST


@_jit
def sums_at(t, x, y, z, room):
    """At one point: the three sums, and the kernels' widths, m, summed by what each adds to the activation."""
    mean = var = activation = widths = splat8(np.float32(0))
    factors = room + FACTORS
    for number in range(t.n_lattices):
        lattice = t.lattices + LATTICE_BYTES * number
        if not is_near(lattice, x, y, z):
            continue
        n, windows = windows_of(t, number, x, y, z, room)
        for window in range(windows, windows + n * WINDOW_BYTES, WINDOW_BYTES):
            brick, row_z = load_i64(window + AT_BRICK), load_i64(window + AT_Z)
            start = load_i64(brick + BRICK_ROWS) + 4 * load_i64(window + AT_LANE)
            layers = load_i64(brick + BRICK_LAYERS) >> row_z
            first = load_i64(brick + BRICK_ROW_OF) + 2 * (row_z * ROWS + load_i64(window + AT_Y))
            y0, y1 = load_i64(window + FROM_Y), load_i64(window + TO_Y)
            m = v = a = splat8(np.float32(0))
            for k in range(load_i64(window + FROM_Z), load_i64(window + TO_Z)):
                if not (layers >> k) & 1:
                    continue
                # sums of its own for a layer: additions to one sum would wait for each other
                m_layer = v_layer = a_layer = splat8(np.float32(0))
                for j in range(y0, y1):
                    row = start + BYTES_OF_ROW * load_i16(first + 2 * (k * ROWS + j))
                    fy = splat8(load_f32(factors + BYTES_OF_AXIS + 4 * j))
                    m_layer = fma8(fy, load8(row), m_layer)
                    v_layer = fma8(times8(fy, fy), load8(row + TO_VARIANCES), v_layer)
                    a_layer = fma8(fy, load8(row + TO_KNOWN), a_layer)
                fz = splat8(load_f32(factors + 2 * BYTES_OF_AXIS + 4 * k))
                m, v, a = fma8(fz, m_layer, m), fma8(times8(fz, fz), v_layer, v), fma8(fz, a_layer, a)
            fx = load8(factors)
            mean, var = fma8(fx, m, mean), fma8(times8(fx, fx), v, var)
            activation = fma8(fx, a, activation)
            widths = fma8(times8(splat8(np.float32(load_f64(lattice + WIDTH))), fx), a, widths)
    return sum8(mean), sum8(var), sum8(activation), sum8(widths)


@_jit
def _sum_points(points, t, room, out):
    at = room.ctypes.data
    for q in range(len(points)):
        out[0, q], out[1, q], out[2, q], out[3, q] = sums_at(t, points[q, 0], points[q, 1], points[q, 2], at)


@_jit
def _slope_points(points, t, room, out):
    for q in range(len(points)):
        for number in range(t.n_lattices):
            _add_slopes(t, number, points, q, room.ctypes.data, out)


@_jit
def _add_slopes(t, number, points, q, room, out):
    """Add the gradients of one lattice's sums at a point."""
    lattice = t.lattices + LATTICE_BYTES * number
    if not is_near(lattice, points[q, 0], points[q, 1], points[q, 2]):
        return
    factors, slopes = room + FACTORS, room + _SLOPES
    scale, twice = np.float32(load_f64(lattice + NODES_A_METRE)), np.float32(2)
    n, windows = windows_of(t, number, points[q, 0], points[q, 1], points[q, 2], room)
    for window in range(windows, windows + n * WINDOW_BYTES, WINDOW_BYTES):
        brick, row_z = load_i64(window + AT_BRICK), load_i64(window + AT_Z)
        start = load_i64(brick + BRICK_ROWS) + 4 * load_i64(window + AT_LANE)
        layers = load_i64(brick + BRICK_LAYERS) >> row_z
        first = load_i64(brick + BRICK_ROW_OF) + 2 * (row_z * ROWS + load_i64(window + AT_Y))
        m = my = mz = v = vy = vz = a = ay = az = splat8(np.float32(0))
        for k in range(load_i64(window + FROM_Z), load_i64(window + TO_Z)):
            if not (layers >> k) & 1:
                continue
            fz = load_f32(factors + 2 * BYTES_OF_AXIS + 4 * k)
            sz = load_f32(slopes + 2 * BYTES_OF_AXIS + 4 * k)
            for j in range(load_i64(window + FROM_Y), load_i64(window + TO_Y)):
                row = start + BYTES_OF_ROW * load_i16(first + 2 * (k * ROWS + j))
                c = fz * load_f32(factors + BYTES_OF_AXIS + 4 * j)
                cy, cz = c * load_f32(slopes + BYTES_OF_AXIS + 4 * j), c * sz
                weight, variance, known = (
                    load8(row),
                    load8(row + TO_VARIANCES),
                    load8(row + TO_KNOWN),
                )
                m, a = fma8(splat8(c), weight, m), fma8(splat8(c), known, a)
                my, ay = fma8(splat8(cy), weight, my), fma8(splat8(cy), known, ay)
                mz, az = fma8(splat8(cz), weight, mz), fma8(splat8(cz), known, az)
                v = fma8(splat8(c * c), variance, v)
                vy, vz = fma8(splat8(c * cy), variance, vy), fma8(splat8(c * cz), variance, vz)
        f = load8(factors)
        s, ff = times8(f, load8(slopes)), times8(f, f)
        out[0, q] += scale * sum8(times8(s, m))
        out[1, q] += scale * sum8(times8(f, my))
        out[2, q] += scale * sum8(times8(f, mz))
        out[3, q] += twice * scale * sum8(times8(times8(f, s), v))
        out[4, q] += twice * scale * sum8(times8(ff, vy))
        out[5, q] += twice * scale * sum8(times8(ff, vz))
        out[6, q] += scale * sum8(times8(s, a))
        out[7, q] += scale * sum8(times8(f, ay))
        out[8, q] += scale * sum8(times8(f, az))
