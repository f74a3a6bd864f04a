"""Where the tables are measured: made-up towns in place of the paper's, and recordings in a folder that the caller names."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np

from potclient.datasets import RecordedScan, Recording
from potserver.domain.types import yaw_pose
from potserver.errors import SettingsError
from potserver.numerics.geometry import yaw_of
from potserver.recordings import Reader, open_recording

REACH_M = 20.0  # of beams, as in the paper's code
_LEVEL_RAD = np.deg2rad(0.2)  # of a beam of the ring nearest to the horizontal


class Scene(NamedTuple):
    """One domain."""

    name: str
    dataset: str  # a path that does not begin with "town:" is looked for in the folder of data
    planar: bool
    first: int = 0  # scans before it are left to atoms
    every: int = 5  # scans: 4 m of a town's street
    min_range_m: float = 0.0
    is_ring: bool = False  # one level ring of a 3D recording, as a planar scanner sees

    @property
    def key(self) -> str:
        """For file names."""
        return self.name.lower().replace(" ", "-").replace(",", "")


_STYLES = ("terraces", "suburb", "downtown")  # for the paper's Towns 1 to 3
TOWNS_2D = tuple(
    Scene(f"Town {k + 1}, 2D", f"town:{style}:2d:{21 + k}", True, first=10) for k, style in enumerate(_STYLES)
)
TOWNS_3D = tuple(
    Scene(f"Town {k + 1}, 3D", f"town:{style}:vlp16:{21 + k}", False, first=10)
    for k, style in enumerate(_STYLES)
)
CARS = Scene("cars town, 2D", "town:terraces:2d:dynamic:31", True, first=10)
KITTI_RING = Scene("KITTI, level ring", "kitti_raw_drive0005", True, every=1, min_range_m=2.5, is_ring=True)
KITTI = Scene("KITTI, 3D", "kitti_raw_drive0005", False, every=1, min_range_m=2.5)
LAB = Scene("Intel lab, 2D", "intel_lab_2d", True, every=15)
RECORDED = (KITTI_RING, KITTI, LAB)


class NoDataError(SettingsError):
    """A recording is not there."""


class LevelRing(Recording):
    """The beams of a 3D recording that are nearest to level, as a planar scanner would give them.

    Args:
        source: In three dimensions.
    """

    format = "ring"

    def __init__(self, source: Recording) -> None:
        super().__init__(source.path)
        self._source = source

    def __len__(self) -> int:
        return len(self._source)

    def read(self, i: int) -> RecordedScan:
        scan = self._source[i]
        elevation = np.arctan2(scan.points[:, 2], np.hypot(scan.points[:, 0], scan.points[:, 1]))
        level = np.abs(elevation) < _LEVEL_RAD
        x, y, _ = scan.T_map_sensor[:3, 3]
        return dataclasses.replace(
            scan,
            points=scan.points[level] * np.array([1, 1, 0], np.float32),
            is_return=scan.is_return[level],
            T_map_sensor=yaw_pose(float(x), float(y), yaw_of(scan.T_map_sensor)),
            is_planar=True,
        )


def open_scene(scene: Scene, data: Path | None, drive: int) -> Recording:
    """A domain's scans, with beams cut at 20 m.

    Args:
        scene: Which.
        data: Folder of the recordings; none: there are none.
        drive: Scans of a town, at 10 Hz.
    Raises:
        NoDataError: it is a recording, and it is not there.
    """
    dataset = scene.dataset
    if not dataset.startswith("town:"):
        path = None if data is None else data / dataset
        if path is None or not path.exists():
            raise NoDataError(f"no {dataset} in the folder of --data")
        dataset = str(path)
    reader = Reader(min_range_m=scene.min_range_m, max_range_m=REACH_M, n_generated=drive)
    recording = open_recording(dataset, reader)
    return LevelRing(recording) if scene.is_ring else recording
