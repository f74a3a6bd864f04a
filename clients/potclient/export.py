"""A map as files of other programs: kernels as PLY, occupancy as an OctoMap or as a picture for navigation in the plane.

Everything comes from `q/params` and `q/grid`, part by part, so that a map may be larger than one answer.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arrays import Float64
from potclient.errors import UsageError
from potclient.files import whole
from potclient.kernels import KernelSet
from potclient.occupancy import Grid
from potclient.octomap import KEY_ORIGIN, OcTreeBuilder, write_bt
from potschemas import messages

Int64 = NDArray[np.int64]
Progress = Callable[[int, int], None]  # (parts done, parts in all)

_TILE_CELLS = 250_000  # of one question, at most
_PLY_HEADER_BYTES = 1024
# Nav2's map_server takes 205 for unknown only where free_thresh does not exceed 50/255 = 0.1961
_OCCUPIED_PIXEL, _FREE_PIXEL, _UNKNOWN_PIXEL = 0, 254, 205
_NAV2_OCCUPIED, _NAV2_FREE = 0.65, 0.196
_PLY_FIELDS: tuple[tuple[str, str, str], ...] = (
    *((name, "<f8", "double") for name in ("x", "y", "z")),
    *((f"hinge_var_{axis}", "<f4", "float") for axis in "xyz"),
    *((name, "<f4", "float") for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var")),
    *((name, "u1", "uchar") for name in ("red", "green", "blue")),
)


class MapSource(Protocol):
    """Where files are made from: a `MapClient`, or a map that is not served but answers like one."""

    def info(self) -> messages.Info: ...
    def params_parts(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None
    ) -> Iterator[tuple[int, int, KernelSet]]: ...
    def grid(self, lower: ArrayLike, upper: ArrayLike, resolution: float) -> Grid: ...


class Exported(NamedTuple):
    """What a file holds."""

    n: int  # kernels, pixels or voxels of known state
    revisions: tuple[int, ...]  # of the map, ascending; several where it changed meanwhile


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


def export_ply(
    source: MapSource,
    path: Path,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Exported:
    """Kernels as a binary PLY: a vertex each, with all ten numbers, red where its weight says occupied and blue where free.

    The header's comments have the rule that turns kernels into answers. Vertices come in no special order.

    Raises:
        PotclientError: see `MapClient.params_parts`; nothing is written then.
    """
    n, revisions, done = 0, set(), 0
    rule = ""
    with whole(path) as file:
        file.write(b" " * _PLY_HEADER_BYTES)  # how many there are is known at the end
        for _, n_parts, kernels in source.params_parts(lower, upper):
            file.write(_ply_rows(kernels).tobytes())
            n += len(kernels)
            revisions.add(kernels.map_revision)
            rule = "".join(f"comment {name} {value:.9g}\n" for name, value in kernels.rule.fields().items())
            rule += f"comment map_revision {kernels.map_revision}\n"
            done += 1
            if progress is not None:
                progress(done, n_parts)
        head = (
            "ply\nformat binary_little_endian 1.0\ncomment kernels of a potserver map, metres, map frame\n"
            + rule
        )
        tail = f"element vertex {n}\n" + "".join(f"property {kind} {name}\n" for name, _, kind in _PLY_FIELDS)
        filling = _PLY_HEADER_BYTES - len(head) - len(tail) - len("comment \nend_header\n")
        file.seek(0)
        file.write(f"{head}comment {'.' * filling}\n{tail}end_header\n".encode())
    return Exported(n, tuple(sorted(revisions)))


def export_npz(
    source: MapSource,
    path: Path,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    progress: Progress | None = None,
) -> Exported:
    """Kernels as the .npz that `KernelSet.load` reads; they are held in memory meanwhile.

    Raises:
        PotclientError: see `MapClient.params_parts`; nothing is written then.
    """
    parts: dict[int, KernelSet] = {}
    for part, n_parts, kernels in source.params_parts(lower, upper):
        parts[part] = kernels
        if progress is not None:
            progress(len(parts), n_parts)
    joined = KernelSet.concatenate(parts[i] for i in sorted(parts))
    joined.save(path)
    return Exported(len(joined), (joined.map_revision,))


def export_pgm(
    source: MapSource,
    path: Path,
    box: CellBox,
    *,
    occupied_above: float = 0.65,
    free_below: float = 0.25,
    progress: Progress | None = None,
) -> Exported:
    """Occupancy in the plane as a PGM picture, and beside it the YAML that Nav2's map_server reads.

    A pixel stands for a column of cells: occupied (0) where the likeliest observed cell is at least `occupied_above`, free
    (254) where it is below `free_below`, and unknown (205) otherwise, or where nothing was observed. The first row is the one
    of largest y; `origin` is the lower left corner of the lower left pixel.

    Args:
        path: `*.pgm`; the YAML gets the same name with the suffix `.yaml`.
        box: Columns and the heights that count.
        occupied_above, free_below: Of the occupancy probability.
    Raises:
        UsageError: thresholds out of order, or a name that is the YAML's.
        PotclientError: see `MapClient.grid`; nothing is written then.
    """
    _check_thresholds(occupied_above, free_below)
    if path.suffix == ".yaml":
        raise UsageError(
            f"{path}: name the picture, e.g. {path.with_suffix('.pgm')}; the YAML goes beside it"
        )
    nx, ny, _ = (box.stop - box.first).tolist()
    likeliest = np.full((nx, ny), -1.0, np.float32)  # -1: nothing observed
    revisions = set()
    for tile, grid in _grids(source, box, progress):
        x, y = (slice(int(tile.first[a] - box.first[a]), int(tile.stop[a] - box.first[a])) for a in (0, 1))
        column = np.where(grid.observed, grid.mean, np.float32(-1)).max(axis=2)
        likeliest[x, y] = np.maximum(likeliest[x, y], column)
        revisions.add(grid.revision)
    pixels = np.full((nx, ny), _UNKNOWN_PIXEL, np.uint8)
    pixels[(likeliest >= 0) & (likeliest < free_below)] = _FREE_PIXEL
    pixels[likeliest >= occupied_above] = _OCCUPIED_PIXEL
    with whole(path) as file:
        file.write(f"P5\n{nx} {ny}\n255\n".encode())
        file.write(np.ascontiguousarray(pixels.T[::-1]).tobytes())
    x_m, y_m = (float(box.first[a]) * box.resolution for a in (0, 1))
    text = (
        f"image: {path.name}\nmode: trinary\nresolution: {box.resolution:.9g}\norigin: [{x_m:.9g}, {y_m:.9g}, 0.0]\n"
        f"negate: 0\noccupied_thresh: {_NAV2_OCCUPIED}\nfree_thresh: {_NAV2_FREE}\n"
    )
    with whole(path.with_suffix(".yaml")) as file:
        file.write(text.encode())
    return Exported(nx * ny, tuple(sorted(revisions)))


def export_bt(
    source: MapSource,
    path: Path,
    box: CellBox,
    *,
    occupied_above: float = 0.5,
    free_below: float = 0.5,
    progress: Progress | None = None,
) -> Exported:
    """Occupancy as a binary OctoMap: observed cells are occupied or free voxels, the others and those between are unknown.

    Args:
        path: `*.bt`.
        box: Cells to ask for; voxel and cell are one and the same.
        occupied_above, free_below: Of the occupancy probability.
    Raises:
        UsageError: thresholds out of order, or a box beyond the 65536 voxels along an axis, centred on 0.
        PotclientError: see `MapClient.grid`; nothing is written then.
    """
    _check_thresholds(occupied_above, free_below)
    if (box.first < -KEY_ORIGIN).any() or (box.stop > KEY_ORIGIN).any():
        raise UsageError(
            f"an OctoMap ends {KEY_ORIGIN * box.resolution:g} m from 0 at this resolution; take a coarser one or a smaller box"
        )
    tree = OcTreeBuilder()
    n, revisions = 0, set()
    for tile, grid in _grids(source, box, progress):
        occupied = grid.observed & (grid.mean >= occupied_above)
        known = occupied | (grid.observed & (grid.mean < free_below))
        tree.add(np.argwhere(known) + tile.first + KEY_ORIGIN, occupied[known])
        n += int(known.sum())
        revisions.add(grid.revision)
    write_bt(path, tree.leaves(), box.resolution)
    return Exported(n, tuple(sorted(revisions)))


def _grids(source: MapSource, box: CellBox, progress: Progress | None) -> Iterator[tuple[CellBox, Grid]]:
    """The box, tile by tile."""
    tiles = box.tiles(min(_TILE_CELLS, source.info().limits.max_grid_cells))
    for done, tile in enumerate(tiles, 1):
        raised = np.array([0.0, 0.0, box.raised_m])
        lower, upper = (corner * box.resolution + raised for corner in (tile.first, tile.stop))
        grid = source.grid(lower, upper, box.resolution)
        if grid.shape != tuple((tile.stop - tile.first).tolist()):
            raise UsageError(f"a grid of {grid.shape} cells came for {(tile.stop - tile.first).tolist()}")
        yield tile, grid
        if progress is not None:
            progress(done, len(tiles))


def _ply_rows(kernels: KernelSet) -> NDArray[np.void]:
    rows = np.zeros(len(kernels), [(name, kind) for name, kind, _ in _PLY_FIELDS])
    for axis, name in enumerate("xyz"):
        rows[name] = kernels.hinge_mean[:, axis]
        rows[f"hinge_var_{name}"] = kernels.hinge_var[:, axis]
    for name in ("gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        rows[name] = getattr(kernels, name)
    # the logistic function of the weight: what the kernel says where it is alone
    says = 0.5 + 0.5 * np.tanh(0.5 * kernels.weight_mean.astype(np.float64))
    rows["red"], rows["blue"] = np.rint(255 * says), np.rint(255 * (1.0 - says))
    rows["green"] = 64
    return rows


def _check_thresholds(occupied_above: float, free_below: float) -> None:
    if not (math.isfinite(occupied_above) and 0.0 < free_below <= occupied_above < 1.0):
        raise UsageError(
            f"thresholds: occupied above {occupied_above:g}, free below {free_below:g}; need 0 < free <= occupied < 1"
        )


def bounds_of(source: MapSource) -> tuple[Float64, Float64]:
    """The corners of the box of all hinges, m, map frame.

    Raises:
        UsageError: the map is empty.
    """
    info = source.info()
    if info.lower is None or info.upper is None:
        raise UsageError("the map is empty; publish something first, or give --lower and --upper")
    return np.asarray(info.lower, np.float64), np.asarray(info.upper, np.float64)
