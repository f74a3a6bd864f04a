"""`potclient export`: the map as a file of another program."""

from __future__ import annotations

import argparse
from typing import Any

from potclient.commands.export_flags import EXPORT_KINDS, add_export_flags, check_export_flags, export_map
from potclient.commands.shared import add_command, client_of


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "export",
        run,
        help="the map as a file of another program: ply, npz, pgm, bt, mesh, gltf, rrd, mcap",
        description="""Write the map as a file that other programs read. Maps larger than one answer are fetched part by part.

  ply   kernels, all ten numbers of each, coloured by what they say
  npz   kernels, as `potclient.KernelSet.load` reads them
  pgm   occupancy in the plane and its YAML, for Nav2's map_server: 0 occupied, 254 free, 205 unknown
  bt    occupancy as a binary OctoMap: observed cells only
  mesh  the surface where the probability is one half, as a PLY of triangles coloured by its standard deviation
  gltf  the same as binary glTF (.glb), whose y axis is up
  rrd   the surface, free space and the edge of the unknown as a recording of Rerun; `potclient view` follows a map
  mcap  the same points as ROS 2 messages, for Foxglove and RViz: PointCloud2, and an OccupancyGrid if heights are given

For pgm and mcap, --above-ground says which heights above the ground matter to the robot, and --band which heights of the
map frame. A planar map is one layer and needs neither.""",
        epilog="""examples:
  potclient export ply -o kernels.ply
  potclient export pgm --resolution 0.05 --above-ground 0.15 1.5 -o map.pgm
  potclient export bt --resolution 0.2 --lower -20 -20 -1 --upper 20 20 4 -o map.bt
  potclient export gltf --resolution 0.2 -o map.glb
  potclient export mcap --resolution 0.2 --above-ground 0.15 1.5 -o map.mcap""",
    )
    parser.add_argument("kind", choices=EXPORT_KINDS)
    add_export_flags(parser)
    parser.set_defaults(timeout=60.0)


def run(arguments: argparse.Namespace) -> int:
    check_export_flags(arguments)
    with client_of(arguments) as client:
        return export_map(client, arguments)
