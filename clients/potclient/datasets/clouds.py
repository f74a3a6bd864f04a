"""Folders of files of points, with a pose file beside them, a VIEWPOINT in each PCD header, or no poses for one scan alone."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from potclient.arrays import Float64, Floats
from potclient.datasets.files import AUTO_LAYOUT, kind_of, read_beams, read_viewpoint
from potclient.datasets.files.arrays import cloud_name
from potclient.datasets.scans import RecordedScan, Recording, natural_key, read_stamps, stamps_of_names
from potclient.datasets.trajectory import POSE_FILES, find_poses, other_poses, place_scans
from potclient.errors import DatasetError

RECORDING_FILE = "recording.json"
FRAMES = ("auto", "sensor", "world")
TIMES_FILE = "times.txt"


class CloudFolder(Recording):
    """A folder of files of points of one kind in natural order (scan_2 before scan_10), or a single file.

    Stamps come from `times.txt` (seconds a line), or from the names of the files where all are times. `recording.json` with
    `"is_planar": true` says that a 2D scanner took the scans (z = 0). Where the files have a field `is_return`, points with 0
    there are beams without an echo, free up to the point.

    Args:
        path: The folder or file; see `potclient.datasets.files` for the kinds. Files may lie in folders in the folder.
        poses: Pose file to use instead of one of `POSE_FILES`; relative names are looked up in the folder first.
        frame: Where the points are. "sensor": sensor frame. "world": the map frame already, and poses say only where the sensor
            was. "auto": sensor if there are poses, else world if a VIEWPOINT is not the origin.
        origin: (3,) m, where the beams begin in the frame of the points, for files in a vehicle's frame; default (0, 0, 0).
        layout: Of binary files, see `potclient.datasets.files.binary`.
        needs_poses: False: somebody else places the scans, which all come with the pose of the origin.
    Raises:
        DatasetError: something is missing or does not fit together.
    """

    format = "clouds"

    def __init__(
        self,
        path: Path,
        *,
        poses: str | Path | None = None,
        frame: str = "auto",
        origin: Sequence[float] | None = None,
        layout: str = AUTO_LAYOUT,
        needs_poses: bool = True,
    ) -> None:
        super().__init__(path)
        if frame not in FRAMES:
            raise DatasetError(f"frame {frame!r}: need one of {', '.join(FRAMES)}")
        self._folder = path if path.is_dir() else path.parent
        self._files = _one_kind(path) if path.is_dir() else [path]
        self._layout, self._origin = layout, _origin(origin)
        self._poses: Float64 | None = None  # None: each file's VIEWPOINT
        self._points_in_world = frame == "world"
        times = self._folder / TIMES_FILE if path.is_dir() else None
        stamps = None if times is not None and times.is_file() else stamps_of_names(self._files)
        self._stamps = stamps or read_stamps(times, len(self._files))
        self._used = [self._folder / TIMES_FILE, self._folder / RECORDING_FILE]
        if needs_poses:
            self._place(
                poses, frame, stamps or (self._stamps if times is not None and times.is_file() else None)
            )
        else:
            self._poses = np.tile(np.eye(4), (len(self._files), 1, 1))
        self._is_planar = path.is_dir() and _is_planar(self._folder / RECORDING_FILE)
        self.notes = (*self.notes, *self._layout_note())

    def __len__(self) -> int:
        return len(self._files)

    @property
    def used(self) -> frozenset[Path]:
        return frozenset((*self._files, *self._used))

    def read(self, i: int) -> RecordedScan:
        file = self._files[i]
        points, is_return, _ = read_beams(file, self._layout)
        pose = read_viewpoint(file) if self._poses is None else self._poses[i]
        if self._points_in_world:
            points = (points.astype(np.float64) - pose[:3, 3]) @ pose[:3, :3]
        if self._origin is not None:
            points, pose = moved_origin(points, pose, self._origin)
        points = points.astype(np.float32)  # only now: world coordinates need doubles
        finite = np.isfinite(points).all(axis=1)
        return RecordedScan(
            points=np.ascontiguousarray(points[finite]),
            is_return=is_return[finite],
            T_map_sensor=pose,
            stamp_ns=self._stamps[i],
            name=file.relative_to(self._folder).as_posix(),
            is_planar=self._is_planar,
        )

    def _place(self, poses: str | Path | None, frame: str, stamps: list[int] | None) -> None:
        """Find each file's pose, and drop the files that have none."""
        n = len(self._files)
        pose_file = find_poses(self._folder, poses) if self.path.is_dir() or poses is not None else None
        has_viewpoints = kind_of(self._files[0]) == "PCD" and any(
            np.any(read_viewpoint(f)[:3, 3] != 0) for f in (self._files[0], self._files[-1])
        )
        if pose_file is not None and not (frame == "world" and has_viewpoints and poses is None):
            placed = place_scans(pose_file, n, stamps)
            self._files = [self._files[i] for i in placed.scans]
            self._stamps = placed.stamps_ns or [self._stamps[i] for i in placed.scans]
            self._poses = placed.poses
            self._used.append(pose_file)
            self.notes = (placed.note, *(alternatives(self._folder, pose_file, n)))
        elif has_viewpoints:
            self._points_in_world = frame != "sensor"
            where = "map frame" if self._points_in_world else "sensor frame"
            self.notes = (
                f"no poses.txt: sensor at each VIEWPOINT, points taken as {where} (--frame changes that)",
            )
        elif n == 1:
            self._poses = np.eye(4)[None]
            self.notes = ("no poses: the one scan is at the origin",)
        else:
            raise DatasetError(without_poses(self.path, self._files))

    def _layout_note(self) -> tuple[str, ...]:
        if kind_of(self._files[0]) not in ("binary", "nuScenes"):
            return ()
        return (read_beams(self._files[0], self._layout).layout,)


