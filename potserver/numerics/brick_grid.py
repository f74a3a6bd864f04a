"""Sums over the kernels of bricks at the cells of a grid, which share factors along a column of cells: see `bricks`.

Along a column only one coordinate changes. So the nodes about it are summed over the other two first, to three numbers a node
of the column, and each cell then sums over six of those. Columns run along z, or along y in a grid of one layer.
"""

from __future__ import annotations

from typing import NamedTuple

import numba as nb
import numpy as np

from potschemas.answers import LatentSums
from potserver.numerics.arrays import Float32, Float64, Int64
from potserver.numerics.brick_map import (
    AT_BRICK,
    AT_LANE,
    AT_Y,
    AT_Z,
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
    WINDOW_BYTES,
    BrickMap,
    find_windows,
)
from potserver.numerics.brick_sums import (
    BYTES_OF_AXIS,
    FACTORS,
    SPARE,
    TO_KNOWN,
    TO_VARIANCES,
    WINDOWS,
    room_for_a_thread,
    set_factors,
)
from potserver.numerics.bricks import BEFORE, BYTES_OF_ROW, ROWS, WINDOW
from potserver.numerics.fastexp import exp32
from potserver.numerics.simd import (
    fma8,
    load8,
    load_f32,
    load_f64,
    load_i16,
    load_i64,
    splat8,
    store8,
    sum8,
    times8,
)
from potserver.numerics.threads import parallel_map, spans

_X, _Y, _Z = 0, 1, 2
_jit = nb.njit(nogil=True, error_model="numpy", cache=True)


class Cells(NamedTuple):
    """A grid of cells, map frame; their centres are asked."""

    lower: Float64  # (3,) m
    resolution: float  # m
    shape: tuple[int, int, int]  # cells along x, y and z


class _Columns(NamedTuple):
    """How a grid is walked through."""

    along: int  # axis of the columns
    across: int  # the other axis but x
    n_across: int  # cells along it
    first: int  # cell of the column that is asked first, and the one behind the last
    last: int


class _Taps(NamedTuple):
    """What the cells of a column sum of each lattice's nodes, the same in all columns."""

    start: Int64  # (L, M) first node
    factors: Float32  # (L, M, WINDOW, 4) for the weights, the variances and the known shares; the fourth is 0


def grid_sums(
    bricks: BrickMap, cells: Cells, first: int, last: int, *, threads: int = 1, lane: str = "map"
) -> LatentSums:
    """The sums of eq. 1 over all kernels in bricks, at a run of cells.

    Args:
        bricks: The kernels.
        cells: The grid.
        first, last: The run, in C order of (x, y, z); `last` is behind it.
        threads, lane: See `kernel_index.latent_sums`.
    Returns:
        float32.
    """
    out = np.zeros((3, last - first), np.float32)
    along, across = (_Z, _Y) if cells.shape[_Z] > 1 else (_Y, _Z)
    length = cells.shape[along]
    low, high = first // length, (last - 1) // length + 1  # of the columns
    inner = (first % length, (last - 1) % length + 1) if high - low == 1 else (0, length)
    if len(bricks) == 0 or last == first:
        return LatentSums(*out)
    columns = _Columns(along, across, cells.shape[across], *inner)
    lower = np.array(cells.lower, np.float64)  # a copy: see `kernel_map.as_points`
    taps = _taps(bricks.table, columns, lower, cells.resolution)
    parallel_map(
        lambda span: _sum_columns(
            bricks.table, columns, taps, lower, cells.resolution, length, first, low + span[0], low + span[1],
            room_for_a_thread(), out,
        ),
        spans(high - low, 4 * threads if threads > 1 else 1), threads, lane,
    )  # fmt: skip
    return LatentSums(*out)


@_jit
def _taps(t, columns, lower, resolution):
    m = columns.last - columns.first
    start = np.empty((t.n_lattices, m), np.int64)
    factors = np.zeros((t.n_lattices, m, WINDOW, 4), np.float32)
    for number in range(t.n_lattices):
        lattice = t.lattices + LATTICE_BYTES * number
        scale = load_f64(lattice + NODES_A_METRE)
        phase, fall = load_f64(lattice + PHASE + 8 * columns.along), np.float32(load_f64(lattice + FALL))
        for p in range(m):
            u = (lower[columns.along] + (columns.first + p + 0.5) * resolution) * scale - phase
            start[number, p] = np.int64(np.floor(u)) - BEFORE
            for k in range(WINDOW):
                distance = np.float32(u - start[number, p] - k)
                f = exp32(-fall * distance * distance)
                factors[number, p, k, 0], factors[number, p, k, 1], factors[number, p, k, 2] = f, f * f, f
    return _Taps(start, factors)


