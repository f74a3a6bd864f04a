"""A map as files of other programs: kernels as PLY, occupancy as an OctoMap or as a picture for navigation in the plane.

Everything comes from `q/params` and `q/grid`, part by part, so that a map may be larger than one answer.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arrays import Float32
from potclient.cells import CellBox, MapSource, Progress, grids
from potclient.errors import UsageError
from potclient.files import whole
from potclient.ground import Ground
from potclient.kernels import KernelSet
from potclient.octomap import KEY_ORIGIN, OcTreeBuilder, write_bt

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


class Exported(NamedTuple):
    """What a file holds."""

    n: int  # kernels, pixels or voxels of known state
    revisions: tuple[int, ...]  # of the map, ascending; several where it changed meanwhile


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


class Band(NamedTuple):
    """The heights above the ground that matter to a robot."""

    ground: Ground
    low_m: float
    high_m: float

    def inside(self, tile: CellBox) -> NDArray[np.bool_]:
        """(nx, ny, nz): which cells of a tile have their centre in the band; none where nobody knows the ground."""
        x, y, z = tile.centres()
        above = z - self.ground.at(x, y)[:, :, None]
        return np.asarray((above >= self.low_m) & (above <= self.high_m))

    def heights(self) -> tuple[float, float]:
        """m, map frame: the lowest and the highest of it."""
        low, high = np.nanmin(self.ground.height), np.nanmax(self.ground.height)
        return float(low + self.low_m), float(high + self.high_m)


def export_pgm(
    source: MapSource,
    path: Path,
    box: CellBox,
    *,
    band: Band | None = None,
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
        band: Cells outside do not count, and columns without ground are unknown.
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
    likeliest, revisions = likeliest_of_columns(source, box, band, progress)
    nx, ny = likeliest.shape
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
    return Exported(nx * ny, revisions)


def likeliest_of_columns(
    source: MapSource, box: CellBox, band: Band | None = None, progress: Progress | None = None
) -> tuple[Float32, tuple[int, ...]]:
    """The map seen from above.

    Args:
        box: Columns and the heights that count.
        band: Cells outside do not count, nor do columns without ground.
    Returns:
        (nx, ny) P(occupied) of the likeliest observed cell of each column, -1 where there is none; the revisions, ascending.
    Raises:
        PotclientError: see `MapClient.grid`.
    """
    likeliest = np.full((box.stop - box.first)[:2], -1.0, np.float32)
    revisions = set()
    wanted = None if band is None else lambda tile: bool(band.inside(tile).any())
    for tile, grid in grids(source, box, progress, wanted):
        x, y = (slice(int(tile.first[a] - box.first[a]), int(tile.stop[a] - box.first[a])) for a in (0, 1))
        counts = grid.observed if band is None else grid.observed & band.inside(tile)
        column = np.where(counts, grid.mean, np.float32(-1)).max(axis=2)
        likeliest[x, y] = np.maximum(likeliest[x, y], column)
        revisions.add(grid.revision)
    return likeliest, tuple(sorted(revisions))


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
    for tile, grid in grids(source, box, progress):
        occupied = grid.observed & (grid.mean >= occupied_above)
        known = occupied | (grid.observed & (grid.mean < free_below))
        tree.add(np.argwhere(known) + tile.first + KEY_ORIGIN, occupied[known])
        n += int(known.sum())
        revisions.add(grid.revision)
    write_bt(path, tree.leaves(), box.resolution)
    return Exported(n, tuple(sorted(revisions)))


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
