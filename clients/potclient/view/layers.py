"""What is shown of a map, tile by tile: its surface, its free space, and the edge of the unknown."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple, Protocol

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.cells import CellBox
from potclient.mesh import Mesh, mesh_of
from potclient.occupancy import Grid, surface_var
from potclient.watched import WatchedCloud
from potschemas import messages

TileIndex = tuple[int, int, int]

_FREE_BELOW = 0.25


class Picture(Protocol):
    """Where a map and what happens to it is shown. Not thread-safe."""

    def at(self, stamp_ns: int, revision: int | None = None) -> None:
        """What is told from now on happened then."""

    def draw_tile(self, tile: TileIndex, grid: Grid) -> None:
        """Show a tile as it is now, in the place of what was shown of it.

        Args:
            tile: Its number.
            grid: Its cells, and one more along each axis so that surfaces of neighbours meet.
        """

    def all_drawn(self) -> None:
        """Every tile has been shown as it is now."""

    def forget_tiles(self) -> None:
        """Show no tiles any more: the map was cleared or replaced."""

    def draw_cloud(self, cloud: WatchedCloud) -> bool:
        """Show a robot's scan; False if the cloud does not say where it was taken."""
        ...

    def draw_receipt(self, receipt: messages.Receipt) -> None:
        """Show what became of a cloud."""

    def draw_stats(self, stats: messages.Stats, map_id: str) -> None:
        """Show a server's own numbers."""


class Layers(NamedTuple):
    """What is shown of one tile, in the map frame."""

    mesh: Mesh  # where the probability is one half; of a planar map no faces, and the centres of occupied cells as vertices
    free: Float64  # (N, 3) m, centres of free cells
    unknown: Float64  # (M, 3) m, centres of unknown cells beside free ones


def layers_of(grid: Grid) -> Layers:
    """The layers of a tile.

    Raises:
        UsageError: scikit-image is missing, and the map is not planar.
    """
    free = grid.observed & (grid.mean < _FREE_BELOW)
    unknown = ~grid.observed & _beside(free)
    if grid.shape[2] > 1:
        return Layers(mesh_of(grid), _centres(grid, free), _centres(grid, unknown))
    occupied = grid.observed & (grid.mean >= 0.5)
    sd = np.sqrt(surface_var(grid, occupied)).astype(np.float32)
    mesh = Mesh(_centres(grid, occupied).astype(np.float32), np.zeros((0, 3), np.int64), sd)
    return Layers(mesh, _centres(grid, free), _centres(grid, unknown))


def tile_box(tile: TileIndex, size_m: float, resolution: float, layer_m: float | None) -> CellBox:
    """The cells of a tile and one more along each axis; of a planar map, those of its layer."""
    low = np.asarray(tile, np.float64) * size_m
    box = CellBox.around(low, low + size_m, resolution)
    if layer_m is None:
        return box._replace(stop=box.stop + 1)
    flat = CellBox.around([0, 0, layer_m], [0, 0, layer_m], resolution)
    first, stop = box.first.copy(), box.stop.copy()
    first[2], stop[2] = flat.first[2], flat.stop[2]
    return box._replace(first=first, stop=stop, raised_m=flat.raised_m)


def tiles_between(lower: Iterable[float], upper: Iterable[float], size_m: float) -> list[TileIndex]:
    """The numbers of all tiles that a box (m, map frame) meets."""
    spans = [
        range(math.floor(a / size_m), math.floor(b / size_m) + 1) for a, b in zip(lower, upper, strict=True)
    ]
    return [(x, y, z) for x in spans[0] for y in spans[1] for z in spans[2]]


def _centres(grid: Grid, cells: Bool) -> Float64:
    centres: Float64 = np.asarray(grid.lower, np.float64) + (np.argwhere(cells) + 0.5) * grid.resolution
    return centres


def _beside(cells: Bool) -> Bool:
    """Which cells share a face with one of these."""
    grown = np.zeros_like(cells)
    for axis in range(3):
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        grown[tuple(ahead)] |= cells[tuple(behind)]
        grown[tuple(behind)] |= cells[tuple(ahead)]
    return grown
