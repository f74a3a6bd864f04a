"""`potclient town`: write a drive through a made-up town."""

from __future__ import annotations

import argparse
import sys
from typing import Any

from potclient.commands.output_files import new_folder
from potclient.commands.shared import EXIT_OK, positive, progress_bar, say
from potclient.errors import UsageError
from potclient.towns import PERIOD_S, TownName, open_town
from potclient.towns.export import write_drive


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "town",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        help="write a drive through a made-up town",
        description="""Drive through a made-up town with a LiDAR model and write the scans, their poses and times, all settings
(recording.json) and a picture of the town (plan.png) into a new folder. No server is needed. Same options, same files.

STYLE:
  terraces   narrow streets of row houses close to the kerb, garden walls, cars parked on both sides
  suburb     detached houses set back behind lawns, hedges and trees, few cars
  downtown   large blocks of tall buildings on wide streets, arcades, open squares, rows of trees and poles
  offices    indoors: corridors, rooms with doors, desks, chairs and cupboards

Other commands take towns as they are, as the dataset town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED].""",
        epilog="""examples:
  potclient town terraces -o drive
  potclient town suburb --dynamic --length 300 --every 2 --max-range 25 -o drive
  potclient town offices --2d --seed 7 --length 100 --every 0.5 --sensor planar180 -o drive
  potclient publish drive                   play it into a map
  potclient publish town:terraces:300m      the same without files""",
    )
    parser.set_defaults(command=run)
    parser.add_argument("style", metavar="STYLE")
    parser.add_argument("--2d", action="store_true", dest="planar", help="a planar scanner; z = 0")
    parser.add_argument(
        "--dynamic", action="store_true", help="cars (in offices: people) move, parked ones leave"
    )
    parser.add_argument("--seed", type=int, default=0, help="another town (default 0)")
    parser.add_argument(
        "--length", type=positive, default=1000.0, metavar="METRES", help="of the drive (default 1000)"
    )
    parser.add_argument(
        "--every", type=positive, metavar="METRES", help="distance of scans (default: all, ten a second)"
    )
    parser.add_argument(
        "--sensor",
        help="hdl64, vlp16, os64, planar360 or planar180 (default: hdl64; indoors os64; in 2D planar360)",
    )
    parser.add_argument(
        "--max-range",
        type=positive,
        metavar="METRES",
        help="beams beyond are free up to here and have no echo",
    )
    parser.add_argument(
        "-o", "--out", type=new_folder, required=True, metavar="FOLDER", help="new folder to write"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def run(arguments: argparse.Namespace) -> int:
    if arguments.seed < 0:
        raise UsageError(f"--seed {arguments.seed}: need 0 or more")
    words = ["town", arguments.style, *["2d"] * arguments.planar, *["dynamic"] * arguments.dynamic]
    words += [] if arguments.sensor is None else [arguments.sensor]
    name = TownName.parse(":".join([*words, f"{arguments.length:.6f}m", str(arguments.seed)]))
    recording = open_town(str(name), max_range_m=arguments.max_range)
    if arguments.every is not None:
        spacing = recording.town.style.speed_m_s * PERIOD_S
        recording = recording[:: max(1, round(arguments.every / spacing))]
    progress = None if arguments.quiet or not sys.stderr.isatty() else progress_bar(len(recording))
    if progress is None:
        write_drive(recording, arguments.out)
    else:
        bar, task = progress
        with bar:
            write_drive(recording, arguments.out, on_scan=lambda: bar.advance(task))
    say(
        f"{arguments.out}: {len(recording)} scans over {recording.town.drive.length_m:g} m; {'; '.join(recording.notes)}"
    )
    return EXIT_OK
