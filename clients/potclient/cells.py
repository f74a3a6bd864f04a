"""Boxes of cells, and the map asked for them part by part, so that a box may be larger than one answer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arrays import Float64
from potclient.errors import UsageError
from potclient.kernels import KernelSet
from potclient.occupancy import Grid
from potschemas import messages

Int64 = NDArray[np.int64]
Progress = Callable[[int, int], None]  # (parts done, parts in all)

_TILE_CELLS = 250_000  # of one question, at most
_FLAT_M = 1e-3  # hinges of a planar map differ by rounding alone


class MapSource(Protocol):
    """Where files are made from: a `MapClient`, or a map that is not served but answers like one."""

    def info(self) -> messages.Info: ...
    def params_parts(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None
    ) -> Iterator[tuple[int, int, KernelSet]]: ...
    def grid(self, lower: ArrayLike, upper: ArrayLike, resolution: float) -> Grid: ...


class CellBox(NamedTuple):
    """A box of cells; cell (i, j, k) spans [i, i + 1] x [j, j + 1] x [k, k + 1] times the resolution, in the map frame."""

    first: Int64  # (3,)
    stop: Int64  # (3,) one past the last
    resolution: float  # m
    raised_m: float = 0.0  # the cells are asked for this much above their centres

    @classmethod
    def around(cls, lower: ArrayLike, upper: ArrayLike, resolution: float) -> CellBox:
        """The cells that a box (m, map frame) meets; a flat box has one layer, asked for at its height.

        Raises:
            UsageError: corners that are not finite, or an upper one below the lower one.
        """
        low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if (
            low.shape != (3,)
            or high.shape != (3,)
            or not np.isfinite([low, high]).all()
            or (high < low).any()
        ):
            raise UsageError(f"box from {low.tolist()} to {high.tolist()}: need x y z, lower below upper")
        # a millionth of slack, so that a box of whole cells has no more than those
        first = np.floor(low / resolution + 1e-6).astype(np.int64)
        stop = np.ceil(high / resolution - 1e-6).astype(np.int64)
        is_flat = low[2] == high[2]
        raised_m = float(low[2] - (first[2] + 0.5) * resolution) if is_flat else 0.0
        return cls(first, np.maximum(stop, first + 1), resolution, raised_m)

    def centres(self) -> tuple[Float64, Float64, Float64]:
        """(nx,), (ny,), (nz,) m: the middles of the cells along each axis, as they are asked for."""
        x, y, z = (
            (np.arange(first, stop) + 0.5) * self.resolution
            for first, stop in zip(self.first.tolist(), self.stop.tolist(), strict=True)
        )
        return x, y, z + self.raised_m

    def tiles(self, max_cells: int = _TILE_CELLS) -> list[CellBox]:
        """Parts of at most so many cells, cut at multiples of a power of two, where an octree cuts too."""
        shape = self.stop - self.first
        edge = 1
        while (2 * edge) ** 2 * min(2 * edge, int(shape[2])) <= max_cells:
            edge *= 2
        if edge * edge * min(edge, int(shape[2])) > max_cells:
            raise UsageError(f"a question of {max_cells} cells is too small for a tile")
        cuts = [
            np.unique([first, *range(-(-first // edge) * edge, stop, edge), stop])
            for first, stop in zip(self.first.tolist(), self.stop.tolist(), strict=True)
        ]
        return [
            self._replace(first=np.array([x, y, z]), stop=np.array([x2, y2, z2]))
            for x, x2 in zip(cuts[0][:-1], cuts[0][1:], strict=True)
            for y, y2 in zip(cuts[1][:-1], cuts[1][1:], strict=True)
            for z, z2 in zip(cuts[2][:-1], cuts[2][1:], strict=True)
        ]


def grids(
    source: MapSource,
    box: CellBox,
    progress: Progress | None = None,
    wanted: Callable[[CellBox], bool] | None = None,
) -> Iterator[tuple[CellBox, Grid]]:
    """The box, tile by tile; only those that are wanted."""
    tiles = box.tiles(min(_TILE_CELLS, source.info().limits.max_grid_cells))
    for done, tile in enumerate(tiles, 1):
        if wanted is None or wanted(tile):
            yield tile, grid_of(source, tile)
        if progress is not None:
            progress(done, len(tiles))


def grid_of(source: MapSource, box: CellBox) -> Grid:
    """The cells of a box of at most one answer.

    Raises:
        UsageError: other cells came.
        PotclientError: see `MapClient.grid`.
    """
    raised = np.array([0.0, 0.0, box.raised_m])
    lower, upper = (corner * box.resolution + raised for corner in (box.first, box.stop))
    grid = source.grid(lower, upper, box.resolution)
    if grid.shape != tuple((box.stop - box.first).tolist()):
        raise UsageError(f"a grid of {grid.shape} cells came for {(box.stop - box.first).tolist()}")
    return grid


def bounds_of(source: MapSource) -> tuple[Float64, Float64]:
    """The corners of the box of all hinges, m, map frame.

    Raises:
        UsageError: the map is empty.
    """
    info = source.info()
    if info.lower is None or info.upper is None:
        raise UsageError("the map is empty; publish something first, or give --lower and --upper")
    return np.asarray(info.lower, np.float64), np.asarray(info.upper, np.float64)


def layer_of(source: MapSource) -> float | None:
    """The height of a planar map's one layer, m; None of a map that has a height.

    Raises:
        UsageError: the map is empty.
    """
    low, high = bounds_of(source)
    return float(low[2] + high[2]) / 2 if high[2] - low[2] < _FLAT_M else None
