"""The flags that say what of a map becomes a file, and the file: for `potclient export` and `potserver map export`."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Sequence

import numpy as np

from potclient import export
from potclient.arrays import Float64
from potclient.cells import CellBox, MapSource, Progress, bounds_of, layer_of
from potclient.commands.output_files import output_file
from potclient.commands.shared import EXIT_OK, add_box_arguments, note, part_bar, positive, say
from potclient.errors import UsageError
from potclient.ground import estimate_ground
from potclient.mesh import export_mesh

EXPORT_KINDS = ("ply", "npz", "pgm", "bt", "mesh", "gltf", "rrd", "mcap")
_WHAT = {
    "ply": "kernels",
    "npz": "kernels",
    "pgm": "pixels",
    "bt": "voxels",
    "mesh": "triangles",
    "gltf": "triangles",
    "rrd": "tiles",
    "mcap": "tiles",
}
_ENDINGS = {"mesh": ".ply", "gltf": ".glb", "rrd": ".rrd", "mcap": ".mcap"}
_GRID_KINDS = ("pgm", "bt", "mesh", "gltf", "rrd", "mcap")
_FLAT_KINDS = ("pgm", "mcap")  # with the map seen from above
_TOUCHES_M, _TOUCHES_SHARE = (
    0.1,
    0.05,
)  # a band that comes so near to the ground, in so many of the columns, is warned of


def add_export_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that say what of a map goes into a file, and how; `export_map` reads them."""
    parser.add_argument("-o", "--out", type=output_file, required=True, metavar="FILE", help="file to write")
    add_box_arguments(parser, "corner of the box (default: the map's)")
    parser.add_argument(
        "--resolution", type=positive, metavar="METRES", help="of cells; all but ply and npz have them"
    )
    heights = parser.add_mutually_exclusive_group()
    heights.add_argument(
        "--band",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="pgm, mcap: heights that count, m, map frame",
    )
    heights.add_argument(
        "--above-ground",
        type=float,
        nargs=2,
        metavar=("LOW", "HIGH"),
        help="pgm, mcap: heights that count, m above the ground below each pixel, which is estimated",
    )
    parser.add_argument(
        "--occupied", type=float, metavar="P", help="occupied from here on (default: pgm 0.65, bt 0.5)"
    )
    parser.add_argument("--free", type=float, metavar="P", help="free below (default: pgm 0.25, bt 0.5)")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def check_export_flags(arguments: argparse.Namespace) -> None:
    """Refuse flags that mean nothing for the kind of file, before anything is opened.

    Raises:
        UsageError: a flag is missing, or one too many.
    """
    kind = arguments.kind
    if kind in _GRID_KINDS and arguments.resolution is None:
        raise UsageError(f"export {kind}: give --resolution METRES")
    thresholds = (arguments.occupied, arguments.free)
    heights = (arguments.band, arguments.above_ground)
    grid_flags = (arguments.resolution, *heights, *thresholds)
    if kind not in _GRID_KINDS and any(flag is not None for flag in grid_flags):
        raise UsageError(f"export {kind}: kernels have no cells; only --lower and --upper apply")
    if kind not in _FLAT_KINDS and any(flag is not None for flag in heights):
        raise UsageError(
            f"export {kind}: --band and --above-ground are for pgm and mcap; give the heights with --lower and --upper"
        )
    if kind in _ENDINGS:
        if any(flag is not None for flag in thresholds):
            raise UsageError(
                f"export {kind}: the surface is where p is one half; leave out --occupied and --free"
            )
        if arguments.out.suffix != _ENDINGS[kind]:
            raise UsageError(f"{arguments.out}: export {kind} writes {_ENDINGS[kind]}")
    if kind in ("rrd", "mcap") and (arguments.lower is not None or arguments.upper is not None):
        raise UsageError(f"export {kind}: it draws whole tiles; leave out --lower and --upper")
    for name, band in (("--band", arguments.band), ("--above-ground", arguments.above_ground)):
        if band is not None and not band[0] < band[1]:
            raise UsageError(f"export {kind}: {name} {band[0]:g} {band[1]:g}: need LOW below HIGH")


def export_map(source: MapSource, arguments: argparse.Namespace) -> int:
    """Write a map as the flags want it, and say what was written."""
    with part_bar(quiet=arguments.quiet) as progress:
        if arguments.kind == "pgm":
            done = _export_pgm(source, arguments, progress)
        elif arguments.kind == "bt":
            box = CellBox.around(*_corners(source, arguments), arguments.resolution)
            done = export.export_bt(source, arguments.out, box, progress=progress, **_thresholds(arguments))
        elif arguments.kind in ("mesh", "gltf"):
            box = CellBox.around(*_corners(source, arguments), arguments.resolution)
            done = export.Exported(*export_mesh(source, arguments.out, box, arguments.kind, progress))
        elif arguments.kind == "rrd":
            done = _export_rrd(source, arguments, progress)
        elif arguments.kind == "mcap":
            done = _export_mcap(source, arguments, progress)
        else:
            write = export.export_ply if arguments.kind == "ply" else export.export_npz
            done = write(
                source, arguments.out, lower=arguments.lower, upper=arguments.upper, progress=progress
            )
    revision = done.revisions[0] if done.revisions else 0
    say(f"wrote {arguments.out}: {done.n} {_WHAT[arguments.kind]}, revision {revision}")
    if arguments.kind == "pgm":
        say(f"wrote {arguments.out.with_suffix('.yaml')}")
    if len(done.revisions) > 1:
        note(f"the map changed meanwhile: revisions {done.revisions[0]} to {done.revisions[-1]}")
    return EXIT_OK


