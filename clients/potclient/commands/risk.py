"""`potclient risk`: how likely a robot on a path touches something."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.commands.shared import (
    EXIT_OK,
    add_command,
    add_evidence_only_argument,
    add_json_argument,
    add_unknown_argument,
    client_of,
    positive,
    read_table,
    say,
    say_rows,
    write_json,
)
from potclient.poses import yaw_pose

_ARRAYS = ("max_probability", "union_probability", "unknown_share", "borrowed_share")
_TOTALS = (
    "path_max_probability",
    "path_union_probability",
    "path_unknown_share",
    "path_borrowed_share",
    "n_cells",
    "resolution_m",
    "revision",
)
_SHOWN = 40  # poses in the table


def add(commands: Any) -> None:
    parser = add_command(
        commands,
        "risk",
        run,
        help="how likely a robot on a path touches something",
        description="""Ask how likely a robot made of spheres touches an occupied point, pose by pose and for the whole path.

The robot covers cells of a lattice: all whose centres lie in a sphere, and those of the spheres' own centres. "max" is the
likeliest of them, as if all were one trial; "union" takes cells further apart than the correlation length as independent. The
truth lies between "max" and the sum over all cells. Poses count as they are: nothing is covered between them.

The path is a text file with, in each row, x y z, or x y z yaw with the yaw in radians, or the 12 numbers of a
3x4 matrix, row by row.""",
        epilog="""examples:
  potclient risk --path path.txt --sphere 0 0 0.3 0.35
  potclient risk --path poses.txt --sphere 0.3 0 0.4 0.4 --sphere -0.3 0 0.4 0.4 --unknown prior
  potclient risk --path path.txt --sphere 0 0 0 0.3 --2d --json risk.json""",
    )
    parser.add_argument(
        "--path", type=Path, required=True, metavar="FILE", help="poses, m and rad; .npy, or text rows"
    )
    parser.add_argument(
        "--sphere",
        type=float,
        nargs=4,
        action="append",
        required=True,
        metavar=("X", "Y", "Z", "R"),
        help="centre in the body frame and radius, m; may be repeated",
    )
    add_unknown_argument(parser, "occupied")
    add_evidence_only_argument(parser)
    parser.add_argument(
        "--resolution", type=positive, metavar="METRES", help="cell edge (default: half the smallest radius)"
    )
    parser.add_argument(
        "--correlation", type=positive, metavar="METRES", help="edge of a cube that is one trial"
    )
    parser.add_argument("--2d", action="store_true", dest="planar", help="discs in the plane z = 0")
    add_json_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    path = _path_poses(arguments.path)
    with client_of(arguments) as client:
        answer = client.risk(
            path,
            arguments.sphere,
            unknown=arguments.unknown,
            resolution_m=arguments.resolution,
            correlation_m=arguments.correlation,
            dims=2 if arguments.planar else 3,
            evidence_only=arguments.evidence_only,
        )
    arrays = {name: getattr(answer, name).tolist() for name in _ARRAYS}
    write_json(arguments.json, {name: getattr(answer, name) for name in _TOTALS} | arrays)
    if arguments.json == "-":
        return EXIT_OK
    rows = [
        [
            str(i),
            *[f"{c:.2f}" for c in path[i, :3, 3]],
            f"{answer.max_probability[i]:.4f}",
            f"{answer.union_probability[i]:.4f}",
            f"{answer.unknown_share[i]:.1%}",
            f"{answer.borrowed_share[i]:.1%}",
        ]
        for i in range(min(len(path), _SHOWN))
    ]
    say_rows(["pose", "x", "y", "z", "max", "union", "unknown", "borrowed"], rows, len(path), "--json FILE")
    say(
        f"path: max {answer.path_max_probability:.4f}, union {answer.path_union_probability:.4f}, "
        f"{answer.path_unknown_share:.1%} unknown and {answer.path_borrowed_share:.1%} borrowed "
        f"of {answer.n_cells} cells of {answer.resolution_m:g} m, "
        f"revision {answer.revision}"
    )
    return EXIT_OK


def _path_poses(path: Path) -> Float64:
    """(P, 4, 4) from rows of x y z, x y z yaw, or 3x4 matrices."""
    rows = read_table(path, (3, 4, 12), "poses: x y z, x y z yaw, or 12 numbers of a 3x4 matrix")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if rows.shape[1] == 12:
        poses[:, :3] = rows.reshape(-1, 3, 4)
    elif rows.shape[1] == 4:
        for pose, (x, y, z, yaw) in zip(poses, rows, strict=True):
            pose[:] = yaw_pose(x, y, yaw, z)
    else:
        poses[:, :3, 3] = rows
    return poses
