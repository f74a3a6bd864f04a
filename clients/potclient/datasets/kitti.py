"""The KITTI odometry layout: velodyne/*.bin, poses of the left camera, and the calibration between the two."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.clouds import TIMES_FILE, alternatives
from potclient.datasets.files import read_beams
from potclient.datasets.scans import RecordedScan, Recording, natural_key, read_stamps
from potclient.datasets.trajectory import find_poses, place_scans
from potclient.errors import DatasetError

_CALIBRATION = "calib.txt"


class KittiRecording(Recording):
    """A KITTI sequence.

    KITTI gives poses of camera 0 (x right, y down, z forward); the sensor's pose is inv(Tr) P Tr with `Tr` of calib.txt, in a
    map frame that is the velodyne at the first pose. A pose file whose name contains "velo" or "icp", or ends in .tum, has
    poses of the velodyne and is taken as it is.

    Files called `*.pcd.bin` are nuScenes' sweeps: five numbers a point, the last of them the ring.

    Args:
        path: Folder with `velodyne/`; poses in `poses.txt`, or in the official place `../../poses/<sequence>.txt`.
        poses: Another pose file; relative names are looked up in the folder first.
        needs_poses: False: somebody else places the scans, which all come with the pose of the origin.
    Raises:
        DatasetError: something is missing or does not fit together.
    """

    format = "kitti"

    def __init__(self, path: Path, *, poses: str | Path | None = None, needs_poses: bool = True) -> None:
        super().__init__(path)
        self._files = sorted((path / "velodyne").glob("*.bin"), key=natural_key)
        if not self._files:
            raise DatasetError(f"{path}: no velodyne/*.bin, so not a KITTI odometry sequence")
        n, times = len(self._files), path / TIMES_FILE
        self._stamps = read_stamps(times, n)
        self._used = [times]
        self._poses = np.tile(np.eye(4), (n, 1, 1))
        if needs_poses:
            pose_file = _find_poses(path, poses)
            placed = place_scans(pose_file, n, self._stamps if times.is_file() else None)
            self._files = [self._files[i] for i in placed.scans]
            self._stamps = [self._stamps[i] for i in placed.scans]
            self._used.append(pose_file)
            self._poses, frame = placed.poses, "of the velodyne"
            if not _is_of_velodyne(pose_file):
                Tr = _read_tr(path / _CALIBRATION)
                self._used.append(path / _CALIBRATION)
                self._poses = np.linalg.inv(Tr) @ self._poses @ Tr
                frame = f"of camera 0, moved to the velodyne with Tr of {_CALIBRATION}"
            self.notes = (f"{placed.note}, {frame}", *alternatives(path, pose_file, n))

    def __len__(self) -> int:
        return len(self._files)

    @property
    def used(self) -> frozenset[Path]:
        return frozenset((*self._files, *self._used))

    def read(self, i: int) -> RecordedScan:
        file = self._files[i]
        is_sweep = file.name.lower().endswith(".pcd.bin")
        points, is_return, _ = read_beams(file, "xyzir" if is_sweep else "xyzi")
        return RecordedScan(
            points=points.astype(np.float32),
            is_return=is_return,
            T_map_sensor=self._poses[i],
            stamp_ns=self._stamps[i],
            name=file.name,
        )


def _is_of_velodyne(pose_file: Path) -> bool:
    name = pose_file.name.lower()
    return "velo" in name or "icp" in name or name.endswith(".tum")


def _find_poses(path: Path, named: str | Path | None) -> Path:
    found = find_poses(path, named)
    official = path.resolve().parents[1] / "poses" / f"{path.resolve().name}.txt"
    if found is None and official.is_file():
        found = official
    found = found or next(iter(sorted(path.glob("poses_velo*.txt"))), None)
    if found is None:
        raise DatasetError(
            f"{path}: no poses.txt; name a pose file with --poses, or let odometry place the scans:"
            f" potclient publish {path} --odometry kiss-icp"
        )
    return found


def _read_tr(path: Path) -> Float64:
    """(4, 4): velodyne to camera 0."""
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise DatasetError(
            f"{path}: needed to move camera poses to the velodyne ({error.strerror}); "
            "or name poses of the velodyne with --poses poses_velo....txt"
        ) from error
    for line in lines:
        name, _, values = line.partition(":")
        if name.strip() in ("Tr", "Tr_velo_to_cam"):
            try:
                rows = np.asarray(values.split(), np.float64).reshape(3, 4)
            except ValueError as error:
                raise DatasetError(f"{path}: Tr must be 12 numbers") from error
            return np.concatenate([rows, [[0.0, 0.0, 0.0, 1.0]]])
    raise DatasetError(f"{path}: no line `Tr: ...` (velodyne to camera 0)")
