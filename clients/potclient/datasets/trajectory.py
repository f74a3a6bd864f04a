"""Files of poses - KITTI's, TUM's, NCLT's, and vertices of pose graphs - and which pose belongs to which scan."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.scans import natural_key, read_table, stamp_of
from potclient.errors import DatasetError
from potclient.poses import euler_pose, interpolate, quaternion_of, quaternion_pose

# Looked for in this order. Others are named to the reader of an error or a note.
POSE_FILES = ("poses.txt", "poses.tum", "trajectory.tum", "graph.txt")
_MAX_GAP_S = 1.0  # between poses: what a robot did in a longer one, nobody knows
_TEXTS = (".txt", ".tum", ".csv", ".g2o", ".graph")
_MAX_BYTES, _MAX_TEXTS = 100 << 20, 50  # beyond these, files are not looked into for poses
_VERTEX_WORDS = ("v", "VERTEX_SE3:QUAT")
_FIRST_US = 1e14  # numbers from here on are no seconds but microseconds since 1970
_Z_UP = np.diag([1.0, -1.0, -1.0, 1.0])  # north, east, down to north, west, up


class Trajectory(NamedTuple):
    """Poses in the order of their file."""

    poses: Float64  # (P, 4, 4) T_map_sensor
    stamps_ns: list[int] | None  # of TUM's and NCLT's files
    form: str  # for people


class Placed(NamedTuple):
    """The scans that have a pose."""

    scans: list[int]  # their numbers, ascending
    poses: Float64  # (len(scans), 4, 4)
    stamps_ns: list[int] | None  # of these scans, where either side knows them
    note: str


def read_trajectory(path: Path) -> Trajectory:
    """The poses of a file, T_map_sensor, in one of these forms; lines that start with # are skipped.

    - KITTI: 12 numbers a line (the top three rows of the matrix) or 16, row-major;
    - TUM: `stamp tx ty tz qx qy qz qw`, the stamp in seconds;
    - NCLT's ground truth: `utime, x, y, z, roll, pitch, heading`, us, m, radians, of the body in north, east, down. The map is
      turned to north, west, up; lines without numbers (nan) are left out, and `form` counts them;
    - a graph's vertices: `v0 x y z qx qy qz qw`, or g2o's `VERTEX_SE3:QUAT 0 x y z qx qy qz qw`, in order of their numbers.

    Raises:
        DatasetError: none of these, or a pose that is not rigid.
    """
    vertices = _vertices(path)
    if vertices is not None:
        return Trajectory(_quaternion_poses(path, vertices), None, "vertices of a graph")
    table = read_table(path, "poses")
    if table.shape[1] == 8:
        try:
            stamps = [stamp_of(seconds) for seconds in table[:, 0].tolist()]
        except ValueError as error:
            raise DatasetError(f"poses: {path}: {error}") from error
        if (np.diff(stamps) <= 0).any():
            raise DatasetError(f"poses: {path}: the stamps do not grow from line to line")
        return Trajectory(_quaternion_poses(path, table[:, 1:]), stamps, "TUM")
    if table.shape[1] == 7 and table[0, 0] >= _FIRST_US:
        return _nclt(path, table)
    if table.shape[1] not in (12, 16):
        raise DatasetError(
            f"poses: {path} has {table.shape[1]} numbers a line, need 12 (3x4), 16 (4x4, row-major), 8 (TUM) or 7 (NCLT)"
        )
    return Trajectory(_matrices(path, table), None, "KITTI")


def place_scans(path: Path, n_scans: int, stamps_ns: Sequence[int] | None) -> Placed:
    """A pose for each scan: at its stamp where both sides have stamps of one clock, else line by line.

    Args:
        path: A file that `read_trajectory` reads.
        n_scans: Of the recording.
        stamps_ns: Of the scans; None if nobody knows them.
    Raises:
        DatasetError: the file does not fit the scans.
    """
    found = read_trajectory(path)
    n = len(found.poses)
    if found.stamps_ns is not None and stamps_ns is not None:
        first, last = found.stamps_ns[0], found.stamps_ns[-1]
        if any(first <= stamp <= last for stamp in stamps_ns):
            return _at_stamps(path, found, stamps_ns)
    if n != n_scans:
        why = " and their stamps do not meet" if found.stamps_ns is not None else ""
        raise DatasetError(f"poses: {path} has {n} lines for {n_scans} scans{why}")
    note = f"poses from {path.name} ({found.form}), line by line"
    return Placed(list(range(n)), found.poses, found.stamps_ns, note)


def find_poses(folder: Path, named: str | Path | None) -> Path | None:
    """The pose file of a folder: the named one, looked up in the folder first, or the first of `POSE_FILES`.

    Raises:
        DatasetError: there is no file of that name.
    """
    if named is None:
        return next((folder / name for name in POSE_FILES if (folder / name).is_file()), None)
    for candidate in (folder / named, Path(named)):
        if candidate.is_file():
            return candidate
    raise DatasetError(f"poses: no file {named} in {folder} or here")


def other_poses(folder: Path, taken: Path | None = None) -> list[tuple[str, Trajectory]]:
    """Names and contents of the files in a folder that hold poses, but for the one that is taken."""
    found = []
    texts = (path for path in sorted(folder.iterdir(), key=natural_key) if path.suffix.lower() in _TEXTS)
    for path in itertools.islice(texts, _MAX_TEXTS):
        if path != taken and path.is_file() and path.stat().st_size < _MAX_BYTES:
            try:
                found.append((path.name, read_trajectory(path)))
            except DatasetError:
                continue  # no poses: that is what was asked
    return found


def tum_line(pose: Float64, stamp_ns: int) -> str:
    """A pose as a line of a TUM file."""
    w, x, y, z = quaternion_of(pose[:3, :3]).tolist()
    numbers = [*pose[:3, 3].tolist(), x, y, z, w]
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} " + " ".join(f"{v:.9g}" for v in numbers)


def _at_stamps(path: Path, found: Trajectory, stamps_ns: Sequence[int]) -> Placed:
    at = np.asarray(found.stamps_ns, np.int64)
    scans, poses = [], []
    for i, stamp in enumerate(stamps_ns):
        after = int(np.searchsorted(at, stamp))
        if after < len(at) and at[after] == stamp:
            scans.append(i)
            poses.append(found.poses[after])
        elif 0 < after < len(at) and at[after] - at[after - 1] <= _MAX_GAP_S * 1e9:
            share = float(stamp - at[after - 1]) / float(at[after] - at[after - 1])
            scans.append(i)
            poses.append(interpolate(found.poses[after - 1], found.poses[after], share))
    note = f"poses from {path.name} ({found.form}), at the stamps of the scans"
    left = len(stamps_ns) - len(scans)
    if left:
        note += f"; {left} of {len(stamps_ns)} scans have none within {_MAX_GAP_S:g} s and are left out"
    if not scans:
        raise DatasetError(f"poses: {path} has no pose within {_MAX_GAP_S:g} s of any scan")
    return Placed(scans, np.stack(poses), [stamps_ns[i] for i in scans], note)


def _vertices(path: Path) -> Float64 | None:
    """(P, 7) x y z qx qy qz qw of a graph's vertices by their numbers; None if the file has none."""
    rows: dict[int, list[str]] = {}
    try:
        with path.open(errors="replace") as file:
            for line in file:
                words = line.split()
                if words and words[0] == _VERTEX_WORDS[1]:
                    words = [_VERTEX_WORDS[0] + words[1], *words[2:]]
                if words and words[0][:1] == "v" and words[0][1:].isdigit():
                    rows[int(words[0][1:])] = words[1:]
                elif not rows and words and not words[0].startswith("#"):
                    return None
        return np.asarray([rows[i] for i in sorted(rows)], np.float64).reshape(-1, 7) if rows else None
    except OSError as error:
        raise DatasetError(f"poses: cannot read {path} ({error.strerror})") from error
    except (ValueError, IndexError) as error:
        raise DatasetError(f"poses: {path}: a vertex is not seven numbers, x y z qx qy qz qw") from error


