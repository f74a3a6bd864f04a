"""OctoMap (Hornung et al. 2013), by its own library: clamped log-odds in voxels, every voxel of a scan counted once."""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Bool, Float64
from potclient.datasets import RecordedScan
from potclient.extras import how_to_install
from potserver.errors import SettingsError
from potserver.evaluation.mappers import Answer, Mapper, Size
from potserver.numerics.geometry import voxel_pick

_SAME_LENGTH = 1e-3  # relative


class OctoMap(Mapper):
    """OctoMap with its library's own sensor model: hit 0.7, miss 0.4, clamped to 0.12 and 0.97.

    End points are put into the middle of their voxel and taken once, as its `discretize` does. Beams without an echo are free
    up to their length.

    Args:
        resolution_m: Edge of a voxel.
    Raises:
        SettingsError: the library is not installed.
    """

    def __init__(self, resolution_m: float) -> None:
        self.name = f"OctoMap {resolution_m:g} m"
        try:
            library: Any = importlib.import_module("pyoctomap")
        except ImportError as error:
            raise SettingsError(f"OctoMap needs its library: {how_to_install('peers')} ({error})") from error
        self._tree = library.OcTree(resolution_m)
        self._resolution_m = resolution_m

    def integrate(self, scan: RecordedScan) -> dict[str, float]:
        origin = scan.T_map_sensor[:3, 3].copy()
        beams = scan.in_map - origin
        reach_m = -1.0
        if not scan.is_return.all():
            # the library knows a beam without an echo as one that is longer than its reach
            length = np.linalg.norm(beams[~scan.is_return], axis=1)
            reach_m = float(length.max())
            if length.min() < reach_m * (1 - _SAME_LENGTH):
                raise SettingsError(
                    f"OctoMap: beams without an echo of {length.min():.2f} to {reach_m:.2f} m in one scan; it takes those "
                    "of one length: limit it with --max-range"
                )
            beams = np.where(scan.is_return[:, None], beams, beams * (1 + 2 * _SAME_LENGTH))
            reach_m *= 1 + _SAME_LENGTH
        ends = _centred(beams + origin, origin, scan.is_return, reach_m, self._resolution_m)
        self._tree.insertPointCloud(ends[voxel_pick(ends, self._resolution_m)], origin, reach_m)
        return {}

    def occupancy(self, points: Float64) -> Answer:
        probability, known = np.full(len(points), 0.5), np.zeros(len(points), np.bool_)
        search = self._tree.search
        for i, point in enumerate(np.ascontiguousarray(points, np.float64)):
            node = search(point)
            if node is not None:
                probability[i], known[i] = node.getOccupancy(), True
        return Answer(np.clip(probability, 0.0, 1.0), known)

    def size(self) -> Size:
        with tempfile.TemporaryDirectory() as folder:
            path = str(Path(folder) / "copy.ot")
            self._tree.write(path)
            n_bytes = Path(path).stat().st_size
            # of a copy: writing a binary file leaves nothing but occupied and free in the tree itself
            binary = self._tree.read(path).writeBinary()
        return Size(int(self._tree.getNumLeafNodes()), n_bytes, len(binary))


def _centred(ends: Float64, origin: Float64, is_return: Bool, reach_m: float, edge_m: float) -> Float64:
    """End points with an echo in the middle of their voxels, where that is not beyond the reach."""
    centre = (np.floor(ends / edge_m) + 0.5) * edge_m
    moved = is_return & ((reach_m < 0) | (np.linalg.norm(centre - origin, axis=1) < reach_m))
    return np.where(moved[:, None], centre, ends)
