"""What a path holds: which recording it is, and what of it nobody reads."""

from __future__ import annotations

import collections
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from potclient.datasets.argoverse2 import Argoverse2Log, is_argoverse2
from potclient.datasets.carmen import SUFFIXES, is_carmen_name
from potclient.datasets.clouds import CloudFolder, cloud_files
from potclient.datasets.dgp import DgpScene, scene_files
from potclient.datasets.files import AUTO_LAYOUT, ENDINGS, kind_of
from potclient.datasets.files.arrays import said_arrays
from potclient.datasets.kitti import KittiRecording
from potclient.datasets.scans import Recording
from potclient.errors import DatasetError

FOLDER_FORMATS = ("kitti", "clouds", "argoverse2", "dgp")
_TAKES = {
    "kitti": ("poses", "odometry"),
    "argoverse2": (),
    "dgp": ("origin",),
}  # of what may be said about clouds
_SHOWN = 4  # names in a note


def open_folder(
    path: Path,
    format: str,  # noqa: A002
    *,
    poses: str | Path | None,
    frame: str,
    origin: Sequence[float] | None,
    layout: str,
    needs_poses: bool,
) -> Recording:
    """The recording of one of `FOLDER_FORMATS`, without its notes on what nobody reads.

    Raises:
        DatasetError: something is missing or damaged.
    """
    if format == "clouds":
        return CloudFolder(
            path, poses=poses, frame=frame, origin=origin, layout=layout, needs_poses=needs_poses
        )
    given = {
        "poses": poses is not None,
        "frame": frame != "auto",
        "origin": origin is not None,
        "layout": layout != AUTO_LAYOUT,
        "odometry": not needs_poses,
    }
    for name in (name for name in given if given[name] and name not in _TAKES[format]):
        raise DatasetError(
            f"{path}: a recording of format {format} brings what {name} would say; leave it out"
        )
    if format == "kitti":
        return KittiRecording(path, poses=poses, needs_poses=needs_poses)
    return Argoverse2Log(path) if format == "argoverse2" else DgpScene(path, origin=origin)


def sniff(path: Path) -> tuple[str, Path]:
    """The format of a path, and the path to open it at.

    Raises:
        DatasetError: no recording; the text says what is there instead, and what would take it.
    """
    if path.is_file():
        if kind_of(path) is not None:
            return "clouds", path
        if is_carmen_name(path):
            return "carmen", path
        raise DatasetError(
            f"{path}: {_said_file(path)}not a recording; clouds end in {', '.join(ENDINGS)}, logs in {', '.join(SUFFIXES)};"
            " name the format with --format"
        )
    if is_argoverse2(path):
        return "argoverse2", path
    if scene_files(path):
        return "dgp", path
    if any((path / "velodyne").glob("*.bin")):
        return "kitti", path
    if path.name == "velodyne" and any(path.glob("*.bin")) and (path.parent / "calib.txt").is_file():
        return "kitti", path.parent
    has_log = any(is_carmen_name(f) for f in path.iterdir())
    if has_log and not any(kind_of(f) for f in path.iterdir()):
        return "carmen", path
    if cloud_files(path):
        return "clouds", path
    raise DatasetError(f"{path}: {_said_folder(path)}")


def only_log(folder: Path) -> Path:
    """The one CARMEN log of a folder.

    Raises:
        DatasetError: there is none, or more than one.
    """
    logs = [f for f in sorted(folder.iterdir()) if is_carmen_name(f)]
    if len(logs) != 1:
        names = ", ".join(f.name for f in logs) or "none"
        raise DatasetError(f"{folder}: need one CARMEN log, found {names}; name the file itself")
    return logs[0]


def not_read(path: Path, used: frozenset[Path]) -> tuple[str, ...]:
    """A note on the files of a folder that the recording does not read; empty if there are none."""
    if not path.is_dir():
        return ()
    left = sorted(f.relative_to(path).as_posix() for f in path.rglob("*") if f.is_file() and f not in used)
    if not left:
        return ()
    more = f" and {len(left) - _SHOWN} more" if len(left) > _SHOWN else ""
    return (f"not read: {', '.join(left[:_SHOWN])}{more}",)


def _said_folder(folder: Path) -> str:
    files = sorted(f for f in folder.rglob("*") if f.is_file())
    endings = collections.Counter(f.suffix.lower() or f.name for f in files)
    there = ", ".join(f"{n} {ending}" for ending, n in endings.most_common(_SHOWN)) or "nothing"
    more = "".join(dict.fromkeys(_said_file(f) for f in files[:50]))
    return (
        f"no recording recognised; it holds {there}. {more}Expected velodyne/*.bin (KITTI), a log of Argoverse 2, a DGP"
        f" scene, files of points ({', '.join(ENDINGS)}) with poses.txt, or a CARMEN log"
    )


def _said_file(path: Path) -> str:
    """What is known of a file that is no recording, and the command that takes it; empty if nothing is."""
    suffix = path.suffix.lower()
    if suffix in (".bt", ".ot"):
        how = f": potserver map import {path} -o {path.stem}.map" if suffix == ".bt" else ""
        return f"{path.name} is an OctoMap, a map and no recording{how}. "
    if suffix == ".npz":
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return f"{path.name} {said_arrays(arrays)}: none is taken for a cloud (N, 3). "
        except (OSError, ValueError, EOFError):
            return f"{path.name} is no readable .npz. "
    return ""
