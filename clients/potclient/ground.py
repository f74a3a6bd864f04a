"""How high the ground is, column by column: the lowest surface with room above it, smoothed, and filled where nobody saw it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike

from potclient.arrays import Bool, Float64
from potclient.cells import CellBox, MapSource, grids
from potclient.errors import UsageError

_CELL_M = 0.2  # of the columns, and of the heights at which the map is asked
_ROOM_M = 0.5  # free space above the ground; less is a gap in something
_ENVELOPE_M, _ENVELOPE_SHARE = 3.0, 0.15  # the lower envelope: this quantile within this distance
_STEP_M = 0.4  # what stands higher above the envelope is a thing, no ground
_SMOOTH_M = 0.6  # the median within this distance keeps slopes and loses low things
_REACH_M = 4.0  # ground that nobody saw, as under a sensor, is taken from as far as this
_STRIP = 64  # rows of columns at once, so that windows stay small
_OBSERVED_SHARE = 0.6  # of the room: where less was seen, nobody knows whether it is free


class Ground(NamedTuple):
    """Heights of the ground over columns of one size."""

    height: Float64  # (nx, ny) m, map frame; NaN where there is none within reach
    box: CellBox  # of the columns; its heights say where the map was asked

    def at(self, x: ArrayLike, y: ArrayLike) -> Float64:
        """(nx, ny) m: the ground in the nearest columns to places x (nx,) and y (ny,), m; NaN where there is none."""
        i, j = (
            np.clip(
                np.floor(np.asarray(places, np.float64) / self.box.resolution).astype(np.int64)
                - self.box.first[axis],
                0,
                self.height.shape[axis] - 1,
            )
            for axis, places in enumerate((x, y))
        )
        return self.height[np.ix_(i, j)]


def estimate_ground(
    source: MapSource,
    lower: ArrayLike,
    upper: ArrayLike,
    progress: Callable[[int, int], None] | None = None,
) -> Ground:
    """Where the ground is in a box of a 3D map.

    In each column it is the lowest height where the probability falls through one half and the half metre above is free. Walls,
    cars and tables stand out from the lower envelope of their surroundings and are dropped; what is left is smoothed. Columns
    where nobody saw the ground get that of the nearest ones within 4 m.

    Args:
        source: The map.
        lower, upper: (3,) m, map frame; their heights must enclose the ground.
    Raises:
        UsageError: no ground in the box.
        PotclientError: see `MapClient.grid`.
    """
    box = CellBox.around(lower, upper, _CELL_M)
    shape = box.stop - box.first
    mean, known = np.full(shape, 0.5, np.float32), np.zeros(shape, np.bool_)
    for tile, grid in grids(source, box, progress):
        part = tuple(
            slice(int(a), int(b)) for a, b in zip(tile.first - box.first, tile.stop - box.first, strict=True)
        )
        mean[part], known[part] = grid.mean, grid.observed
    found = _lowest_surfaces(mean, known, float(box.first[2]) * _CELL_M)
    envelope = _filtered(found, _ENVELOPE_M, _low_quantile)
    found[found > envelope + _STEP_M] = np.nan
    height = _filled(_filtered(found, _SMOOTH_M, _median))
    if np.isnan(height).all():
        raise UsageError(
            f"no ground from {box.first[2] * _CELL_M:.1f} to {box.stop[2] * _CELL_M:.1f} m: no surface has free space above"
        )
    return Ground(height, box)


def _lowest_surfaces(mean: np.ndarray, known: Bool, bottom_m: float) -> Float64:
    """(nx, ny) m: of each column (nx, ny, nz), the lowest fall through one half with free room above; NaN without one."""
    room = round(_ROOM_M / _CELL_M)
    occupied, free = known & (mean >= 0.5), known & (mean < 0.5)
    nz = mean.shape[2]
    height = np.full(mean.shape[:2], np.nan)
    if nz < room + 2:
        return height
    above_free = sliding_window_view(free, room, axis=2)  # [.., k]: cells k to k + room - 1
    any_occupied = sliding_window_view(occupied, room, axis=2).any(axis=3)
    has_room = (above_free.mean(axis=3) >= _OBSERVED_SHARE) & ~any_occupied
    falls = occupied[:, :, : nz - room] & free[:, :, 1 : nz - room + 1] & has_room[:, :, 1:]
    k = falls.argmax(axis=2)
    i, j = np.nonzero(falls.any(axis=2))
    k = k[i, j]
    below, above = mean[i, j, k].astype(np.float64), mean[i, j, k + 1].astype(np.float64)
    height[i, j] = bottom_m + (k + 0.5 + (below - 0.5) / (below - above)) * _CELL_M
    return height


def _filtered(values: Float64, reach_m: float, take: Callable[[Float64], Float64]) -> Float64:
    """Each column's value from those within a distance; NaN stays out, and comes out where there is nothing else."""
    reach = round(reach_m / _CELL_M)
    padded = np.pad(values, reach, constant_values=np.nan)
    result = np.full(values.shape, np.nan)
    for start in range(0, len(values), _STRIP):
        strip = padded[start : start + _STRIP + 2 * reach]
        windows = sliding_window_view(strip, (2 * reach + 1, 2 * reach + 1))
        flat = windows.reshape(*windows.shape[:2], -1)
        some = ~np.isnan(flat).all(axis=2)
        part = result[start : start + _STRIP]
        part[some] = take(flat[some])
    return result


def _low_quantile(windows: Float64) -> Float64:
    return np.nanquantile(windows, _ENVELOPE_SHARE, axis=1)


def _median(windows: Float64) -> Float64:
    return np.nanmedian(windows, axis=1)


def _filled(height: Float64) -> Float64:
    """Columns without a height get the mean of their neighbours', ring by ring, as far as the reach."""
    for _ in range(round(_REACH_M / _CELL_M)):
        missing = np.isnan(height)
        if not missing.any():
            break
        windows = sliding_window_view(np.pad(height, 1, constant_values=np.nan), (3, 3)).reshape(
            *height.shape, 9
        )
        grown = missing & ~np.isnan(windows).all(axis=2)
        height[grown] = np.nanmean(windows[grown], axis=1)
    return height
