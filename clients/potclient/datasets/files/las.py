"""LAS and LAZ files, by laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from potclient.datasets.files.beams import Beams, short
from potclient.errors import DatasetError


def read_las(path: Path) -> Beams:
    """The points of a LAS or LAZ file, in float64, scaled and moved as its header says.

    Raises:
        DatasetError: not such a file, or laspy is missing.
    """
    try:
        import laspy
    except ImportError as error:
        raise DatasetError(
            f"{path}: reading LAS needs the package laspy: pip install 'potserver[files]'"
        ) from error
    try:
        cloud = laspy.read(path)
        points = np.asarray(cloud.xyz, np.float64)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or short(error)})") from error
    except Exception as error:  # laspy and its decompressors raise errors of their own
        raise DatasetError(f"{path}: not a readable LAS file ({short(error)})") from error
    return Beams(points, np.ones(len(points), np.bool_))
