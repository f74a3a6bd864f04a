"""`--pose`, of a map that is merged: for `potclient map merge` and `potserver map merge`."""

from __future__ import annotations

import argparse
import math

from potclient.arrays import Float64
from potclient.poses import yaw_pose


def add_pose_flag(parser: argparse.ArgumentParser) -> None:
    """Add `--pose X Y Z YAW`."""
    parser.add_argument(
        "--pose",
        type=float,
        nargs=4,
        default=None,
        metavar=("X", "Y", "Z", "YAW"),
        help="where the origin of the map that is taken in lies in the other, m, and its yaw in degrees",
    )


def pose_of(x_m: float, y_m: float, z_m: float, yaw_deg: float) -> Float64:
    """(4, 4) transform of what `--pose` says."""
    return yaw_pose(x_m, y_m, math.radians(yaw_deg), z_m)
