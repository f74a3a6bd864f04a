"""LAS and LAZ files, by laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from potclient.datasets.files.beams import Beams
from potclient.datasets.files.parsing import parsing


def read_las(path: Path) -> Beams:
    """The points of a LAS or LAZ file, in float64, scaled and moved as its header says.

    Raises:
        DatasetError: not such a file, or laspy is missing.
    """
    with parsing(path, "LAS file"):
        import laspy

        points = np.asarray(laspy.read(path).xyz, np.float64)
    return Beams(points, np.ones(len(points), np.bool_))