def moved_origin(points: Floats, pose: Float64, origin: Float64) -> tuple[Floats, Float64]:
    """Points and pose of a frame that begins at the origin of the beams, (3,) m, given in the frame of the points."""
    moved = pose.copy()
    moved[:3, 3] = pose[:3, :3] @ origin + pose[:3, 3]
    return points.astype(np.float64) - origin, moved


def cloud_files(folder: Path) -> list[Path]:
    """The files of points in a folder, or in its folders if it has none itself, in natural order.

    An .npz that holds no cloud is none.
    """
    here = [f for f in folder.iterdir() if kind_of(f) is not None and f.is_file()]
    found = here or [f for f in folder.rglob("*") if kind_of(f) is not None and f.is_file()]
    clouds = [f for f in found if kind_of(f) != "npz" or _holds_cloud(f)]
    return sorted(clouds, key=lambda f: [natural_key(Path(part)) for part in f.relative_to(folder).parts])


def without_poses(path: Path, files: Sequence[Path]) -> str:
    """What is missing to play clouds that nobody placed, and the commands that would work."""
    lines = [
        f"{path}: {len(files)} clouds ({files[0].name}, ...) and no poses: none of {', '.join(POSE_FILES)}"
    ]
    for name, found in other_poses(path):
        fits = "fits" if len(found.poses) == len(files) else f"does not fit {len(files)} scans"
        lines.append(f"{name} holds {_said_poses(len(found.poses), found.form)} and {fits}")
    lines.append(
        "name a pose file (KITTI rows of 12 numbers, TUM, or a graph's vertices) with --poses FILE, or let odometry place the"
        f" scans: potclient publish {path} --odometry kiss-icp, or play one scan alone: potclient publish {files[0]}"
    )
    return "; ".join(lines)


def alternatives(folder: Path, taken: Path, n_scans: int) -> list[str]:
    """Notes on pose files that would fit too and were not taken."""
    return [
        f"{name} also holds {_said_poses(n_scans, found.form)}: --poses {name}"
        for name, found in other_poses(folder, taken)
        if len(found.poses) == n_scans
    ]


def _said_poses(n: int, form: str) -> str:
    return f"{n} pose{'s' if n != 1 else ''} ({form})"


def _one_kind(folder: Path) -> list[Path]:
    files = cloud_files(folder)
    if not files:
        raise DatasetError(f"{folder}: no files of points in it")
    kinds: dict[str, list[Path]] = {}
    for file in files:
        kinds.setdefault(str(kind_of(file)), []).append(file)
    if len(kinds) > 1:
        there = ", ".join(
            f"{len(of)} {kind} ({', '.join(f.name for f in of[:2])}{', ...' if len(of) > 2 else ''})"
            for kind, of in sorted(kinds.items())
        )
        raise DatasetError(
            f"{folder}: holds {there}; keep one kind in a folder, or name a file: potclient publish {files[0]}"
        )
    return files


def _holds_cloud(path: Path) -> bool:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return cloud_name(arrays) is not None
    except (OSError, ValueError, EOFError):
        return True  # reading it says what is wrong with it


def _origin(origin: Sequence[float] | None) -> Float64 | None:
    if origin is None:
        return None
    place = np.asarray(origin, np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise DatasetError(f"origin {origin}: need x y z in metres")
    return place


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
