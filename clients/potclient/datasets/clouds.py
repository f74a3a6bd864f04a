"""Folders of PCD or PLY files, with poses.txt beside them or a VIEWPOINT in each header."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from potclient.arrays import Bool, Float64, Floats
from potclient.datasets.scans import RecordedScan, Recording, natural_key, read_poses, read_stamps
from potclient.errors import DatasetError
from potclient.poses import quaternion_rotation

RECORDING_FILE = "recording.json"
FRAMES = ("auto", "sensor", "world")


class CloudFolder(Recording):
    """A folder of .pcd or .ply files in natural order (scan_2 before scan_10), or a single file.

    Args:
        path: The folder or file. `poses.txt` in it gives T_map_sensor a line; `times.txt` seconds a line; `recording.json`
            with `"is_planar": true` says that a 2D scanner took the scans (z = 0). Where the files have a field `is_return`,
            points with 0 there are beams without an echo, free up to the point.
        poses: Another pose file; relative names are looked up in the folder first.
        frame: Where the points are. "sensor": sensor frame. "world": the map frame already, and the header's VIEWPOINT is only
            the place of the sensor. "auto": sensor if there are poses, else world if a VIEWPOINT is not the origin.
    Raises:
        DatasetError: something is missing or does not fit together.
    """

    format = "clouds"

    def __init__(self, path: Path, *, poses: Path | None = None, frame: str = "auto") -> None:
        super().__init__(path)
        if frame not in FRAMES:
            raise DatasetError(f"frame {frame!r}: need one of {', '.join(FRAMES)}")
        folder = path if path.is_dir() else path.parent
        self._files = cloud_files(path) if path.is_dir() else [path]
        if not self._files:
            raise DatasetError(f"{path}: no .pcd or .ply files")
        suffixes = {f.suffix.lower() for f in self._files}
        if len(suffixes) > 1:
            raise DatasetError(
                f"{path}: holds {' and '.join(sorted(suffixes))} files; keep one kind in a folder"
            )
        n = len(self._files)
        pose_file = _named(folder, poses) if poses is not None else folder / "poses.txt"
        self._poses: Float64 | None = None
        self._points_in_world = frame == "world"
        if path.is_dir() and pose_file.is_file() and not self._points_in_world:
            self._poses = read_poses(pose_file, n)
            self.notes = (f"poses from {pose_file.name}",)
        elif suffixes == {".pcd"}:
            placed = any(np.any(read_viewpoint(f)[:3, 3] != 0) for f in (self._files[0], self._files[-1]))
            if not placed and n > 1:
                raise DatasetError(f"{path}: no poses.txt and no VIEWPOINT; name a pose file with --poses")
            self._points_in_world = frame == "world" or (frame == "auto" and placed)
            where = "map frame" if self._points_in_world else "sensor frame"
            self.notes = (
                f"no poses.txt: sensor at each VIEWPOINT, points taken as {where} (--frame changes that)",
            )
        elif n == 1:
            self._poses = np.eye(4)[None]
            self.notes = ("no poses.txt: the one scan is at the origin",)
        else:
            raise DatasetError(f"{path}: no poses.txt; name a pose file with --poses")
        self._is_planar = path.is_dir() and _is_planar(folder / RECORDING_FILE)
        self._stamps = read_stamps(folder / "times.txt" if path.is_dir() else None, n)

    def __len__(self) -> int:
        return len(self._files)

    def read(self, i: int) -> RecordedScan:
        file = self._files[i]
        points, is_return = read_beams(file)
        pose = read_viewpoint(file) if self._poses is None else self._poses[i]
        if self._points_in_world:
            points = (points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
        points = points.astype(np.float32)  # only now: world coordinates need doubles
        finite = np.isfinite(points).all(axis=1)
        return RecordedScan(
            points=np.ascontiguousarray(points[finite]),
            is_return=is_return[finite],
            T_map_sensor=pose,
            stamp_ns=self._stamps[i],
            name=file.name,
            is_planar=self._is_planar,
        )


def cloud_files(folder: Path) -> list[Path]:
    """The .pcd and .ply files of a folder, in natural order."""
    return sorted((f for f in folder.iterdir() if f.suffix.lower() in (".pcd", ".ply")), key=natural_key)


def read_cloud(path: Path) -> Floats:
    """(N, 3) m: x, y, z of a PCD (ascii, binary, compressed) or PLY file; NaN where the file says so.

    float32, or float64 where the file has numbers that float32 cannot hold.

    Raises:
        DatasetError: not such a file, truncated, or without x y z.
    """
    return read_beams(path)[0]


def read_beams(path: Path) -> tuple[Floats, Bool]:
    """(N, 3) m and (N,): the points of a file as `read_cloud`, and whether each is an echo (all are, without `is_return`).

    Raises:
        DatasetError: as `read_cloud`.
    """
    return _read_pcd(path) if path.suffix.lower() == ".pcd" else _read_ply(path)


def _is_planar(path: Path) -> bool:
    if not path.is_file():
        return False
    try:
        is_planar = json.loads(path.read_text()).get("is_planar", False)
    except (OSError, ValueError, AttributeError) as error:
        raise DatasetError(f"{path}: need a JSON object ({error})") from error
    if not isinstance(is_planar, bool):
        raise DatasetError(f"{path}: is_planar must be true or false, not {is_planar!r}")
    return is_planar


def _read_pcd(path: Path) -> tuple[Floats, Bool]:
    try:
        from pypcd4 import PointCloud
    except ImportError as error:
        raise DatasetError(f"{path}: reading PCD needs the package pypcd4: pip install pypcd4") from error
    try:
        cloud = PointCloud.from_path(path)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # pypcd4 raises whatever its parsers raise
        raise DatasetError(f"{path}: not a readable PCD file ({_short(error)})") from error
    data = np.atleast_1d(cloud.pc_data)
    if len(data) != cloud.metadata.points:
        raise DatasetError(f"{path}: truncated, {len(data)} of {cloud.metadata.points} points")
    return _beams(path, data, tuple(data.dtype.names or ()))


def _read_ply(path: Path) -> tuple[Floats, Bool]:
    try:
        from plyfile import PlyData
    except ImportError as error:
        raise DatasetError(f"{path}: reading PLY needs the package plyfile: pip install plyfile") from error
    try:
        data = PlyData.read(str(path))["vertex"].data  # mapped: 50 times faster than reading rows
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error})") from error
    except Exception as error:  # plyfile raises whatever its parsers raise
        raise DatasetError(f"{path}: not a readable PLY file with vertices ({_short(error)})") from error
    return _beams(path, data, tuple(data.dtype.names or ()))


def _beams(path: Path, data: Any, names: tuple[str, ...]) -> tuple[Floats, Bool]:
    if not {"x", "y", "z"} <= set(names):
        raise DatasetError(f"{path}: fields {' '.join(names)}, need x y z")
    dtype = np.result_type(np.float32, *(data[axis].dtype for axis in "xyz"))
    points = np.stack([np.asarray(data[axis], dtype) for axis in "xyz"], axis=1)
    if "is_return" not in names:
        return points, np.ones(len(points), np.bool_)
    return points, np.asarray(data["is_return"]) != 0


def read_viewpoint(path: Path) -> Float64:
    """(4, 4): the VIEWPOINT of a PCD header (tx ty tz qw qx qy qz); identity if there is none.

    Raises:
        DatasetError: it is not seven numbers, or the quaternion is zero.
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
            pose = np.eye(4)
            pose[:3, :3] = quaternion_rotation(w / norm, x / norm, y / norm, z / norm)
            pose[:3, 3] = tx, ty, tz
            return pose
    return np.eye(4)


def _named(folder: Path, poses: Path) -> Path:
    for candidate in (folder / poses, poses):
        if candidate.is_file():
            return candidate
    raise DatasetError(f"poses: no file {poses} in {folder} or here")


def _short(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__
