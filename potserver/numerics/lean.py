"""The lean of a map, compiled: `potschemas.lean` at points.

A table has the address of each tile's nodes, found by a hash of the tile's index.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, NoReturn

import numba as nb
import numpy as np
from numpy.typing import NDArray

from potschemas.lean import LEAN_UNIT, LEAN_ZERO, LeanTiles
from potserver.errors import ShapeError
from potserver.numerics.arrays import Float32, Float64, UInt8
from potserver.numerics.simd import load_i8, load_i32, load_i64
from potserver.numerics.threads import parallel_map, spans
from potserver.numerics.voxel_hash import empty_table

TileIndex = tuple[int, int, int]

_WORTH_THREADS = 8192  # points


class LeanTable(NamedTuple):
    """What compiled code reads; whoever hands it on keeps the `Lean` alive. Addresses, because arrays are counted at calls."""

    tiles: int  # of records of four int64: index x, y, z of a tile, and the address of its nodes
    table: int  # of a hash of the tiles' indices, int32
    mask: int  # entries of the hash less one
    cells_x: int  # between the nodes of a tile
    cells_y: int
    cells_z: int
    tiles_a_metre: float


class Lean:
    """The lean of some tiles. Never changes; any number of threads may ask it."""

    def __init__(self, tile_size_m: float, tiles: Mapping[TileIndex, UInt8]) -> None:
        """Enter the nodes of tiles, (X, Y, Z) bytes each.

        Raises:
            ShapeError: they are not all of one shape.
        """
        self.tile_size_m = tile_size_m
        self.tiles = {index: np.ascontiguousarray(nodes) for index, nodes in tiles.items()}  # kept alive
        shapes = {nodes.shape for nodes in self.tiles.values()} or {(2, 2, 2)}
        if len(shapes) > 1:
            raise ShapeError(f"the leans of tiles have nodes of several shapes: {sorted(shapes)}")
        nx, ny, nz = (n - 1 for n in shapes.pop())
        records = [(*index, _address(nodes)) for index, nodes in self.tiles.items()]
        self._records = np.array(records, np.int64).reshape(-1, 4)
        self._hash = empty_table(len(self._records))
        _enter_all(self._records, self._hash)
        self.table = LeanTable(
            _address(self._records), _address(self._hash), len(self._hash) - 1, nx, ny, nz, 1.0 / tile_size_m
        )

    @property
    def told(self) -> LeanTiles:
        """What of it travels."""
        return LeanTiles(self.tile_size_m, self.tiles)

    def __bool__(self) -> bool:
        return bool(self.tiles)

    def __reduce__(self) -> NoReturn:
        raise TypeError("a Lean holds addresses of this process: send its tiles")

    def with_tiles(self, changed: Mapping[TileIndex, UInt8 | None]) -> Lean:
        """The lean with some tiles exchanged, or without them; the same one if nothing is other than before."""
        news = {index: nodes for index, nodes in changed.items() if self.tiles.get(index) is not nodes}
        if not news:
            return self
        tiles = dict(self.tiles)
        for index, nodes in news.items():
            if nodes is None:
                tiles.pop(index, None)
            else:
                tiles[index] = nodes
        return Lean(self.tile_size_m, tiles)

    def at(self, points: Float64, *, threads: int = 1, lane: str = "map") -> Float32:
        """(N,) log-odds at (N, 3) points, m, map frame; NaN where there is none."""
        out = np.empty(len(points), np.float32)

        def run(span: tuple[int, int]) -> None:
            _lean_of_points(*span, points, self.table, out)

        n_spans = threads if len(points) >= _WORTH_THREADS else 1
        parallel_map(run, spans(len(points), n_spans), threads, lane)
        return out


def resampled(nodes: UInt8, shape: tuple[int, int, int]) -> UInt8:
    """A tile's lean, (X, Y, Z) bytes, as nodes of another lattice from corner to corner: interpolated as answers are."""
    found = nodes.astype(np.float64)
    for axis, n in enumerate(shape):
        at = np.linspace(0.0, nodes.shape[axis] - 1.0, n)
        low = np.minimum(at.astype(np.int64), nodes.shape[axis] - 2)
        share = np.expand_dims(at - low, [a for a in range(3) if a != axis])
        found = np.take(found, low, axis) * (1.0 - share) + np.take(found, low + 1, axis) * share
    out: UInt8 = np.rint(found).astype(np.uint8)
    return out


def _address(array: NDArray[Any]) -> int:
    return int(array.__array_interface__["data"][0])


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _hashed(x, y, z):
    h = (x * np.int64(0x1F123BB5)) ^ (y * np.int64(0x2545F491)) ^ (z * np.int64(0x3C6EF372))
    h ^= h >> 29
    h *= np.int64(0x7FB5D329728EA185)
    return h ^ (h >> 32)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _enter_all(records, table):
    mask = len(table) - 1
    for e in range(len(records)):
        at = _hashed(records[e, 0], records[e, 1], records[e, 2]) & mask
        while table[at] >= 0:
            at = (at + 1) & mask
        table[at] = e


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _nodes_of(t, x, y, z):
    """The address of a tile's nodes; 0 where it has none."""
    at = _hashed(x, y, z) & t.mask
    while True:
        number = load_i32(t.table + 4 * at)
        if number < 0:
            return np.int64(0)
        tile = t.tiles + 32 * number
        if load_i64(tile) == x and load_i64(tile + 8) == y and load_i64(tile + 16) == z:
            return load_i64(tile + 24)
        at = (at + 1) & t.mask


@nb.njit(nogil=True, error_model="numpy", cache=True)
def lean_of(table: LeanTable, x: float, y: float, z: float) -> np.float32:
    """Log-odds at one point, m, map frame; NaN where there is none."""
    px, py, pz = x * table.tiles_a_metre, y * table.tiles_a_metre, z * table.tiles_a_metre
    fx, fy, fz = np.floor(px), np.floor(py), np.floor(pz)
    address = _nodes_of(table, np.int64(fx), np.int64(fy), np.int64(fz))
    if address == 0:
        return np.float32(np.nan)
    nx, ny, nz = table.cells_x, table.cells_y, table.cells_z
    u, v, w = (px - fx) * nx, (py - fy) * ny, (pz - fz) * nz
    i, j, k = min(np.int64(u), nx - 1), min(np.int64(v), ny - 1), min(np.int64(w), nz - 1)
    u, v, w = u - i, v - j, w - k
    total = 0.0
    for p in range(2):
        of_x = u if p else 1.0 - u
        for q in range(2):
            of_y = v if q else 1.0 - v
            at = address + ((i + p) * (ny + 1) + j + q) * (nz + 1) + k
            low, high = np.float64(load_i8(at) & 255), np.float64(load_i8(at + 1) & 255)
            total += of_x * of_y * (low + w * (high - low))
    return np.float32((total - LEAN_ZERO) * LEAN_UNIT)


@nb.njit(nogil=True, error_model="numpy", cache=True)
def _lean_of_points(first, last, points, table, out):
    for q in range(first, last):
        out[q] = lean_of(table, points[q, 0], points[q, 1], points[q, 2])
