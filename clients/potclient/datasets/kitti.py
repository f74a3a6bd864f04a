"""The KITTI odometry layout: velodyne/*.bin, poses of the left camera, and the calibration between the two."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.scans import RecordedScan, Recording, natural_key, read_poses, read_stamps
from potclient.errors import DatasetError

_FIELDS, _SWEEP_FIELDS = "x y z reflectance", "x y z intensity ring"


class KittiRecording(Recording):
    """A KITTI sequence.

    KITTI gives poses of camera 0 (x right, y down, z forward); the sensor's pose is inv(Tr) P Tr with `Tr` of calib.txt, in a
    map frame that is the velodyne at the first pose. A pose file whose name contains "velo" is taken as it is.

    Files called `*.pcd.bin` are nuScenes' sweeps: five numbers a point, the last of them the ring.

    Args:
        path: Folder with `velodyne/`; poses in `poses.txt`, or in the official place `../../poses/<sequence>.txt`.
        poses: Another pose file; relative names are looked up in the folder first.
    Raises:
        DatasetError: something is missing or does not fit together.
    """

    format = "kitti"

    def __init__(self, path: Path, *, poses: Path | None = None) -> None:
        super().__init__(path)
        self._files = sorted((path / "velodyne").glob("*.bin"), key=natural_key)
        if not self._files:
            raise DatasetError(f"{path}: no velodyne/*.bin, so not a KITTI odometry sequence")
        pose_file = _find_poses(path, poses)
        self._poses = read_poses(pose_file, len(self._files))
        if "velo" in pose_file.name:
            self.notes = (f"poses of the velodyne from {pose_file.name}",)
        else:
            Tr = _read_tr(path / "calib.txt")
            self._poses = np.linalg.inv(Tr) @ self._poses @ Tr
            self.notes = (
                f"poses of camera 0 from {pose_file.name}, moved to the velodyne with Tr of calib.txt",
            )
        self._stamps = read_stamps(path / "times.txt", len(self._files))

    def __len__(self) -> int:
        return len(self._files)

    def read(self, i: int) -> RecordedScan:
        file = self._files[i]
        data = file.read_bytes()
        fields = _SWEEP_FIELDS if file.name.lower().endswith(".pcd.bin") else _FIELDS
        n_fields = len(fields.split())
        if len(data) % (4 * n_fields):
            raise DatasetError(
                f"{file}: {len(data)} bytes are not whole points of {n_fields} float32 ({fields})"
            )
        points = np.frombuffer(data, "<f4").reshape(-1, n_fields)[:, :3]
        return RecordedScan(
            points=np.ascontiguousarray(points, np.float32),
            is_return=np.ones(len(points), np.bool_),
            T_map_sensor=self._poses[i],
            stamp_ns=self._stamps[i],
            name=file.name,
        )


def _find_poses(path: Path, named: Path | None) -> Path:
    if named is not None:
        for candidate in (path / named, named):
            if candidate.is_file():
                return candidate
        raise DatasetError(f"poses: no file {named} in {path} or here")
    candidates = [path / "poses.txt", path.resolve().parents[1] / "poses" / f"{path.resolve().name}.txt"]
    candidates += sorted(path.glob("poses_velo*.txt"))
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    raise DatasetError(f"{path}: no poses.txt; name a pose file with --poses")


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