def _export_rrd(
    source: MapSource, arguments: argparse.Namespace, progress: Progress | None
) -> export.Exported:
    from potclient.view.live import draw_map
    from potclient.view.picture import MapPicture

    bounds_of(source)  # refuses an empty map before there is a file
    revision, partial = source.info().map_revision, arguments.out.with_name(arguments.out.name + ".partial")
    try:
        with contextlib.closing(MapPicture(f"map {source.info().map}")) as picture:
            picture.save(partial)
            n_tiles = draw_map(source, picture, arguments.resolution, progress)
        partial.replace(arguments.out)
    finally:
        partial.unlink(missing_ok=True)
    return export.Exported(n_tiles, tuple(sorted({revision, source.info().map_revision})))


def _export_mcap(
    source: MapSource, arguments: argparse.Namespace, progress: Progress | None
) -> export.Exported:
    from potclient.ros.maps import percent
    from potclient.view.bag import BagPicture
    from potclient.view.live import draw_map

    seen_from_above = (
        layer_of(source) is not None or arguments.band is not None or arguments.above_ground is not None
    )
    revision, picture = source.info().map_revision, BagPicture(arguments.out)
    try:
        n_tiles = draw_map(source, picture, arguments.resolution, progress)
        if seen_from_above:
            box, band = _columns(source, arguments, progress)
            likeliest, _ = export.likeliest_of_columns(source, box, band, progress)
            x, y = (box.first[:2] * box.resolution).tolist()
            picture.draw_grid(percent(likeliest), (x, y), box.resolution)
        picture.close()
    finally:
        picture.discard()
    return export.Exported(n_tiles, tuple(sorted({revision, source.info().map_revision})))


def _export_pgm(
    source: MapSource, arguments: argparse.Namespace, progress: Progress | None
) -> export.Exported:
    box, band = _columns(source, arguments, progress)
    return export.export_pgm(
        source, arguments.out, box, band=band, progress=progress, **_thresholds(arguments)
    )


def _columns(
    source: MapSource, arguments: argparse.Namespace, progress: Progress | None
) -> tuple[CellBox, export.Band | None]:
    """The columns of cells that the flags name, with the heights that count.

    Raises:
        UsageError: they leave out all of the map, or do not say which heights matter.
    """
    (x, y, z), (x2, y2, z2) = _corners(source, arguments)
    layer, band = layer_of(source), None
    if layer is not None:
        z, z2 = _planar_heights(arguments, layer, z, z2)
    elif arguments.above_ground is not None:
        band = export.Band(
            estimate_ground(source, (x, y, z), (x2, y2, z2), progress), *arguments.above_ground
        )
        z, z2 = band.heights()
        note(_said_ground(band.ground.height))
    elif arguments.band is not None:
        _warn_of_floor(source, (x, y, z), (x2, y2, z2), arguments)
        z, z2 = arguments.band
    elif z != z2:
        raise UsageError(
            f"export pgm: the map spans {z:g} to {z2:g} m in height; say which matter to the robot, with"
            " --above-ground LOW HIGH, or with --band LOW HIGH in the map frame"
        )
    return CellBox.around((x, y, z), (x2, y2, z2), arguments.resolution), band


def _planar_heights(arguments: argparse.Namespace, layer: float, z: float, z2: float) -> tuple[float, float]:
    """The one height of a planar map, twice.

    Raises:
        UsageError: the flags leave it out, or ask for its ground.
    """
    if arguments.above_ground is not None:
        raise UsageError(
            f"export {arguments.kind}: this map is planar and has no ground; leave out --above-ground"
        )
    low, high = arguments.band if arguments.band is not None else (z, z2)
    if not low - 1e-6 <= layer <= high + 1e-6:
        raise UsageError(
            f"export {arguments.kind}: this map is planar, at {layer:.3g} m: {low:g} to {high:g} m leave it out"
        )
    return layer, layer


def _warn_of_floor(
    source: MapSource, lower: Sequence[float], upper: Sequence[float], arguments: argparse.Namespace
) -> None:
    low, high = arguments.band
    try:
        height = estimate_ground(source, lower, upper).height
    except UsageError:
        return  # no ground, so nothing to touch
    known = height[~np.isnan(height)]
    near = (known > low - _TOUCHES_M) & (known < high)
    if near.mean() > _TOUCHES_SHARE:
        note(
            f"the band begins below the ground, or within {_TOUCHES_M:g} m of it, in {near.mean():.0%} of the columns"
            f" ({_said_ground(height)}): the floor becomes an obstacle there. --above-ground LOW HIGH follows it"
        )


def _said_ground(height: Float64) -> str:
    low, high = np.nanquantile(height, [0.05, 0.95])
    return f"ground mostly at {low:.2f} to {high:.2f} m"


def _corners(source: MapSource, arguments: argparse.Namespace) -> tuple[list[float], list[float]]:
    lower, upper = arguments.lower, arguments.upper
    if lower is None or upper is None:
        low, high = bounds_of(source)
        lower = low.tolist() if lower is None else lower
        upper = high.tolist() if upper is None else upper
    return lower, upper


def _thresholds(arguments: argparse.Namespace) -> dict[str, float]:
    given = {"occupied_above": arguments.occupied, "free_below": arguments.free}
    return {name: value for name, value in given.items() if value is not None}
