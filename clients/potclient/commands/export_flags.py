"""The flags that say what of a map becomes a file, and the file: for `potclient export` and `potserver map export`."""

from __future__ import annotations

import argparse

from potclient import export
from potclient.commands.output_files import output_file
from potclient.commands.shared import EXIT_OK, add_box_arguments, note, part_bar, positive, say
from potclient.errors import UsageError

EXPORT_KINDS = ("ply", "npz", "pgm", "bt")


def add_export_flags(parser: argparse.ArgumentParser) -> None:
    """The flags that say what of a map goes into a file, and how; `export_map` reads them."""
    parser.add_argument("-o", "--out", type=output_file, required=True, metavar="FILE", help="file to write")
    add_box_arguments(parser, "corner of the box (default: the map's)")
    parser.add_argument("--resolution", type=positive, metavar="METRES", help="pgm, bt: cell edge")
    parser.add_argument(
        "--band", type=float, nargs=2, metavar=("LOW", "HIGH"), help="pgm: heights that count, m"
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
    is_grid = arguments.kind in ("pgm", "bt")
    if is_grid and arguments.resolution is None:
        raise UsageError(f"export {arguments.kind}: give --resolution METRES")
    grid_flags = (arguments.resolution, arguments.band, arguments.occupied, arguments.free)
    if not is_grid and any(flag is not None for flag in grid_flags):
        raise UsageError(f"export {arguments.kind}: kernels have no cells; only --lower and --upper apply")
    if arguments.kind == "bt" and arguments.band is not None:
        raise UsageError("export bt: --band is for pgm; give the heights with --lower and --upper")


def export_map(source: export.MapSource, arguments: argparse.Namespace) -> int:
    """Write a map as the flags want it, and say what was written."""
    with part_bar(quiet=arguments.quiet) as progress:
        if arguments.kind in ("pgm", "bt"):
            box = _export_box(arguments, source)
            run = export.export_pgm if arguments.kind == "pgm" else export.export_bt
            thresholds = {"occupied_above": arguments.occupied, "free_below": arguments.free}
            given = {name: value for name, value in thresholds.items() if value is not None}
            done = run(source, arguments.out, box, progress=progress, **given)
        else:
            write = export.export_ply if arguments.kind == "ply" else export.export_npz
            done = write(
                source, arguments.out, lower=arguments.lower, upper=arguments.upper, progress=progress
            )
    what = {"ply": "kernels", "npz": "kernels", "pgm": "pixels", "bt": "voxels"}[arguments.kind]
    say(f"wrote {arguments.out}: {done.n} {what}, revision {done.revisions[0] if done.revisions else 0}")
    if arguments.kind == "pgm":
        say(f"wrote {arguments.out.with_suffix('.yaml')}")
    if len(done.revisions) > 1:
        note(f"the map changed meanwhile: revisions {done.revisions[0]} to {done.revisions[-1]}")
    return EXIT_OK


def _export_box(arguments: argparse.Namespace, source: export.MapSource) -> export.CellBox:
    lower, upper = arguments.lower, arguments.upper
    if lower is None or upper is None:
        low, high = export.bounds_of(source)
        lower = low.tolist() if lower is None else lower
        upper = high.tolist() if upper is None else upper
    if arguments.kind == "pgm":
        if arguments.band is None and lower[2] != upper[2]:
            raise UsageError(
                f"export pgm: the map spans {lower[2]:g} to {upper[2]:g} m in height; say with --band LOW HIGH which matter"
            )
        if arguments.band is not None:
            lower, upper = [*lower[:2], arguments.band[0]], [*upper[:2], arguments.band[1]]
    return export.CellBox.around(lower, upper, arguments.resolution)