@_jit
def _sum_columns(t, columns, taps, lower, resolution, length, first, low, high, room, out):
    """Fill in columns low to high of a grid; `out` begins at cell `first`."""
    most = 0
    for number in range(t.n_lattices):
        most = max(most, taps.start[number, -1] - taps.start[number, 0])
    nodes = np.empty((most + 3 * WINDOW, 4), np.float32)
    for column in range(low, high):
        x = lower[_X] + (column // columns.n_across + 0.5) * resolution
        w = lower[columns.across] + (column % columns.n_across + 0.5) * resolution
        begin = max(first - column * length, columns.first)
        end = min(first + out.shape[1] - column * length, columns.last)
        for number in range(t.n_lattices):
            start = taps.start[number]
            a, b = begin - columns.first, end - columns.first
            n = start[b - 1] + WINDOW - start[a]
            if not _sum_nodes(t, number, columns.along, x, w, start[a], n, room.ctypes.data, nodes):
                continue
            for p in range(a, b):
                cell = column * length + columns.first + p - first
                node = nodes.ctypes.data + 16 * (start[p] - start[a])
                tap = taps.factors.ctypes.data + 16 * WINDOW * (number * taps.start.shape[1] + p)
                s = times8(load8(tap), load8(node))
                s = fma8(load8(tap + 32), load8(node + 32), s)
                store8(room.ctypes.data + SPARE, fma8(load8(tap + 64), load8(node + 64), s))
                for c in range(3):
                    at = room.ctypes.data + SPARE + 4 * c
                    out[c, cell] += load_f32(at) + load_f32(at + 16)


@_jit
def _sum_nodes(t, number, along, x, w, start, n, room, nodes):
    """Sum the nodes about a line over x and the axis across; false where there are none.

    Args:
        t: A BrickTable.
        number: Of the lattice.
        along: Axis of the line.
        x, w: m, of the line along x and along the axis across.
        start, n: The nodes along the line that are wanted.
        room: Of a thread.
        nodes: (n + 2 WINDOW at least, 4), filled from its start on.
    """
    lattice = t.lattices + LATTICE_BYTES * number
    across = _Y + _Z - along
    if not (
        (load_f64(lattice + LOWER) <= x <= load_f64(lattice + UPPER))
        and (load_f64(lattice + LOWER + 8 * across) <= w <= load_f64(lattice + UPPER + 8 * across))
    ):
        return False
    scale = load_f64(lattice + NODES_A_METRE)
    u, v = x * scale - load_f64(lattice + PHASE), w * scale - load_f64(lattice + PHASE + 8 * across)
    i, j = np.int64(np.floor(u)) - BEFORE, np.int64(np.floor(v)) - BEFORE
    set_factors(lattice, u - i, _X, room)
    set_factors(lattice, v - j, across, room)
    of_x, of_across = load8(room + FACTORS), room + FACTORS + across * BYTES_OF_AXIS
    along_z = along == _Z
    step_along, step_across = (2 * ROWS, 2) if along_z else (2, 2 * ROWS)
    from_along, to_along = (FROM_Z, TO_Z) if along_z else (FROM_Y, TO_Y)
    from_across, to_across = (FROM_Y, TO_Y) if along_z else (FROM_Z, TO_Z)
    nodes[: n + 2 * WINDOW] = 0
    any_there = False
    for shift in range(0, n, WINDOW):
        begin = start + shift
        for line in range(
            find_windows(t, number, i, j if along_z else begin, begin if along_z else j, room + WINDOWS)
        ):
            window = room + WINDOWS + WINDOW_BYTES * line
            brick = load_i64(window + AT_BRICK)
            rows = load_i64(brick + BRICK_ROWS) + 4 * load_i64(window + AT_LANE)
            first = load_i64(brick + BRICK_ROW_OF) + 2 * (
                load_i64(window + AT_Z) * ROWS + load_i64(window + AT_Y)
            )
            any_there = True
            for k in range(load_i64(window + from_along), load_i64(window + to_along)):
                weight = variance = known = splat8(np.float32(0))
                for c in range(load_i64(window + from_across), load_i64(window + to_across)):
                    row = rows + BYTES_OF_ROW * load_i16(first + step_along * k + step_across * c)
                    f = load_f32(of_across + 4 * c)
                    weight = fma8(splat8(f), load8(row), weight)
                    variance = fma8(splat8(f * f), load8(row + TO_VARIANCES), variance)
                    known = fma8(splat8(f), load8(row + TO_KNOWN), known)
                nodes[shift + k, 0] += sum8(times8(of_x, weight))
                nodes[shift + k, 1] += sum8(times8(times8(of_x, of_x), variance))
                nodes[shift + k, 2] += sum8(times8(of_x, known))
    return any_there
