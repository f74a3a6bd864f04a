"""A tile as bytes on the disk: bit for bit what it was, and compact.

head     what the tile is: its index, revision, stamp, and how many rows and kernels follow
body     the arrays, column by column, each number's bytes apart (all first bytes, then all second ones); then, if a tile has a
         lean or news, the lean's numbers of nodes (0 without one) and its nodes, and the news; deflated: what is alike in a
         column, such as the widths of a lattice's kernels or their places on it, then takes next to nothing
seal     of head and body
"""

from __future__ import annotations

import struct
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potserver.domain.tiles import CARRIED, MapKernels, Tile, TileGrid, TileIndex, voxels_along
from potserver.domain.types import KERNEL_ARRAYS, KernelSet
from potserver.errors import MapFileError, ShapeError
from potserver.numerics.evidence import KINDS, SCALES, Rows
from potserver.numerics.lean import resampled
from potserver.storage.seal import sealed, unsealed

_HEAD = struct.Struct("<3i2q2I")  # index, revision, stamp_ns, rows, kernels
_LEAN = struct.Struct("<3B")  # nodes along x, y, z
_MOST_LEAN_BYTES = 2**21 + _LEAN.size  # more than any tile's; of nodes
_LEVEL = 1  # of deflate: the higher ones cost ten times as much for a few per cent


class _Column(NamedTuple):
    name: str
    dtype: str  # little-endian
    width: int  # numbers a row; 0: one, and no second axis


# Voxels are numbered within their tile, which has at most 2**14 along an edge.
_ROWS = (
    _Column("voxel", "<i2", 3),
    _Column("kind", "|u1", 0),
    _Column("sums", "<f4", 4),
    _Column("source", "<i2", 0),
)
_KERNELS = (
    _Column("hinge_mean", "<f8", 3),
    _Column("hinge_var", "<f4", 3),
    _Column("gamma_shape", "<f4", 0),
    _Column("gamma_rate", "<f4", 0),
    _Column("weight_mean", "<f4", 0),
    _Column("weight_var", "<f4", 0),
)
_NEWS = _Column("news", "<f4", 0)
_MAP_KERNELS = (_Column("level", "|i1", 0), _Column("prior_mean", "<f4", 0), _Column("prior_var", "<f4", 0))


def encode_tile(index: TileIndex, tile: Tile) -> bytes:
    """A tile whose arrays are as `Region.tiles` cuts them."""
    rows, kernels = tile.rows, tile.kernels
    columns = [
        *(_planes(getattr(rows, c.name), c) for c in _ROWS),
        *(_planes(getattr(kernels.kernels, c.name), c) for c in _KERNELS),
        *(_planes(getattr(kernels, c.name), c) for c in _MAP_KERNELS),
    ]
    if tile.lean is not None:
        columns.append(_LEAN.pack(*tile.lean.shape) + tile.lean.tobytes())
    if tile.news is not None:
        columns += [
            b"" if tile.lean is not None else _LEAN.pack(0, 0, 0),
            _planes(tile.news.reshape(-1), _NEWS),
        ]
    head = _HEAD.pack(*index, tile.revision, tile.stamp_ns, len(rows.kind), len(kernels))
    body = zlib.compress(b"".join(columns), _LEVEL)
    return sealed(head + body)


