"""What a recording is made of, and the helpers that all readers share."""

from __future__ import annotations

import dataclasses
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import numpy as np

from potclient.arrays import Bool, Float32, Float64
from potclient.errors import DatasetError

_MAX_STAMP_S = 2.0**63 / 1e9


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RecordedScan:
    """One scan of a recording, ready to send."""

    points: Float32  # (N, 3) m, sensor frame; finite
    is_return: Bool  # (N,) false = no echo: the beam was free up to the point
    T_map_sensor: Float64  # (4, 4)
    stamp_ns: int  # the recording's own clock; grows from scan to scan
    name: str  # file or line it came from
    is_planar: bool = False  # a 2D scanner: z = 0

    def __len__(self) -> int:
        return len(self.points)

    @property
    def to_send(self) -> Float32:
        """(N, 3) m, or (N, 2) of a planar scan: that is how a server knows that it is one."""
        return self.points[:, :2] if self.is_planar else self.points

    @property
    def in_map(self) -> Float64:
        """(N, 3) m, map frame."""
        points: Float64 = self.points.astype(np.float64)
        return np.asarray(points @ self.T_map_sensor[:3, :3].T + self.T_map_sensor[:3, 3])


class Recording(Sequence[RecordedScan]):
    """Scans in order, each read from disk when it is asked for.

    Raises (on access):
        DatasetError: a file is damaged.
    """

    format: str = ""
    notes: tuple[str, ...] = ()  # what was assumed about the data, for people

    def __init__(self, path: Path) -> None:
        self.path = path

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def read(self, i: int) -> RecordedScan:
        """Scan i, 0 <= i < len(self)."""

    @overload
    def __getitem__(self, index: int) -> RecordedScan: ...
    @overload
    def __getitem__(self, index: slice) -> Recording: ...
    def __getitem__(self, index: int | slice) -> RecordedScan | Recording:
        if isinstance(index, slice):
            return Selection(self, range(len(self))[index])
        return self.read(range(len(self))[index])

    def __iter__(self) -> Iterator[RecordedScan]:
        for i in range(len(self)):
            yield self.read(i)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, {len(self)} scans)"


class Selection(Recording):
    """Some scans of a recording."""

    def __init__(self, source: Recording, indices: range) -> None:
        super().__init__(source.path)
        self._source, self._indices = source, indices
        self.format, self.notes = source.format, source.notes

    def __len__(self) -> int:
        return len(self._indices)

    def read(self, i: int) -> RecordedScan:
        return self._source.read(self._indices[i])


class RangeLimited(Recording):
    """A recording with its beams cut at a largest range: beyond it they are free up to there, without an echo."""

    def __init__(self, source: Recording, *, min_range_m: float, max_range_m: float | None) -> None:
        super().__init__(source.path)
        self._source, self._min_range_m, self._max_range_m = source, min_range_m, max_range_m
        self.format, self.notes = source.format, source.notes

    def __len__(self) -> int:
        return len(self._source)

    def read(self, i: int) -> RecordedScan:
        scan = self._source.read(i)
        points, is_return = limit_range(
            scan.points, scan.is_return, min_range_m=self._min_range_m, max_range_m=self._max_range_m
        )
        return dataclasses.replace(scan, points=points, is_return=is_return)


def limit_range(
    points: Float32, is_return: Bool, *, min_range_m: float, max_range_m: float | None
) -> tuple[Float32, Bool]:
    """Drop points that are not finite or nearer than `min_range_m`; shorten beams beyond `max_range_m`, which lose their echo.

    Args:
        points: (N, 3) m, sensor frame.
        is_return: (N,) bool.
    """
    range_m = np.sqrt(np.einsum("nd,nd->n", points, points, dtype=np.float64))
    keep = np.isfinite(range_m) & (range_m > 0) & (range_m >= min_range_m)
    points, is_return, range_m = points[keep], is_return[keep], range_m[keep]
    if max_range_m is not None:
        far = range_m > max_range_m
        points, is_return = points.copy(), is_return & ~far
        points[far] *= (max_range_m / range_m[far])[:, None].astype(np.float32)
    return points, is_return


def natural_key(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sort key by which scan_2 comes before scan_10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(p)) if p.isdigit() else (1, p) for p in parts], path.name


def read_table(path: Path, what: str) -> Float64:
    """Rows of numbers; lines starting with # are skipped.

    Raises:
        DatasetError: the file is missing or holds something else.
    """
    try:
        text = path.read_text()
        rows = [
            line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")
        ]
        table = np.asarray(rows, np.float64)
    except OSError as error:
        raise DatasetError(f"{what}: cannot read {path} ({error.strerror})") from error
    except ValueError as error:
        raise DatasetError(f"{what}: {path} must hold rows of equally many numbers ({error})") from error
    if table.size == 0:
        raise DatasetError(f"{what}: {path} is empty")
    return table


def read_poses(path: Path, n_scans: int) -> Float64:
    """(n_scans, 4, 4): one pose a line, 12 numbers (the top three rows of the matrix) or 16.

    Raises:
        DatasetError: another number of columns or lines, or a matrix that is not rigid.
    """
    table = read_table(path, "poses")
    if table.shape[1] not in (12, 16):
        raise DatasetError(
            f"poses: {path} has {table.shape[1]} numbers a line, need 12 (3x4) or 16 (4x4), row-major"
        )
    if len(table) != n_scans:
        raise DatasetError(f"poses: {path} has {len(table)} lines for {n_scans} scans")
    poses = np.tile(np.eye(4), (n_scans, 1, 1))
    poses[:, :3] = table[:, :12].reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    defect = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    if not (defect < 1e-2).all():
        line = int(np.argmax(~(defect < 1e-2))) + 1
        raise DatasetError(
            f"poses: {path} line {line} is not a rotation and a translation (off by {defect[line - 1]:.2g})"
        )
    if not np.isfinite(poses).all():
        line = int(np.argmax(~np.isfinite(poses).all(axis=(1, 2)))) + 1
        raise DatasetError(f"poses: {path} line {line} has a translation that is not finite")
    return poses


def read_stamps(path: Path | None, n_scans: int, *, period_s: float = 0.1) -> list[int]:
    """Stamps, ns, strictly growing: from a file of seconds, or made up at a steady rate if there is none.

    Raises:
        DatasetError: the file has another number of lines, or one is not a time.
    """
    if path is None or not path.is_file():
        return growing([round(i * period_s * 1e9) for i in range(n_scans)])
    seconds = read_table(path, "times")[:, 0]
    if len(seconds) != n_scans:
        raise DatasetError(f"times: {path} has {len(seconds)} lines for {n_scans} scans")
    try:
        return growing([stamp_of(float(s)) for s in seconds])
    except ValueError as error:
        raise DatasetError(f"times: {path}: {error}") from error


def stamp_of(seconds: float) -> int:
    """The stamp, ns.

    Raises:
        ValueError: it is not finite, or more than 64 bits of nanoseconds hold.
    """
    if not abs(seconds) < _MAX_STAMP_S:  # also where it is not a number
        raise ValueError(f"{seconds} is not a time in seconds")
    return round(seconds * 1e9)


def growing(stamps_ns: list[int]) -> list[int]:
    """The same stamps, each at least 1 ns after the one before, none negative."""
    last = -1
    result = []
    for stamp in stamps_ns:
        last = max(stamp, last + 1)
        result.append(last)
    return result
