"""PCD files: ascii, binary and compressed, by pypcd4."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.files.beams import Beams, beams_of_columns
from potclient.datasets.files.parsing import parsing
from potclient.errors import DatasetError
from potclient.poses import quaternion_pose


def read_pcd(path: Path) -> Beams:
    """The points of a PCD file.

    Raises:
        DatasetError: not such a file, truncated, or without x y z.
    """
    with parsing(path, "PCD file"):
        from pypcd4 import PointCloud

        cloud = PointCloud.from_path(path)
    data = np.atleast_1d(cloud.pc_data)
    if len(data) != cloud.metadata.points:
        raise DatasetError(f"{path}: truncated, {len(data)} of {cloud.metadata.points} points")
    return beams_of_columns(path, data, tuple(data.dtype.names or ()))


def read_viewpoint(path: Path) -> Float64:
    """(4, 4): the VIEWPOINT of a PCD header (tx ty tz qw qx qy qz); identity if there is none.

    Raises:
        DatasetError: it is not seven numbers, the quaternion is zero, or a number is not finite.
    """
    with path.open("rb") as file:
        head = file.read(4096)
    for line in head.split(b"\n"):
        if line.startswith(b"DATA"):
            break
        if line.startswith(b"VIEWPOINT"):
            try:
                tx, ty, tz, w, x, y, z = (float(v) for v in line.split()[1:])
            except ValueError as error:
                raise DatasetError(
                    f"{path}: VIEWPOINT must be seven numbers, tx ty tz qw qx qy qz"
                ) from error
            norm = float(np.sqrt(w * w + x * x + y * y + z * z))
            if not norm > 0:
                raise DatasetError(f"{path}: VIEWPOINT has a quaternion of length {norm}")
            try:
                return quaternion_pose(np.array([tx, ty, tz]), np.array([w, x, y, z]))
            except ValueError as error:
                raise DatasetError(f"{path}: VIEWPOINT: {error}") from error
    return np.eye(4)
