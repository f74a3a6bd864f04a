"""All bricks of a map, found by the place of a window. Parts keep their bricks, so a new map costs a line a brick."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, NoReturn

import numba as nb
import numpy as np

from potserver.numerics.arrays import Float64, Int64
from potserver.numerics.bricks import (
    BYTES_OF_ROW,
    HALO,
    ROWS,
    STARTS,
    WINDOW,
    Lattice,
    LatticeBricks,
    bricks_along,
)
from potserver.numerics.simd import load_f64, load_i32, load_i64, store_i64
from potserver.numerics.voxel_hash import empty_table

_BYTES_OF_NUMBERS = 2 * ROWS**2  # of the rows of a brick
_REACH = WINDOW // 2  # spacings: farther nodes are in no window


class BrickTable(NamedTuple):
    """Addresses of what compiled code reads; whoever hands it on keeps the `BrickMap` alive."""

    n_lattices: int
    lattices: int  # a record of float64 each, see `_LATTICE`
    bricks: int  # a record of int64 each, see `_BRICK`
    table: int  # hash of the bricks' places, int32
    mask: int  # entries of the hash less one


# Fields of the records, at these bytes from their start.
_LATTICE = ("nodes_a_metre", "phase_x", "phase_y", "phase_z", "fall", "width", "lower_x", "lower_y", "lower_z", "upper_x",
            "upper_y", "upper_z", "nodes", "parts_a_node", "count_x", "count_y", "count_z", "is_plane")  # fmt: skip
_BRICK = ("lattice", "x", "y", "z", "rows", "row_of", "layers", "unused")  # 64 bytes, a line of the cache


class BrickMap:
    """The bricks of a map. Never changes; any number of threads may ask it."""

    def __init__(self, bricks: Iterable[LatticeBricks]) -> None:
        """Find places for the bricks of all parts of a map."""
        self._bricks = list(bricks)  # kept alive: the table has their addresses
        self.n_bytes = sum(found.rows.nbytes + found.row_of.nbytes for found in self._bricks)
        self._n_kernels = sum(found.n_kernels for found in self._bricks)
        by_lattice: dict[Lattice, list[LatticeBricks]] = {}
        for found in self._bricks:
            by_lattice.setdefault(found.lattice, []).append(found)
        # sorted: sums are the same to the bit whichever part came first
        self._groups = sorted(by_lattice.items(), key=lambda item: _order(item[0]))
        self._lattices = _lattice_records(self._groups)
        self._records = _brick_records([group for _, group in self._groups])
        self._hash = empty_table(len(self._records))
        _enter_all(self._records, self._hash)
        self.table = BrickTable(
            n_lattices=len(self._lattices),
            lattices=self._lattices.ctypes.data,
            bricks=self._records.ctypes.data,
            table=self._hash.ctypes.data,
            mask=len(self._hash) - 1,
        )

    def __len__(self) -> int:
        """Kernels."""
        return self._n_kernels

    def __reduce__(self) -> NoReturn:
        raise TypeError("a BrickMap holds addresses of this process: send the kernels")

    @property
    def widths(self) -> tuple[Float64, Int64]:
        """The kernels' widths, sqrt(pi / (2 gamma)) in m, one a lattice; and how many kernels have it."""
        counts = [sum(found.n_kernels for found in group) for _, group in self._groups]
        return self._lattices[:, _LATTICE.index("width")], np.array(counts, np.int64)


def _order(lattice: Lattice) -> tuple[float, ...]:
    return (lattice.spacing_m, lattice.gamma, *(lattice.plane or ()))


def _lattice_records(groups: list[tuple[Lattice, list[LatticeBricks]]]) -> Float64:
    records = [_lattice_record(lattice, group) for lattice, group in groups]
    return np.array(records, np.float64).reshape(-1, len(_LATTICE))


def _lattice_record(lattice: Lattice, bricks: list[LatticeBricks]) -> list[float]:
    spacing = lattice.spacing_m
    phase = np.full(3, 0.5)
    if lattice.plane is not None:
        part, height = lattice.plane
        phase[2] = (part * lattice.edge_m + height) / spacing
    return [
        1.0 / spacing,
        *phase,
        lattice.gamma * spacing**2,
        math.sqrt(0.5 * math.pi / lattice.gamma),
        *(np.array([found.lower for found in bricks]).min(axis=0) - _REACH * spacing),
        *(np.array([found.upper for found in bricks]).max(axis=0) + _REACH * spacing),
        lattice.nodes,
        1.0 / lattice.nodes,
        *bricks_along(lattice.nodes),
        lattice.plane is not None,
    ]


def _brick_records(groups: list[list[LatticeBricks]]) -> Int64:
    """A record a brick of all groups, in order. At once: a kilometre has hundreds of parts, and each scan makes a new map."""
    parts = [(number, found) for number, group in enumerate(groups) for found in group]
    counts = [len(found.first) for _, found in parts]
    records = np.zeros((sum(counts), len(_BRICK)), np.int64)
    if not parts:
        return records
    # of each part: the number of its lattice, where its rows are, and where their numbers
    of_part = np.array(
        [(n, found.rows.ctypes.data, found.row_of.ctypes.data) for n, found in parts], np.int64
    )
    lattice, rows, row_of = np.repeat(of_part, counts, axis=0).T
    in_part = np.arange(len(records)) - np.repeat(np.cumsum(counts) - counts, counts)
    first = np.concatenate([found.first for _, found in parts])
    records[:, 0] = lattice
    records[:, 1:4] = np.concatenate([found.place for _, found in parts])
    records[:, 4], records[:, 5] = rows + first * BYTES_OF_ROW, row_of + in_part * _BYTES_OF_NUMBERS
    records[:, 6] = np.concatenate([found.layers for _, found in parts])
    return records


