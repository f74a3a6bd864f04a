"""Pictures of a map: one horizontal layer, its mean and how sure it is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from potclient.errors import UsageError
from potclient.extras import how_to_install
from potclient.occupancy import Grid

_UNKNOWN = "#e4e4e4"
_ECHOES: dict[str, Any] = {"color": "black", "markersize": 0.8, "alpha": 0.5}
_TRACK: dict[str, Any] = {"color": "white", "mec": "black", "markersize": 4, "linewidth": 1}


def draw_layer(
    grid: Grid,
    path: Path,
    *,
    level_m: float | None = None,
    hits: ArrayLike | None = None,
    path_of_sensor: ArrayLike | None = None,
    title: str = "",
) -> None:
    """Draw mean and standard deviation of the occupancy probability side by side; unknown cells stay grey.

    Args:
        grid: Any grid; one of its layers is drawn.
        path: PNG file to write.
        level_m: Height of the layer; the middle one by default.
        hits: (N, 3) m, map frame: echoes to draw in, those that lie within the layer.
        path_of_sensor: (S, 3) m, map frame: where the scans were taken.
        title: Over the picture.
    Raises:
        UsageError: matplotlib is missing, or the level lies outside the grid.
    """
    pyplot = load_pyplot()
    layer, z = _layer_at(grid, level_m)
    nx, ny, _ = grid.shape
    x, y = float(grid.lower[0]), float(grid.lower[1])
    extent = (x, x + nx * grid.resolution, y, y + ny * grid.resolution)
    known = grid.observed[:, :, layer]
    width = 6.4
    height = float(np.clip(width * ny / nx, 2.5, 9.0))
    figure, axes = pyplot.subplots(
        1, 2, figsize=(2 * width + 1, height + 1), layout="constrained", sharey=True
    )
    for axis, values, name, colours, top in (
        (axes[0], grid.mean[:, :, layer], "P(occupied)", "RdYlBu_r", 1.0),
        (axes[1], np.sqrt(grid.var[:, :, layer]), "its standard deviation", "viridis", 0.5),
    ):
        axis.set_facecolor(_UNKNOWN)
        shown = np.ma.masked_where(~known, values)
        image = axis.imshow(
            shown.T, origin="lower", extent=extent, cmap=colours, vmin=0.0, vmax=top, interpolation="nearest"
        )
        if hits is not None:
            points = np.asarray(hits, np.float64)
            points = points[np.abs(points[:, 2] - z) <= max(grid.resolution, 0.15)]
            axis.plot(*points[:, :2].T, ".", label="echoes in this layer", **_ECHOES)
        if path_of_sensor is not None:
            track = np.asarray(path_of_sensor, np.float64)
            axis.plot(*track[:, :2].T, "o-", label="sensor", **_TRACK)
        axis.set(title=name, xlabel="x [m]", xlim=extent[:2], ylim=extent[2:])
        figure.colorbar(image, ax=axis, shrink=0.8)
    axes[0].set_ylabel("y [m]")
    if hits is not None or path_of_sensor is not None:
        axes[0].legend(loc="upper right", fontsize="x-small")
    head = f"{title}, " if title else ""
    figure.suptitle(f"{head}z = {z:.2f} m, revision {grid.revision}, grey = unknown")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def load_pyplot() -> Any:
    """matplotlib's pyplot, for pictures that go to files.

    Raises:
        UsageError: matplotlib is missing.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise UsageError(f"pictures need the package matplotlib: {how_to_install('pictures')}") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _layer_at(grid: Grid, level_m: float | None) -> tuple[int, float]:
    """The layer at a height, the middle one for None, and the height of its middle, m."""
    z_low, cell, nz = float(grid.lower[2]), grid.resolution, grid.shape[2]
    layer = nz // 2 if level_m is None else math.floor((level_m - z_low) / cell)
    if not 0 <= layer < nz:
        raise UsageError(f"level {level_m} m is outside the grid, {z_low:g} to {z_low + nz * cell:g} m")
    return layer, z_low + (layer + 0.5) * cell