def _quaternion_poses(path: Path, rows: Float64) -> Float64:
    poses = []
    for line, row in enumerate(rows, start=1):
        try:
            poses.append(quaternion_pose(row[:3], row[[6, 3, 4, 5]]))
        except ValueError as error:
            raise DatasetError(f"poses: {path} pose {line}: {error}") from error
    return np.stack(poses)


def _nclt(path: Path, table: Float64) -> Trajectory:
    known = np.isfinite(table).all(axis=1)
    left = int((~known).sum())
    stamps = [round(us) * 1000 for us in table[known, 0].tolist()]
    if not stamps or (np.diff(stamps) <= 0).any():
        raise DatasetError(f"poses: {path}: need lines of numbers whose stamps grow")
    poses = np.stack([_Z_UP @ euler_pose(row[1:4], *row[4:].tolist()) for row in table[known]])
    form = "NCLT" if not left else f"NCLT, {left} of {len(table)} lines have no numbers"
    return Trajectory(poses, stamps, form)


def _matrices(path: Path, table: Float64) -> Float64:
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table[:, :12].reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    defect = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    defect[defect < 1e-2] += np.linalg.det(rotations[defect < 1e-2]) < 0  # a mirror is no rotation
    if not (defect < 1e-2).all():
        line = int(np.argmax(~(defect < 1e-2))) + 1
        raise DatasetError(
            f"poses: {path} line {line} is not a rotation and a translation (off by {defect[line - 1]:.2g})"
        )
    if not np.isfinite(poses).all():
        line = int(np.argmax(~np.isfinite(poses).all(axis=(1, 2)))) + 1
        raise DatasetError(f"poses: {path} line {line} has a translation that is not finite")
    return poses
