"""Recordings to play into a map: `open_dataset` finds out what a path holds.

Formats: `kitti` (odometry layout), `clouds` (a folder of PCD or PLY files with poses), `carmen` (2D laser logs), `generated`
(a made-up yard; the path is `generated`, `generated:2d`, or either with `:SEED`), `town` (a drive through a made-up town, see
`potclient.towns`; the path is `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`), `gauntlet` (doorways, poles and wires of
known size; the path is `gauntlet[:SENSOR][:SEED]`), `bag` (MCAP, rosbag2 and ROS 1 bags, see `potclient.datasets.bags`).
"""

from __future__ import annotations

from pathlib import Path

from potclient.datasets.bags import is_bag, open_bag
from potclient.datasets.carmen import DEFAULT_MAX_RANGE_M, DEFAULT_NO_RETURN_M, CarmenLog, is_carmen_name
from potclient.datasets.clouds import FRAMES, CloudFolder, cloud_files
from potclient.datasets.generated import GeneratedRecording, GeneratedScene
from potclient.datasets.kitti import KittiRecording
from potclient.datasets.scans import RangeLimited, RecordedScan, Recording
from potclient.errors import DatasetError

__all__ = [
    "FORMATS",
    "FRAMES",
    "DatasetError",
    "GeneratedScene",
    "RecordedScan",
    "Recording",
    "open_dataset",
]

FORMATS = ("auto", "kitti", "clouds", "carmen", "generated", "town", "gauntlet", "bag")


def open_dataset(
    path: str | Path,
    format: str = "auto",  # noqa: A002 - what everyone calls it
    *,
    poses: str | Path | None = None,
    frame: str = "auto",
    no_return_m: float | None = None,
    min_range_m: float = 0.0,
    max_range_m: float | None = None,
    n_generated: int = 100,
) -> Recording:
    """Open a recording; slice it to take fewer scans, e.g. `open_dataset(path)[::2]`.

    Args:
        path: A folder or file, `generated[:2d][:SEED]`, `town:STYLE[:2d][:dynamic][:SENSOR][:LENGTHm][:SEED]`, or
            `gauntlet[:SENSOR][:SEED]`.
        format: One of `FORMATS`; "auto" looks at what is there.
        poses: Pose file to use instead of the usual one; for bags the topic of the poses.
        frame: For PCD files: where their points are, see `CloudFolder`.
        no_return_m: For CARMEN logs: readings from here on are no echoes (default 50).
        min_range_m: Points nearer than this are dropped.
        max_range_m: Beams beyond this are cut: free up to there, no echo (CARMEN logs: 30 unless given).
        n_generated: How many scans a generated scene or a town without a length has.

    Returns:
        The recording; a town's is a `potclient.towns.TownRecording`, whose `town` knows the truth.
    Raises:
        DatasetError: nothing there, not recognised, or damaged; or a town without open3d.
    """
    if format not in FORMATS:
        raise DatasetError(f"format {format!r}: need one of {', '.join(FORMATS)}")
    if min_range_m < 0 or (max_range_m is not None and not max_range_m > min_range_m):
        raise DatasetError(f"ranges: need 0 <= min ({min_range_m:g} m) < max ({max_range_m} m)")
    pose_file = None if poses is None else Path(poses)
    if format == "generated" or (format == "auto" and str(path).partition(":")[0] == "generated"):
        return _limited(_generated(str(path), n_generated), min_range_m, max_range_m)
    if format == "town" or (format == "auto" and str(path).partition(":")[0] == "town"):
        from potclient.towns import open_town

        return open_town(str(path), n_scans=n_generated, min_range_m=min_range_m, max_range_m=max_range_m)
    if format == "gauntlet" or (format == "auto" and str(path).partition(":")[0] == "gauntlet"):
        from potclient.towns import open_gauntlet

        return open_gauntlet(str(path), min_range_m=min_range_m, max_range_m=max_range_m)
    path = Path(path)
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    if format == "auto":
        format, path = _sniff(path)  # noqa: A001
    if format == "bag":
        topic = None if poses is None else str(poses)
        return open_bag(path, poses=topic, min_range_m=min_range_m, max_range_m=max_range_m)
    if format == "kitti":
        return _limited(KittiRecording(path, poses=pose_file), min_range_m, max_range_m)
    if format == "clouds":
        return _limited(CloudFolder(path, poses=pose_file, frame=frame), min_range_m, max_range_m)
    log = CarmenLog(
        _only_log(path) if path.is_dir() else path,
        poses=pose_file,
        no_return_m=DEFAULT_NO_RETURN_M if no_return_m is None else no_return_m,
        max_range_m=DEFAULT_MAX_RANGE_M if max_range_m is None else max_range_m,
    )
    return _limited(log, min_range_m, None)


def _limited(recording: Recording, min_range_m: float, max_range_m: float | None) -> Recording:
    return RangeLimited(recording, min_range_m=min_range_m, max_range_m=max_range_m)


def _sniff(path: Path) -> tuple[str, Path]:
    """The format of a path, and the path to open it at."""
    if is_bag(path):
        return "bag", path
    if path.is_file():
        if path.suffix.lower() in (".pcd", ".ply"):
            return "clouds", path
        if is_carmen_name(path):
            return "carmen", path
        raise DatasetError(f"{path}: not a .pcd, .ply, .log or .clf file; name the format with --format")
    if (path / "velodyne").is_dir():
        return "kitti", path
    if path.name == "velodyne" and any(path.glob("*.bin")):
        return "kitti", path.parent
    if cloud_files(path):
        return "clouds", path
    logs = [f for f in sorted(path.iterdir()) if is_carmen_name(f)]
    if logs:
        return "carmen", _only_log(path)
    raise DatasetError(
        f"{path}: no recording recognised; expected velodyne/*.bin (KITTI), *.pcd or *.ply with poses.txt, or a CARMEN log"
    )


def _only_log(folder: Path) -> Path:
    logs = [f for f in sorted(folder.iterdir()) if is_carmen_name(f)]
    if len(logs) != 1:
        names = ", ".join(f.name for f in logs) or "none"
        raise DatasetError(f"{folder}: need one CARMEN log, found {names}; name the file itself")
    return logs[0]


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
