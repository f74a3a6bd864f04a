"""Logs of Argoverse 2: sweeps in the vehicle's frame, taken by two lidars at once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.clouds import moved_origin
from potclient.datasets.files.beams import beams_of_columns
from potclient.datasets.files.feather import read_table
from potclient.datasets.scans import RecordedScan, Recording, growing
from potclient.errors import DatasetError
from potclient.poses import quaternion_pose

_SWEEPS = ("sensors", "lidar")
_POSES = "city_SE3_egovehicle.feather"
_CALIBRATION = ("calibration", "egovehicle_SE3_sensor.feather")
_LASERS_EACH = 32
_LIDARS = ("up_lidar", "down_lidar")  # laser numbers 0 to 31 and 32 to 63


class Argoverse2Log(Recording):
    """A log of Argoverse 2's sensor dataset: each sweep is two scans, one of each lidar, with its own place as the origin.

    Points are in the vehicle's frame; their beams begin where the calibration puts `up_lidar` and `down_lidar`. A scan keeps
    the axes of the vehicle.

    Args:
        path: Folder with `sensors/lidar/*.feather`, `city_SE3_egovehicle.feather` and `calibration/`.
    Raises:
        DatasetError: something is missing, or a sweep has no pose at its stamp.
    """

    format = "argoverse2"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._files = sorted(path.joinpath(*_SWEEPS).glob("*.feather"))
        if not self._files:
            raise DatasetError(f"{path}: no {'/'.join(_SWEEPS)}/*.feather, so not a log of Argoverse 2")
        try:
            stamps = [int(file.stem) for file in self._files]
        except ValueError as error:
            raise DatasetError(f"{path}: the name of a sweep must be its stamp in ns ({error})") from error
        poses, calibration = path / _POSES, path.joinpath(*_CALIBRATION)
        self._used = (poses, calibration)
        table = _poses_of(poses, "timestamp_ns")
        lost = [file.name for file, stamp in zip(self._files, stamps, strict=True) if stamp not in table]
        if lost:
            raise DatasetError(f"{poses}: no pose at the stamp of {lost[0]} ({len(lost)} sweeps have none)")
        self._poses = [table[stamp] for stamp in stamps]
        mounts = _poses_of(calibration, "sensor_name")
        missing = [name for name in _LIDARS if name not in mounts]
        if missing:
            raise DatasetError(f"{calibration}: no {' and no '.join(missing)}")
        self._origins = [mounts[name][:3, 3] for name in _LIDARS]
        self._stamps = growing([stamp for stamp in stamps for _ in _LIDARS])
        places = ", ".join(
            f"{name} at {' '.join(f'{v:.2f}' for v in origin)}"
            for name, origin in zip(_LIDARS, self._origins, strict=True)
        )
        self.notes = (f"poses from {_POSES}", f"two scans a sweep: {places} m in the vehicle's frame")

    def __len__(self) -> int:
        return len(_LIDARS) * len(self._files)

    @property
    def used(self) -> frozenset[Path]:
        return frozenset((*self._files, *self._used))

    def read(self, i: int) -> RecordedScan:
        sweep, lidar = divmod(i, len(_LIDARS))
        file = self._files[sweep]
        table = read_table(file)
        if "laser_number" not in table:
            raise DatasetError(f"{file}: fields {' '.join(table)}, need laser_number")
        beams = beams_of_columns(file, table, tuple(table))
        mine = table["laser_number"] // _LASERS_EACH == lidar
        mine &= np.isfinite(beams.points).all(axis=1)
        points, pose = moved_origin(beams.points[mine], self._poses[sweep], self._origins[lidar])
        return RecordedScan(
            points=points.astype(np.float32),
            is_return=beams.is_return[mine],
            T_map_sensor=pose,
            stamp_ns=self._stamps[i],
            name=f"{file.name}:{_LIDARS[lidar]}",
        )


def is_argoverse2(path: Path) -> bool:
    """Whether a folder looks like a log of Argoverse 2."""
    return path.joinpath(*_SWEEPS).is_dir() and (path / _POSES).is_file()


def _poses_of(path: Path, key: str) -> dict[Any, Float64]:
    """The poses of a table by the column `key`."""
    table = read_table(path)
    columns = (key, "tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")
    missing = [name for name in columns if name not in table]
    if missing:
        raise DatasetError(f"{path}: fields {' '.join(table)}, need {' '.join(missing)}")
    numbers = np.stack([np.asarray(table[name], np.float64) for name in columns[1:]], axis=1)
    try:
        return {
            k: quaternion_pose(row[:3], row[3:]) for k, row in zip(table[key].tolist(), numbers, strict=True)
        }
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from error
