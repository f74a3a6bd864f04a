"""GridLayer: a band of heights of the map as an occupancy grid that grows, and what of it changed."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from potclient.cells import CellBox
from potclient.client import MapClient
from potclient.errors import UsageError
from potclient.ros.maps import UNKNOWN, Int8, grid_values
from potserver.ros.changes import Box, Change, changed_boxes
from potserver.ros.settings import RosSettings

MAX_CELLS = 100_000_000  # of a grid: beyond, give a box or larger cells
_LAYER_M = 0.25  # between the heights that a band is asked at, or a cell's edge if that is more
_FLAT_M = 1e-3  # a map that spans less is planar
_PART_CELLS = 250_000  # of one question


class Patch(NamedTuple):
    """Values at a place of the lattice of cells."""

    first: tuple[int, int]  # cell (i, j) begins at i, j times the resolution
    values: Int8  # (nx, ny)


class GridLayer:
    """The grid as it was last computed."""

    def __init__(self, client: MapClient, settings: RosSettings) -> None:
        self._client, self._settings = client, settings
        self.whole = Patch((0, 0), np.zeros((0, 0), np.int8))
        self._bounds: Box | None = None

    def update(self, change: Change) -> list[Patch] | None:
        """Compute what changed.

        Returns:
            The parts of the grid that have other values now; None: it has another size, or is new.
        Raises:
            PotclientError: the map did not answer.
            UsageError: more than `MAX_CELLS` cells.
        """
        info = self._client.info()
        if info.lower is None or info.upper is None:
            self.whole.values[...] = UNKNOWN
            self._bounds = None
            return None
        heights = self._heights(info.lower[2], info.upper[2])
        if change.tiles is None or self._bounds is None:
            tiles = np.floor(np.array([info.lower[:2], info.upper[:2]]) / info.tile_size_m)
            self._bounds = Box(tiles[0] * info.tile_size_m, (tiles[1] + 1) * info.tile_size_m)
            self.whole = self._ask(self._bounds, heights) or Patch((0, 0), np.zeros((0, 0), np.int8))
            return None
        grown, patches = False, []
        for inner, outer in changed_boxes(frozenset(tile[:2] for tile in change.tiles), change.tile_m):
            self._bounds = self._bounds.joined(inner)
            patch = self._ask(outer.cut(self._bounds), heights)
            if patch is None:
                continue
            grown |= self._grow(patch)
            different = self._paste(patch)
            patches += [] if different is None else [different]
        return None if grown else patches

    def _heights(self, low: float, high: float) -> list[float]:
        """Where the band is asked; a planar map in its plane."""
        if high - low < _FLAT_M:
            return [0.5 * (low + high)]
        bottom, top = self._settings.band_m
        n = max(1, math.ceil((top - bottom) / max(_LAYER_M, self._settings.grid_m) - 1e-6))
        return [bottom + (i + 0.5) * (top - bottom) / n for i in range(n)]

    def _ask(self, box: Box, heights: list[float]) -> Patch | None:
        """The cells that a box meets; None if the settings' box leaves none."""
        s = self._settings
        if s.box_m:
            box = box.cut(Box(np.array(s.box_m[:2]), np.array(s.box_m[3:5])))
        if box.is_empty:
            return None
        cells = [CellBox.around([*box.lower, z], [*box.upper, z], s.grid_m) for z in heights]
        first, stop = cells[0].first[:2], cells[0].stop[:2]
        if int(np.prod(stop - first)) > MAX_CELLS:
            raise UsageError(
                f"a grid of {(stop - first).tolist()} cells; set ros.box_m, or a larger ros.grid_m"
            )
        values = np.full(stop - first, UNKNOWN, np.int8)
        for layer in cells:
            for part in layer.tiles(_PART_CELLS):
                raised = np.array([0.0, 0.0, part.raised_m])
                lower, upper = (corner * s.grid_m + raised for corner in (part.first, part.stop))
                grid = self._client.grid(lower, upper, s.grid_m)
                x, y = (
                    slice(*(int(v) for v in (part.first[a] - first[a], part.stop[a] - first[a])))
                    for a in (0, 1)
                )
                values[x, y] = np.maximum(values[x, y], grid_values(grid.mean, grid.observed))
        return Patch((int(first[0]), int(first[1])), values)

    def _grow(self, patch: Patch) -> bool:
        """Make the grid large enough; whether it was not."""
        old = self.whole
        start = np.array([old.first, patch.first])
        stop = start + np.array([old.values.shape, patch.values.shape])
        first, size = start.min(axis=0), stop.max(axis=0) - start.min(axis=0)
        if old.values.size and tuple(size) == old.values.shape:
            return False
        values = np.full(size, UNKNOWN, np.int8)
        i, j = np.array(old.first) - first
        values[i : i + old.values.shape[0], j : j + old.values.shape[1]] = old.values
        self.whole = Patch((int(first[0]), int(first[1])), values)
        return True

    def _paste(self, patch: Patch) -> Patch | None:
        """Write values into the grid; the smallest part of them around all that differ, if any do."""
        i, j = np.array(patch.first) - self.whole.first
        place = self.whole.values[i : i + patch.values.shape[0], j : j + patch.values.shape[1]]
        differs = np.argwhere(place != patch.values)
        place[...] = patch.values
        if len(differs) == 0:
            return None
        (a, b), (c, d) = differs.min(axis=0).tolist(), (differs.max(axis=0) + 1).tolist()
        return Patch((patch.first[0] + a, patch.first[1] + b), patch.values[a:c, b:d])
