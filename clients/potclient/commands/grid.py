"""`potclient grid`: occupancy on a grid."""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from potclient.cells import bounds_of
from potclient.commands.output_files import output_file, picture_file
from potclient.commands.shared import (
    EXIT_OK,
    add_box_arguments,
    add_command,
    add_evidence_only_argument,
    client_of,
    part_bar,
    positive,
    say,
)
from potclient.errors import UsageError
from potclient.pictures import draw_layer, load_pyplot


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "grid",
        run,
        help="occupancy on a grid, streamed in parts",
        description="""Sample a box of the map on a grid of any resolution, all cells from one revision of the map. Without
--lower and --upper the box spans all kernels of the map.""",
        epilog="""examples:
  potclient grid --resolution 0.5 -o map.npz
  potclient grid --lower -10 -10 -1 --upper 10 10 3 --resolution 0.2 -o map.npz --png map.png
  potclient grid --lower -10 -10 0.9 --upper 10 10 1.1 --resolution 0.2 --png slice.png""",
    )
    add_box_arguments(parser, "corner of the box, m, map frame")
    parser.add_argument("--resolution", type=positive, required=True, metavar="METRES", help="cell edge")
    add_evidence_only_argument(parser)
    parser.add_argument(
        "-o",
        "--out",
        type=output_file,
        metavar="FILE",
        help="write an .npz: mean, var, ..., lower, resolution",
    )
    parser.add_argument(
        "--png", type=picture_file, metavar="FILE", help="draw mean and uncertainty of one layer"
    )
    parser.add_argument(
        "--level", type=float, metavar="Z", help="layer for --png, m (default: the middle one)"
    )
    parser.set_defaults(timeout=60.0)


def run(arguments: argparse.Namespace) -> int:
    if arguments.out is None and arguments.png is None:
        raise UsageError("grid: nothing to do with the answer; give -o FILE or --png FILE")
    if arguments.png is not None:
        load_pyplot()
    with client_of(arguments) as client:
        lower, upper = arguments.lower, arguments.upper
        if lower is None or upper is None:
            low, high = bounds_of(client)
            lower = low if lower is None else np.asarray(lower)
            upper = np.maximum(high, lower + arguments.resolution) if upper is None else upper
        with part_bar() as progress:
            grid = client.grid(
                lower,
                upper,
                arguments.resolution,
                evidence_only=arguments.evidence_only,
                progress=progress,
            )
    say(
        f"{' x '.join(str(n) for n in grid.shape)} cells of {grid.resolution:g} m, revision {grid.revision}: "
        f"{float(grid.observed.mean()):.1%} observed, {int(((grid.mean > 0.5) & grid.observed).sum())} occupied"
    )
    if arguments.out is not None:
        grid.save(arguments.out)
        say(f"wrote {arguments.out}")
    if arguments.png is not None:
        draw_layer(grid, arguments.png, level_m=arguments.level)
        say(f"wrote {arguments.png}")
    return EXIT_OK
