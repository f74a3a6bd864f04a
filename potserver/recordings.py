"""Recordings as the evaluation and the atom builder take them: how one is opened, which of its scans, and each as a `Scan`."""

from __future__ import annotations

import re
from typing import Annotated

import msgspec

from potclient.datasets import RecordedScan, Recording, open_dataset
from potclient.errors import DatasetError
from potserver import bundled
from potserver.domain.types import Scan
from potserver.errors import SettingsError

BUNDLED_PREFIX = "bundled:"
_SCANS = re.compile(r"(?P<first>\d+)\Z|(?P<start>\d*):(?P<stop>\d*)(:(?P<step>[1-9]\d*))?\Z")


class Reader(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How a recording is opened: the options of `potclient.datasets.open_dataset`."""

    format: str = "auto"
    poses: str | None = None
    frame: str = "auto"
    origin: tuple[float, float, float] | None = None
    layout: str = "auto"
    odometry: str | None = None
    no_return_m: float | None = None
    min_range_m: float = 0.0
    max_range_m: float | None = None
    n_generated: Annotated[int, msgspec.Meta(ge=1)] = 100  # scans of a made-up recording


def open_recording(dataset: str, reader: Reader) -> Recording:
    """Open a recording: `bundled:NAME`, or what `open_dataset` knows.

    Raises:
        DatasetError: nothing there, not recognised, or damaged.
    """
    if not dataset.startswith(BUNDLED_PREFIX):
        return open_dataset(dataset, **msgspec.structs.asdict(reader))
    if reader != Reader():
        raise DatasetError(f"{dataset}: bundled recordings take no reader options")
    name = dataset.removeprefix(BUNDLED_PREFIX)
    if name not in bundled.NAMES:
        raise DatasetError(f"no bundled recording {name!r}; there are {', '.join(bundled.NAMES)}")
    return bundled.open_bundled(name)


def scan_numbers(scans: int | str, n_scans: int) -> range:
    """The scans that are taken of a recording of `n_scans`.

    Args:
        scans: The first N, or "START:STOP:STEP".
        n_scans: Of the recording.
    Raises:
        SettingsError: neither of the two, or N is 0.
    """
    found = _SCANS.match(str(scans))
    if found is None:
        raise SettingsError(f"scans = {scans!r}: need a number, or START:STOP:STEP")
    first, start, stop, step = found.group("first", "start", "stop", "step")
    if first is None:
        return range(n_scans)[int(start or 0) : int(stop or n_scans) : int(step or 1)]
    if int(first) < 1:
        raise SettingsError(f"scans = {scans}: need at least 1")
    return range(min(int(first), n_scans))


def to_scan(recorded: RecordedScan, seq: int) -> Scan:
    """A recorded scan as the mapper takes it."""
    return Scan(
        robot_id="recording",
        seq=seq,
        stamp_ns=recorded.stamp_ns,
        points=recorded.points,
        is_return=recorded.is_return,
        T_map_sensor=recorded.T_map_sensor,
        is_planar=recorded.is_planar,
    )