LATTICE_BYTES, _BRICK_BYTES = 8 * len(_LATTICE), 8 * len(_BRICK)
NODES_A_METRE, PHASE, FALL, WIDTH, LOWER, UPPER, _NODES, _PARTS_A_NODE, _COUNTS, _IS_PLANE = (
    8 * _LATTICE.index(name)
    for name in (
        "nodes_a_metre",
        "phase_x",
        "fall",
        "width",
        "lower_x",
        "upper_x",
        "nodes",
        "parts_a_node",
        "count_x",
        "is_plane",
    )
)
BRICK_ROWS, BRICK_ROW_OF, BRICK_LAYERS = (8 * _BRICK.index(name) for name in ("rows", "row_of", "layers"))
# of a window, see `find_windows`
WINDOW_BYTES = 64
AT_BRICK, AT_LANE, AT_Y, AT_Z, FROM_Y, TO_Y, FROM_Z, TO_Z = range(0, WINDOW_BYTES, 8)

_jit = nb.njit(nogil=True, error_model="numpy", cache=True)


@_jit
def _hashed(lattice, x, y, z):
    h = (x * np.int64(0x1F123BB5)) ^ (y * np.int64(0x2545F491)) ^ (z * np.int64(0x3C6EF372)) ^ (lattice << 40)
    h ^= h >> 29
    h *= np.int64(0x7FB5D329728EA185)
    return h ^ (h >> 32)


@_jit
def _enter_all(bricks, table):
    mask = len(table) - 1
    for e in range(len(bricks)):
        at = _hashed(bricks[e, 0], bricks[e, 1], bricks[e, 2], bricks[e, 3]) & mask
        while table[at] >= 0:
            at = (at + 1) & mask
        table[at] = e


@_jit
def _find(t, lattice, x, y, z):
    """The address of a brick's record; 0 where there is no such brick."""
    at = _hashed(lattice, x, y, z) & t.mask
    while True:
        number = load_i32(t.table + 4 * at)
        if number < 0:
            return 0
        brick = t.bricks + _BRICK_BYTES * number
        if (
            load_i64(brick + 8) == x
            and load_i64(brick + 16) == y
            and load_i64(brick + 24) == z
            and load_i64(brick) == lattice
        ):
            return brick
        at = (at + 1) & t.mask


@_jit
def _along(start, nodes, parts_a_node, is_plane):
    """Where the window of nodes that begins at node `start` lies along one axis.

    Returns:
        part: The one of the first node.
        at: Place of the window in it, counted from `HALO` before its first node: brick `at // starts`, row `at % starts`.
        inside: Nodes of the window in this part; those that are left begin the next part.
    """
    if is_plane:
        return np.int64(0), start + HALO, WINDOW
    part = np.int64(np.floor((start + 0.5) * parts_a_node))  # far faster than a division of integers
    return part, start - part * nodes + HALO, min(nodes * (part + 1) - start, WINDOW)


@_jit
def find_windows(t, lattice, start_x, start_y, start_z, found):
    """The bricks with the nodes of a window.

    Args:
        t: A BrickTable.
        lattice: Its number.
        start_x, start_y, start_z: The first node.
        found: Address of room for eight records of int64. Each gets a brick (address of its record), the window's first node in
            a row, its first row along y and along z, and from which to which node of the window along y and along z.
    Returns:
        The number of records.
    """
    own = t.lattices + LATTICE_BYTES * lattice
    nodes, is_plane = np.int64(load_f64(own + _NODES)), load_f64(own + _IS_PLANE) > 0.0
    if is_plane and not -HALO <= start_z <= 0:
        return 0
    each = load_f64(own + _PARTS_A_NODE)
    count_x, count_y = np.int64(load_f64(own + _COUNTS)), np.int64(load_f64(own + _COUNTS + 8))
    count_z = np.int64(load_f64(own + _COUNTS + 16))
    part_x, at_x, in_x = _along(start_x, nodes, each, False)
    part_y, at_y, in_y = _along(start_y, nodes, each, False)
    part_z, at_z, in_z = _along(start_z, nodes, each, is_plane)
    n = 0
    for x in range(2 if in_x < WINDOW else 1):
        ax = at_x - x * nodes
        bx = (part_x + x) * count_x + ax // STARTS[0]
        for y in range(2 if in_y < WINDOW else 1):
            ay = at_y - y * nodes
            by = (part_y + y) * count_y + ay // STARTS[1]
            for z in range(2 if in_z < WINDOW else 1):
                az = at_z - z * nodes
                brick = _find(t, lattice, bx, by, (part_z + z) * count_z + az // STARTS[2])
                if brick:
                    at = found + WINDOW_BYTES * n
                    store_i64(at + AT_BRICK, brick)
                    store_i64(at + AT_LANE, ax % STARTS[0])
                    store_i64(at + AT_Y, ay % STARTS[1])
                    store_i64(at + AT_Z, az % STARTS[2])
                    store_i64(at + FROM_Y, in_y if y else 0)
                    store_i64(at + TO_Y, WINDOW if y else in_y)
                    store_i64(at + FROM_Z, in_z if z else 0)
                    store_i64(at + TO_Z, WINDOW if z else in_z)
                    n += 1
    return n
