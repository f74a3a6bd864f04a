"""CARMEN logs of planar lasers: FLASER and ROBOTLASER1 lines, plain or compressed."""

from __future__ import annotations

import bz2
import gzip
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from potclient.arrays import Float64
from potclient.datasets.scans import RecordedScan, Recording, growing, read_table, stamp_of
from potclient.errors import DatasetError
from potclient.poses import yaw_pose

DEFAULT_NO_RETURN_M = 50.0
DEFAULT_MAX_RANGE_M = 30.0
SUFFIXES = (".log", ".clf", ".carmen")


class _Line(NamedTuple):
    number: int
    ranges_m: Float64  # (n,)
    start_rad: float
    step_rad: float
    x_m: float
    y_m: float
    yaw_rad: float
    stamp_ns: int


class CarmenLog(Recording):
    """The laser lines of a CARMEN log, each with its corrected pose.

    A SICK writes a marker where nothing came back (81.83 m, or 50 m in some logs): readings from `no_return_m` on have no
    echo, and their beams count as free up to `max_range_m`, like those of echoes beyond it. Readings of zero or less are
    dropped.

    Args:
        path: A .log or .clf file, plain, .bz2 or .gz.
        poses: Poses to use instead of the log's, one line a laser line: `x y yaw`, or `index time x y yaw` (m, rad).
        no_return_m: Readings from here on are no echoes.
        max_range_m: Longest beam that is believed.
    Raises:
        DatasetError: not such a log, a damaged line, or poses that do not fit.
    """

    format = "carmen"

    def __init__(
        self,
        path: Path,
        *,
        poses: str | Path | None = None,
        no_return_m: float = DEFAULT_NO_RETURN_M,
        max_range_m: float = DEFAULT_MAX_RANGE_M,
    ) -> None:
        super().__init__(path)
        self._lines = _read_lines(path)
        self._no_return_m, self._max_range_m = no_return_m, max_range_m
        n = len(self._lines)
        self._xyt = np.array([[line.x_m, line.y_m, line.yaw_rad] for line in self._lines])
        notes = ["poses from the log's laser lines", *_alternatives(path.parent, n)]
        self._used = [path]
        if poses is not None:
            file = path.parent / poses if (path.parent / poses).is_file() else Path(poses)
            table = read_table(file, "poses")
            self._used.append(file)
            if table.shape[1] not in (3, 5) or len(table) != n:
                raise DatasetError(
                    f"poses: {file} has {len(table)} lines of {table.shape[1]} numbers, need {n} of `x y yaw` or"
                    " `index time x y yaw`"
                )
            if not np.isfinite(table[:, -3:]).all():
                raise DatasetError(f"poses: {file} has a pose that is not finite")
            self._xyt = table[:, -3:]
            notes = [f"poses from {file.name}"]
        self.notes = (
            *notes,
            f"no echo from {no_return_m:g} m on; beams free up to {max_range_m:g} m at most",
        )
        self._stamps = growing([line.stamp_ns for line in self._lines])

    def __len__(self) -> int:
        return len(self._lines)

    @property
    def used(self) -> frozenset[Path]:
        return frozenset(self._used)

    def read(self, i: int) -> RecordedScan:
        line = self._lines[i]
        range_m, angle = line.ranges_m, line.start_rad + line.step_rad * np.arange(len(line.ranges_m))
        good = np.isfinite(range_m) & (range_m > 0)
        range_m, angle = range_m[good], angle[good]
        is_return = (range_m < self._no_return_m) & (range_m <= self._max_range_m)
        range_m = np.where(is_return, range_m, np.minimum(range_m, self._max_range_m))
        points = np.stack([range_m * np.cos(angle), range_m * np.sin(angle), np.zeros_like(range_m)], axis=1)
        x, y, yaw = self._xyt[i]
        return RecordedScan(
            points=points.astype(np.float32),
            is_return=is_return,
            T_map_sensor=yaw_pose(x, y, yaw),
            stamp_ns=self._stamps[i],
            name=f"{self.path.name}:{line.number}",
            is_planar=True,
        )


def is_carmen_name(path: Path) -> bool:
    """Whether a file's name looks like a CARMEN log."""
    suffixes = [s.lower() for s in path.suffixes]
    if suffixes and suffixes[-1] in (".bz2", ".gz"):
        suffixes.pop()
    return bool(suffixes) and suffixes[-1] in SUFFIXES


def _alternatives(folder: Path, n_lines: int) -> list[str]:
    """Notes on files beside a log that hold a pose for each of its lines: often better ones than the log's odometry."""
    notes = []
    for file in sorted(folder.glob("*.txt")):
        try:
            fits = read_table(file, "poses").shape in ((n_lines, 3), (n_lines, 5))
        except DatasetError:
            continue  # no table: that is what was asked
        if fits:
            notes.append(f"{file.name} also holds a pose for each of its lines: --poses {file.name}")
    return notes


def _read_lines(path: Path) -> list[_Line]:
    try:
        data = path.read_bytes()
        if data.startswith(b"BZh"):
            data = bz2.decompress(data)
        elif data.startswith(b"\x1f\x8b"):
            data = gzip.decompress(data)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, EOFError) as error:
        raise DatasetError(f"{path}: damaged compression ({error})") from error
    lines = []
    for number, raw in enumerate(data.split(b"\n"), start=1):
        if raw.startswith((b"FLASER ", b"ROBOTLASER1 ")):
            try:
                lines.append(_parse(number, raw.decode("ascii", "replace").split()))
            except (ValueError, IndexError) as error:
                raise DatasetError(f"{path}: line {number} is not a whole laser line ({error})") from error
    if not lines:
        raise DatasetError(f"{path}: no FLASER or ROBOTLASER1 lines, so not a CARMEN laser log")
    return lines


def _parse(number: int, words: list[str]) -> _Line:
    if words[0] == "FLASER":
        n, first = _count(words[1]), 2
        # 180: one degree up to +89; 181: one degree up to +90
        start, step = -math.pi / 2, math.pi / (n - n % 2)
        pose_at, stamp_at = first + n, first + n + 6
    else:
        n, first = _count(words[8]), 9
        start, step = float(words[2]), float(words[4])
        if not math.isfinite(start) or not math.isfinite(step):
            raise ValueError("its angles are not finite")
        n_remissions = int(words[first + n])
        if n_remissions < 0:
            raise ValueError(f"{n_remissions} remissions")
        pose_at = first + n + 1 + n_remissions
        stamp_at = pose_at + 11  # laser pose, robot pose, five speeds and widths
    ranges = np.asarray(words[first : first + n], np.float64)
    if len(ranges) != n:
        raise ValueError(f"{len(ranges)} of {n} readings")
    x, y, yaw = (float(w) for w in words[pose_at : pose_at + 3])
    if not np.isfinite([x, y, yaw]).all():
        raise ValueError("the pose is not finite")
    stamp_ns = stamp_of(float(words[stamp_at]) if len(words) > stamp_at else number * 0.1)
    return _Line(number, ranges, start, step, x, y, yaw, stamp_ns)


def _count(word: str) -> int:
    n = int(word)
    if n < 2:
        raise ValueError(f"{n} readings; a scan has two or more")
    return n
