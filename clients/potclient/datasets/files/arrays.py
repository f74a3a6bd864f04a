"""numpy's files: .npy and .npz, never with pickles in them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from potclient.datasets.files.beams import Beams, beams_of_columns, beams_of_rows, is_cloud_array
from potclient.datasets.files.parsing import parsing
from potclient.errors import DatasetError

_CLOUD_NAMES = ("points", "xyz", "cloud", "point_cloud", "pointcloud", "pcd", "scan", "data", "arr_0")


def read_npy(path: Path) -> Beams:
    """The array of an .npy: (N, 3) or more, x y z first, or records with fields x y z.

    Raises:
        DatasetError: not such a file, damaged, or no points.
    """
    with parsing(path, ".npy"):
        return _beams(path, np.load(path, allow_pickle=False))


def read_npz(path: Path) -> Beams:
    """The cloud of an .npz: the array with a usual name (`points`, `xyz`, `data`, ...), or the only array. `is_return` counts.

    Raises:
        DatasetError: not such a file, damaged, or not one cloud in it.
    """
    with parsing(path, ".npz"), np.load(path, allow_pickle=False) as arrays:
        name = cloud_name(arrays)
        if name is None:
            raise DatasetError(f"{path}: {said_arrays(arrays)}: need one array of points, e.g. points (N, 3)")
        beams = _beams(path, arrays[name])
        if "is_return" not in arrays:
            return beams
        is_return = np.asarray(arrays["is_return"])
    if is_return.shape != (len(beams.points),):
        raise DatasetError(f"{path}: is_return {is_return.shape} for {len(beams.points)} points")
    return beams._replace(is_return=is_return != 0)


def cloud_name(arrays: Mapping[str, Any]) -> str | None:
    """The name of the array that is the cloud; None if there is none, or no telling which."""
    for name in _CLOUD_NAMES:
        if name in arrays and _is_cloud(arrays[name]):
            return name
    names = [name for name in arrays if name != "is_return"]
    return names[0] if len(names) == 1 and _is_cloud(arrays[names[0]]) else None


def said_arrays(arrays: Mapping[str, Any]) -> str:
    """The arrays with their shapes, for people."""
    return "holds " + (", ".join(f"{name} {arrays[name].shape}" for name in arrays) or "no array")


def _is_cloud(array: Any) -> bool:
    return is_cloud_array(array) or {"x", "y", "z"} <= set(array.dtype.names or ())


def _beams(path: Path, array: Any) -> Beams:
    if array.dtype.names:
        return beams_of_columns(path, array.reshape(-1), array.dtype.names)
    return beams_of_rows(path, array)
