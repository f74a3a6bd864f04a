"""What a recording is made of, and the helpers that all readers share."""

from __future__ import annotations

import dataclasses
import itertools
import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import overload

import numpy as np

from potclient.arrays import Bool, Float32, Float64
from potclient.errors import DatasetError

_MAX_STAMP_S = 2.0**63 / 1e9
_NS_PER_DIGITS = {13: 10**6, 16: 10**3, 18: 1, 19: 1}  # how long a stamp is in ms, us, ns


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

    @property
    def used(self) -> frozenset[Path]:
        """The files that it reads, where it can tell."""
        return frozenset()

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
    """Rows of numbers, with spaces or commas between them; lines starting with # are skipped.

    Raises:
        DatasetError: the file is missing or holds something else.
    """
    try:
        text = path.read_text()
        lines = [line.replace(",", " ").split() for line in text.splitlines()]
        rows = [words for words in lines if words and not words[0].startswith("#")]
        table = np.asarray(rows, np.float64)
    except OSError as error:
        raise DatasetError(f"{what}: cannot read {path} ({error.strerror})") from error
    except ValueError as error:
        raise DatasetError(f"{what}: {path} must hold rows of equally many numbers ({error})") from error
    if table.size == 0:
        raise DatasetError(f"{what}: {path} is empty")
    return table


def stamps_of_names(files: Sequence[Path]) -> list[int] | None:
    """Stamps, ns, from files that are called by their times; None unless all are, and in growing order.

    A time is the last number in the name: 13 digits of ms, 16 of us, 18 or 19 of ns, or ten of seconds, a point and decimals.
    """
    stamps = [_stamp_of_name(file.name) for file in files]
    found = [stamp for stamp in stamps if stamp is not None]
    is_growing = all(a < b for a, b in itertools.pairwise(found))
    return found if found and len(found) == len(stamps) and is_growing else None


def _stamp_of_name(name: str) -> int | None:
    seconds = re.findall(r"(?<!\d)(\d{10})[._](\d{3,9})(?!\d)", name)
    if seconds:
        whole, decimals = seconds[-1]
        return int(whole) * 10**9 + int(decimals.ljust(9, "0"))
    numbers: list[str] = re.findall(r"\d+", name)
    long = [digits for digits in numbers if len(digits) in _NS_PER_DIGITS]
    return int(long[-1]) * _NS_PER_DIGITS[len(long[-1])] if long else None


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
