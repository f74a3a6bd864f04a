"""Recordings to play into a map: `open_dataset` finds out what a path holds.

Formats: `kitti` (odometry layout), `argoverse2` (a log), `dgp` (a scene, as of DDAD), `clouds` (a folder of files of points or
one file, see `potclient.datasets.files`), `carmen` (2D laser logs), `generated` (a made-up yard; the path is `generated`,
`generated:2d`, or either with `:SEED`), `town` (a drive through a made-up town, see `potclient.towns`; the path is
`town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`), `gauntlet` (doorways, poles and wires of known size; the path is
`gauntlet[:SENSOR][:SEED]`), `bag` (MCAP, rosbag2 and ROS 1 bags, see `potclient.datasets.bags`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from potclient.datasets.bags import is_bag, open_bag
from potclient.datasets.carmen import DEFAULT_MAX_RANGE_M, DEFAULT_NO_RETURN_M, CarmenLog
from potclient.datasets.clouds import FRAMES
from potclient.datasets.files import AUTO_LAYOUT, LAYOUTS
from potclient.datasets.generated import GeneratedRecording, GeneratedScene
from potclient.datasets.odometry import ODOMETRIES, OdometryRecording, check_installed
from potclient.datasets.scans import RangeLimited, RecordedScan, Recording
from potclient.datasets.sniffing import FOLDER_FORMATS, not_read, only_log, open_folder, sniff
from potclient.errors import DatasetError

__all__ = [
    "FORMATS",
    "FRAMES",
    "LAYOUTS",
    "ODOMETRIES",
    "DatasetError",
    "GeneratedScene",
    "Reading",
    "RecordedScan",
    "Recording",
    "open_dataset",
    "recording_of_bag",
]

FORMATS = ("auto", *FOLDER_FORMATS, "carmen", "generated", "town", "gauntlet", "bag")


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """How a recording is read.

    Raises:
        DatasetError: ranges out of order, or an odometry that nobody knows, or one beside poses.
    """

    poses: str | Path | None = None  # pose file to use instead of the usual one
    frame: str = "auto"  # of files of points: where their points are, one of FRAMES, see `CloudFolder`
    origin: Sequence[float] | None = (
        None  # (3,) m, where the beams begin in the frame of the points, if not in its origin
    )
    layout: str = AUTO_LAYOUT  # of binary files without a header, one of LAYOUTS or "auto"
    no_return_m: float | None = None  # CARMEN logs: readings from here on are no echoes (default 50)
    min_range_m: float = 0.0  # points nearer than this are dropped
    # beams beyond this are cut: free up to there, no echo (CARMEN logs: 30 unless given)
    max_range_m: float | None = None
    n_generated: int = 100  # how many scans a generated scene or a town without a length has
    odometry: str | None = None  # one of ODOMETRIES: it places the scans, and no poses are read
    trajectory: str | Path | None = None  # file that gets what odometry found, see `OdometryRecording`

    def __post_init__(self) -> None:
        if self.min_range_m < 0 or (self.max_range_m is not None and not self.max_range_m > self.min_range_m):
            raise DatasetError(f"ranges: need 0 <= min ({self.min_range_m:g} m) < max ({self.max_range_m} m)")
        if self.odometry is not None and self.odometry not in ODOMETRIES:
            raise DatasetError(f"odometry {self.odometry!r}: need one of {', '.join(ODOMETRIES)}")
        if self.odometry is not None and self.poses is not None:
            raise DatasetError("odometry places the scans itself: give it or poses, not both")


def open_dataset(
    path: str | Path,
    format: str = "auto",  # noqa: A002 - what everyone calls it
    **reading: Any,
) -> Recording:
    """Open a recording; slice it to take fewer scans, e.g. `open_dataset(path)[::2]`.

    Args:
        path: A folder or file, `generated[:2d][:SEED]`, `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`, or
            `gauntlet[:SENSOR][:SEED]`.
        format: One of `FORMATS`; "auto" looks at what is there.
        reading: The fields of `Reading`.

    Returns:
        The recording; a town's is a `potclient.towns.TownRecording`, whose `town` knows the truth.
    Raises:
        DatasetError: nothing there, not recognised, or damaged; or a package is missing that its files need.
    """
    if format not in FORMATS:
        raise DatasetError(f"format {format!r}: need one of {', '.join(FORMATS)}")
    how = Reading(**reading)
    made_up = _made_up(str(path), format, how)
    if made_up is not None:
        return made_up
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    if format == "auto":
        format, path = ("bag", path) if is_bag(path) else sniff(path)  # noqa: A001
    if format == "bag":
        return recording_of_bag(path, how)
    if format == "carmen":
        return _carmen(path, how)
    recording = open_folder(
        path,
        format,
        poses=how.poses,
        frame=how.frame,
        origin=how.origin,
        layout=how.layout,
        needs_poses=how.odometry is None,
    )
    note = not_read(path, recording.used)
    recording = _placed(recording, how)
    recording.notes = (*recording.notes, *note)
    return _limited(recording, how)


def recording_of_bag(
    path: Path, how: Reading, *, topic: str | None = None, frame: str | None = None
) -> Recording:
    """The scans of a bag, see `open_bag`; `how.poses` names a topic.

    Raises:
        DatasetError, UsageError: see `open_bag`.
    """
    poses = None if how.poses is None else str(how.poses)
    found = open_bag(path, topic=topic, poses=poses, frame=frame, needs_poses=how.odometry is None)
    return _limited(_placed(found, how), how)


def _placed(recording: Recording, how: Reading) -> Recording:
    """The recording, or what odometry makes of it."""
    if how.odometry is None:
        return recording
    check_installed()
    return OdometryRecording(recording, None if how.trajectory is None else Path(how.trajectory))


def _made_up(text: str, format: str, how: Reading) -> Recording | None:  # noqa: A002
    """The recording of a name that means no file; None for others."""
    kind = text.partition(":")[0] if format == "auto" else format
    if kind not in ("generated", "town", "gauntlet"):
        return None
    _refuse_odometry(how, text)
    if kind == "generated":
        return _limited(_generated(text, how.n_generated), how)
    from potclient.towns import open_gauntlet, open_town

    if kind == "town":
        return open_town(
            text, n_scans=how.n_generated, min_range_m=how.min_range_m, max_range_m=how.max_range_m
        )
    return open_gauntlet(text, min_range_m=how.min_range_m, max_range_m=how.max_range_m)


def _carmen(path: Path, how: Reading) -> Recording:
    _refuse_odometry(how, str(path))
    log = CarmenLog(
        only_log(path) if path.is_dir() else path,
        poses=how.poses,
        no_return_m=DEFAULT_NO_RETURN_M if how.no_return_m is None else how.no_return_m,
        max_range_m=DEFAULT_MAX_RANGE_M if how.max_range_m is None else how.max_range_m,
    )
    log.notes = (*log.notes, *not_read(path, log.used))
    return RangeLimited(log, min_range_m=how.min_range_m, max_range_m=None)


def _limited(recording: Recording, how: Reading) -> Recording:
    return RangeLimited(recording, min_range_m=how.min_range_m, max_range_m=how.max_range_m)


def _refuse_odometry(how: Reading, name: str) -> None:
    if how.odometry is not None:
        raise DatasetError(
            f"{name}: odometry is for 3D clouds of files and bags; this recording brings its poses"
        )


def _generated(text: str, n_scans: int) -> Recording:
    planar, seed = False, 0
    for word in text.split(":")[1:]:
        if word in ("2d", "3d"):
            planar = word == "2d"
        elif word.isdigit():
            seed = int(word)
        else:
            raise DatasetError(f"{text}: {word!r} is neither 2d, 3d nor a seed; e.g. generated:2d:7")
    scene = GeneratedScene(seed, planar=planar, n_beams=360 if planar else 5760)
    return GeneratedRecording(scene, n_scans)
