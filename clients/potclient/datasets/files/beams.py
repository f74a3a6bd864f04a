"""What a file of points holds, whoever wrote it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Floats
from potclient.errors import DatasetError


class Beams(NamedTuple):
    """The points of one file."""

    points: (
        Floats  # (N, 3) m, in the file's frame; float64 where the file has numbers that float32 cannot hold
    )
    is_return: Bool  # (N,) false = no echo: the beam was free up to the point
    layout: str = ""  # what was assumed, where the file does not say itself


def beams_of_columns(path: Path, data: Any, names: Sequence[str]) -> Beams:
    """Beams of a table with columns by name: x y z, and `is_return` where there is one.

    Raises:
        DatasetError: a coordinate is missing, or not a number.
    """
    if not {"x", "y", "z"} <= set(names):
        raise DatasetError(f"{path}: fields {' '.join(names)}, need x y z")
    columns = [np.asarray(data[axis]) for axis in "xyz"]
    if any(column.dtype.kind not in "fiu" for column in columns):
        raise DatasetError(f"{path}: x y z are {', '.join(str(c.dtype) for c in columns)}, need numbers")
    dtype = np.result_type(np.float32, *(column.dtype for column in columns))
    points = np.stack([column.astype(dtype) for column in columns], axis=1)
    if "is_return" not in names:
        return Beams(points, np.ones(len(points), np.bool_))
    return Beams(points, np.asarray(data["is_return"]) != 0)


def beams_of_rows(path: Path, rows: Any) -> Beams:
    """Beams of an array (N, 3 or more), x y z first; pictures of points (H, W, 3 or more) are taken row by row.

    Raises:
        DatasetError: another shape, or no numbers.
    """
    array = np.asarray(rows)
    if not is_cloud_array(array):
        raise DatasetError(
            f"{path}: an array {array.shape} of {array.dtype}, need (N, 3) or more numbers, x y z first"
        )
    flat = array.reshape(-1, array.shape[-1])[:, :3]
    points = flat.astype(np.result_type(np.float32, flat.dtype))
    return Beams(points, np.ones(len(points), np.bool_))


def is_cloud_array(array: Any) -> bool:
    """Whether an array has the shape and type of points, x y z first."""
    return bool(array.dtype.kind in "fiu" and array.ndim in (2, 3) and 3 <= array.shape[-1] <= 32)