def decode_tile(data: bytes, grid: TileGrid, n_robots: int) -> tuple[TileIndex, Tile]:
    """The tile in `data`, and where it belongs.

    Args:
        data: As `encode_tile` made it.
        grid: Of the map.
        n_robots: Of the map; rows name their robot by its number.
    Raises:
        MapFileError: the bytes are damaged, or no tile of such a map.
    """
    content = unsealed(data)
    if content is None or len(content) < _HEAD.size:
        raise MapFileError("a tile's checksum does not fit its content", reason="damaged")
    x, y, z, revision, stamp_ns, n_rows, n_kernels = _HEAD.unpack_from(content)
    sizes = [(c, n_rows) for c in _ROWS] + [(c, n_kernels) for c in (*_KERNELS, *_MAP_KERNELS)]
    n_bytes = sum(n * max(1, c.width) * np.dtype(c.dtype).itemsize for c, n in sizes)
    try:
        inflate = zlib.decompressobj()
        # one byte more would show that there is more
        most = n_bytes + _MOST_LEAN_BYTES + _news_bytes(grid)
        plain = inflate.decompress(content[_HEAD.size :], most + 1)
        beside = _beside(plain[n_bytes:], grid)
        if len(plain) < n_bytes or not inflate.eof or beside is None:
            raise MapFileError(f"tile {(x, y, z)} is not of the size that it says", reason="damaged")
        lean, news = beside
        arrays, start = {}, 0
        for column, n in sizes:
            arrays[column.name], start = _numbers(plain, start, column, n)
        tile = Tile(
            Rows(
                arrays["voxel"].astype(np.int32),
                arrays["kind"],
                arrays["sums"],
                arrays["source"],
            ),
            MapKernels(
                kernels=KernelSet(**{name: arrays[name] for name in KERNEL_ARRAYS}),
                **{c.name: arrays[c.name] for c in _MAP_KERNELS},
            ),
            revision,
            stamp_ns,
            resampled(lean, grid.lean_nodes)
            if lean is not None and lean.shape == grid.former_lean_nodes
            else lean,
            news,
        )
    except (zlib.error, ShapeError) as error:
        raise MapFileError(f"tile {(x, y, z)}: {error}", reason="damaged") from error
    _check(tile, grid, n_robots, (x, y, z))
    return (x, y, z), tile


def _check(tile: Tile, grid: TileGrid, n_robots: int, index: TileIndex) -> None:
    """A sound checksum does not say who wrote the file."""
    rows, kernels = tile.rows, tile.kernels
    edge = voxels_along(rows, grid)
    sound = (
        ((rows.voxel >= 0) & (rows.voxel < edge)).all()
        and np.isin(rows.sort, KINDS).all()
        and (rows.scale < SCALES).all()
        and np.isfinite(rows.sums).all()
        and ((rows.source >= 0) & (rows.source < n_robots)).all()
        and ((kernels.level >= 0) & (kernels.level < CARRIED + SCALES)).all()
        and np.isfinite(kernels.prior_mean).all()
        and (np.isfinite(kernels.prior_var) & (kernels.prior_var > 0)).all()
        and (tile.lean is None or tile.lean.shape == grid.lean_nodes)
        and (tile.news is None or bool((tile.news >= 0.0).all() and (tile.news < np.inf).all()))
    )
    if not sound:
        raise MapFileError(f"tile {index} has rows or kernels that no map makes", reason="damaged")


def _news_bytes(grid: TileGrid) -> int:
    return 2 * grid.blocks**3 * np.dtype(_NEWS.dtype).itemsize


def _beside(
    data: bytes, grid: TileGrid
) -> tuple[NDArray[np.uint8] | None, NDArray[np.float32] | None] | None:
    """The lean and the news in what follows a tile's columns, each None where the tile has none; None: it is neither."""
    if not data:
        return None, None
    if len(data) < _LEAN.size:
        return None
    shape = _LEAN.unpack_from(data)
    n_nodes = shape[0] * shape[1] * shape[2]
    rest = data[_LEAN.size + n_nodes :]
    if len(data) < _LEAN.size + n_nodes or len(rest) not in (0, _news_bytes(grid)):
        return None
    if min(shape) < 2 and not (max(shape) == 0 and rest):
        return None
    lean: NDArray[np.uint8] | None = None
    if n_nodes:
        lean = np.frombuffer(data, np.uint8, n_nodes, _LEAN.size).reshape(shape).copy()
    if not rest:
        return lean, None
    news, _ = _numbers(rest, 0, _NEWS, 2 * grid.blocks**3)
    return lean, news.reshape(2, grid.blocks, grid.blocks, grid.blocks)


def _planes(array: NDArray[Any], column: _Column) -> bytes:
    """An array's bytes, number by number within a row and byte by byte within a number, each over all rows."""
    little = np.ascontiguousarray(array, column.dtype)
    if not len(little):
        return b""
    return bytes(little.reshape(len(little), -1).view(np.uint8).T.tobytes())


def _numbers(plain: bytes, start: int, column: _Column, n: int) -> tuple[NDArray[Any], int]:
    dtype = np.dtype(column.dtype)
    width = max(1, column.width)
    n_bytes = n * width * dtype.itemsize
    planes = np.frombuffer(plain, np.uint8, n_bytes, start).reshape(width * dtype.itemsize, n)
    array = planes.T.copy().view(dtype)  # never a view: it would keep all of the tile's bytes
    return array.reshape((n, column.width) if column.width else n), start + n_bytes
