"""A drive as a folder of files that `open_dataset` reads back."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from potclient.datasets.clouds import RECORDING_FILE
from potclient.datasets.scans import RecordedScan
from potclient.errors import UsageError
from potclient.extras import how_to_install
from potclient.towns.recording import TownRecording
from potschemas import __version__


def write_drive(
    recording: TownRecording,
    folder: Path,
    *,
    on_scan: Callable[[], None] = lambda: None,
    picture: bool = True,
) -> None:
    """Write PLY files with their poses and times, what made them, and a plan of the town; all of it or nothing.

    Args:
        recording: A drive.
        folder: Must not exist, or be empty.
        on_scan: Called after each scan, for progress.
        picture: Draw `plan.png`; needs matplotlib.
    Raises:
        UsageError: the folder holds something, or plyfile or matplotlib are missing.
        DatasetError: open3d is missing.
    """
    from potclient.towns.pictures import draw_plan

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: exists already; name a new folder")
    if len(recording) == 0:
        raise UsageError("town: no scans to write")
    part = folder.parent / f".{folder.name}.part-{os.getpid()}"
    part.mkdir(parents=True)
    try:
        poses, seconds = [], []
        n_beams = n_returns = 0
        for k, scan in enumerate(recording):
            _write_ply(part / f"scan_{k:06d}.ply", scan)
            poses.append(scan.T_map_sensor[:3].ravel())
            seconds.append(scan.stamp_ns / 1e9)
            n_beams, n_returns = n_beams + len(scan), n_returns + int(scan.is_return.sum())
            on_scan()
        np.savetxt(part / "poses.txt", poses, fmt="%.17g")
        np.savetxt(part / "times.txt", seconds, fmt="%.9f")
        about = describe(recording) | {"n_beams": n_beams, "n_returns": n_returns}
        (part / RECORDING_FILE).write_text(json.dumps(about, indent=1) + "\n")
        (part / "README.txt").write_text(_readme(recording))
        if picture:
            draw_plan(recording, part / "plan.png")
        if folder.exists():
            folder.rmdir()
        part.rename(folder)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise


def describe(recording: TownRecording) -> dict[str, object]:
    """What a drive was made with, in plain types: enough to make it again."""
    town = recording.town
    lidar = dataclasses.asdict(recording.lidar)
    return {
        "dataset": str(recording.path),
        "potclient": __version__,
        "is_planar": recording.lidar.is_planar,
        "style": dataclasses.asdict(town.style),
        "seed": town.seed,
        "dynamic": town.dynamic,
        "drive_m": town.drive.length_m,
        "speed_m_s": town.style.speed_m_s,
        "slice_m": town.slice_m,
        "scans": [recording.indices.start, recording.indices.stop, recording.indices.step],
        "lidar": lidar,
    }


def _readme(recording: TownRecording) -> str:
    scans, lidar = recording.indices, recording.lidar
    again = (
        f'open_town("{recording.path}", n_scans={scans.stop}, max_range_m={lidar.max_range_m:g})'
        f"[{scans.start}:{scans.stop}:{scans.step}]"
    )
    return f"""A drive through a made-up town: {recording.town.style.summary}.

scan_*.ply      x y z in metres, sensor frame (x ahead, y left, z up); is_return 0: no echo, the beam was free up to the point
poses.txt       T_map_sensor, the top three rows of the matrix, row by row, a line a scan
times.txt       seconds, a line a scan
{RECORDING_FILE}  all settings
plan.png        the town from above and the way through it

Read it: open_dataset("this/folder") of potclient.datasets.
The same scans without these files, and the truth about any point at a time in seconds:
  from potclient.towns import open_town
  recording = {again}
  recording.town.occupied(points, time_s)
"""


def _write_ply(path: Path, scan: RecordedScan) -> None:
    try:
        from plyfile import PlyData, PlyElement
    except ImportError as error:
        raise UsageError(f"writing PLY needs the package plyfile: {how_to_install('towns')}") from error
    rows = np.empty(len(scan), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("is_return", "u1")])
    rows["x"], rows["y"], rows["z"] = scan.points.T
    rows["is_return"] = scan.is_return
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(path))
