"""`--pose`, of a map that is merged: for `potclient map merge` and `potserver map merge`."""

from __future__ import annotations

import argparse
import math

import numpy as np

from potclient.arrays import Float64


def add_pose_flag(parser: argparse.ArgumentParser) -> None:
    """Add `--pose X Y Z YAW`."""
    parser.add_argument(
        "--pose",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "YAW"),
        help="merge: where the origin of the map that is taken in lies in the other, m, and by how many degrees it is turned",
    )


def pose_of(x_m: float, y_m: float, z_m: float, yaw_deg: float) -> Float64:
    """(4, 4) transform of what `--pose` says."""
    c, s = math.cos(math.radians(yaw_deg)), math.sin(math.radians(yaw_deg))
    return np.array([[c, -s, 0, x_m], [s, c, 0, y_m], [0, 0, 1, z_m], [0, 0, 0, 1]], np.float64)
