"""VoxelLayer: the map's free and occupied voxels, and the points where the probability crosses one half between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from potclient.arrays import Bool, Float32, Float64
from potclient.cells import CellBox
from potclient.client import MapClient
from potclient.occupancy import Grid, surface_var
from potclient.octomap import KEY_ORIGIN, Leaves, OcTreeBuilder
from potserver.ros.changes import Box, Change, changed_boxes
from potserver.ros.settings import RosSettings

Int64 = NDArray[np.int64]

_PART_CELLS = 250_000  # of one question
_ROUNDS = 3  # of regula falsi along an edge between voxels


class Crossings(NamedTuple):
    """Points of the surface."""

    cells: Int64  # (S, 3) the lower one of the two cells that a point lies between
    points: Float64  # (S, 3) m, map frame
    sd: Float32  # (S,) of the probability

    @classmethod
    def none(cls) -> Crossings:
        """No point."""
        return cls(np.zeros((0, 3), np.int64), np.zeros((0, 3)), np.zeros(0, np.float32))


class Voxels(NamedTuple):
    """Voxels of known state; voxel (i, j, k) begins at i, j, k times the resolution."""

    cells: Int64  # (V, 3)
    occupied: Bool  # (V,)

    @classmethod
    def none(cls) -> Voxels:
        """No voxel."""
        return cls(np.zeros((0, 3), np.int64), np.zeros(0, np.bool_))


class _Edges(NamedTuple):
    """Ways from a cell to the next one, on which the log-odds change their sign."""

    cells: Int64  # (S, 3) the lower cell
    start: Float64  # (S, 3) m, its centre
    step: Float64  # (S, 3) m, from there to the other centre
    low: Float32  # (S,) log-odds at the lower cell
    high: Float32  # (S,) and at the other


class VoxelLayer:
    """Voxels and surface as they were last computed."""

    def __init__(self, client: MapClient, settings: RosSettings) -> None:
        self._client, self._settings = client, settings
        self.voxels = Voxels.none()
        self.surface = Crossings.none()
        self._bounds: Box | None = None

    def update(self, change: Change) -> None:
        """Compute what changed.

        Raises:
            PotclientError: the map did not answer.
        """
        info = self._client.info()
        if change.tiles is None or self._bounds is None or info.lower is None:
            self.voxels, self.surface, self._bounds = Voxels.none(), Crossings.none(), None
        if info.lower is None or info.upper is None:
            return
        if change.tiles is None or self._bounds is None:
            tiles = np.floor(np.array([info.lower, info.upper]) / info.tile_size_m)
            self._bounds = Box(tiles[0] * info.tile_size_m, (tiles[1] + 1) * info.tile_size_m)
            boxes = [self._bounds]
        else:
            boxes = []
            for inner, outer in changed_boxes(change.tiles, change.tile_m):
                self._bounds = self._bounds.joined(inner)
                boxes.append(outer)
        for box in boxes:
            self._renew(box.cut(self._bounds))

    def leaves(self) -> Leaves:
        """The voxels as leaves of an octree.

        Raises:
            UsageError: they lie beyond what an OctoMap can say.
        """
        tree = OcTreeBuilder()
        tree.add(self.voxels.cells + KEY_ORIGIN, self.voxels.occupied)
        return tree.leaves()

    def _crossings(self, edges: _Edges) -> Crossings:
        """Where the log-odds along edges are 0, to a few per cent of an edge, and the deviations there."""
        left, right = np.zeros(len(edges.cells)), np.ones(len(edges.cells))
        low, high = edges.low, edges.high
        for _ in range(_ROUNDS):
            share = left + (right - left) * low / (low - high)
            points = edges.start + share[:, None] * edges.step
            answer = self._client.occupancy(points)
            is_low = (answer.latent_mean < 0) == (low < 0)
            left, right = np.where(is_low, share, left), np.where(is_low, right, share)
            low, high = np.where(is_low, answer.latent_mean, low), np.where(is_low, high, answer.latent_mean)
        return Crossings(edges.cells, points, np.sqrt(surface_var(answer)))

    def _renew(self, box: Box) -> None:
        """Ask for all cells of a box, and put the answers in the place of those before."""
        s = self._settings
        if s.box_m:
            box = box.cut(Box(np.array(s.box_m[:3]), np.array(s.box_m[3:])))
        if box.is_empty:
            return
        cells = CellBox.around(box.lower, box.upper, s.voxel_m)
        kept = ~_inside(self.voxels.cells, cells)
        voxels = [Voxels(self.voxels.cells[kept], self.voxels.occupied[kept])]
        kept = ~_inside(self.surface.cells, cells)
        old = Crossings(self.surface.cells[kept], self.surface.points[kept], self.surface.sd[kept])
        edges = []
        for part in cells.tiles(_PART_CELLS):
            # a cell more at the upper faces: a surface point lies between two cells, and the lower one has it
            grid = self._client.grid(part.first * s.voxel_m, (part.stop + 1) * s.voxel_m, s.voxel_m)
            voxels.append(_voxels(grid, part))
            edges += _edges(grid, part)
        surface = [
            old,
            self._crossings(_Edges(*(np.concatenate(column) for column in zip(*edges, strict=True)))),
        ]
        self.voxels = Voxels(*(np.concatenate(column) for column in zip(*voxels, strict=True)))
        self.surface = Crossings(*(np.concatenate(column) for column in zip(*surface, strict=True)))


def _inside(cells: Int64, box: CellBox) -> Bool:
    return np.asarray(((cells >= box.first) & (cells < box.stop)).all(axis=1))


def _voxels(grid: Grid, part: CellBox) -> Voxels:
    inner = (slice(-1),) * 3
    known = grid.observed[inner]
    return Voxels(np.argwhere(known) + part.first, grid.mean[inner][known] >= 0.5)


def _edges(grid: Grid, part: CellBox) -> list[_Edges]:
    """Between observed neighbours of which one is occupied and one free, along each axis."""
    inner, found = (slice(-1),) * 3, []
    for axis in range(3):
        beyond = tuple(slice(1, None) if a == axis else slice(-1) for a in range(3))
        low, high = grid.latent_mean[inner], grid.latent_mean[beyond]
        crosses = ((low < 0) != (high < 0)) & grid.observed[inner] & grid.observed[beyond]
        cells = np.argwhere(crosses) + part.first
        start: Float64 = (cells + 0.5) * np.float64(part.resolution)
        step = np.zeros_like(start)
        step[:, axis] = part.resolution
        found.append(_Edges(cells, start, step, low[crosses], high[crosses]))
    return found
