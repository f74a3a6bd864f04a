"""Scenes of DGP (DDAD): a JSON file that names the clouds and their poses."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np

from potclient.datasets.clouds import moved_origin
from potclient.datasets.files import read_beams
from potclient.datasets.scans import RecordedScan, Recording, growing
from potclient.errors import DatasetError
from potclient.poses import quaternion_pose


class DgpScene(Recording):
    """The clouds of a DGP scene, in order of time, in a map frame that is the vehicle at the first of them.

    Args:
        path: Folder with one `scene_*.json`.
        origin: (3,) m, where the beams begin in the frame of the points; DDAD does not say, and (0, 0, 0) is on the road.
    Raises:
        DatasetError: no such scene, or it names no clouds.
    """

    format = "dgp"

    def __init__(self, path: Path, *, origin: Sequence[float] | None = None) -> None:
        super().__init__(path)
        scenes = scene_files(path)
        if len(scenes) != 1:
            raise DatasetError(
                f"{path}: need one scene_*.json, found {len(scenes)}; name the folder of one scene"
            )
        self._scene = scenes[0]
        self._origin = np.zeros(3) if origin is None else np.asarray(origin, np.float64)
        if self._origin.shape != (3,) or not np.isfinite(self._origin).all():
            raise DatasetError(f"origin {origin}: need x y z in metres")
        try:
            found = [_cloud_of(datum) for datum in json.loads(self._scene.read_text())["data"]]
        except OSError as error:
            raise DatasetError(f"{self._scene}: cannot be read ({error.strerror})") from error
        except (ValueError, KeyError, TypeError) as error:
            raise DatasetError(
                f"{self._scene}: not a scene of DGP ({type(error).__name__}: {error})"
            ) from error
        clouds = sorted((cloud for cloud in found if cloud is not None), key=lambda cloud: cloud[0])
        if not clouds:
            raise DatasetError(f"{self._scene}: names no point clouds")
        self._files = [path / name for _, name, _ in clouds]
        self._stamps = growing([stamp for stamp, _, _ in clouds])
        first = np.linalg.inv(clouds[0][2])
        self._poses = [first @ pose for _, _, pose in clouds]
        where = "their beams taken to begin in its origin, which is on the road: give the sensor's place with --origin X Y Z"
        self.notes = (
            f"poses from {self._scene.name}, the first vehicle is the map frame",
            "points in the vehicle's frame, "
            + (where if origin is None else f"their beams begin at {self._origin.tolist()} m in it"),
        )

    def __len__(self) -> int:
        return len(self._files)

    @property
    def used(self) -> frozenset[Path]:
        return frozenset((*self._files, self._scene))

    def read(self, i: int) -> RecordedScan:
        beams = read_beams(self._files[i])
        finite = np.isfinite(beams.points).all(axis=1)
        points, pose = moved_origin(beams.points[finite], self._poses[i], self._origin)
        return RecordedScan(
            points=points.astype(np.float32),
            is_return=beams.is_return[finite],
            T_map_sensor=pose,
            stamp_ns=self._stamps[i],
            name=self._files[i].name,
        )


def scene_files(path: Path) -> list[Path]:
    """The scenes in a folder."""
    return sorted(path.glob("scene_*.json"))


def _cloud_of(datum: dict[str, Any]) -> tuple[int, str, Any] | None:
    """Stamp, file name and pose of a datum; None of a picture."""
    cloud = datum["datum"].get("point_cloud")
    if cloud is None:
        return None
    t, q = cloud["pose"]["translation"], cloud["pose"]["rotation"]
    pose = quaternion_pose(
        np.array([t[k] for k in ("x", "y", "z")], np.float64),
        np.array([q[k] for k in ("qw", "qx", "qy", "qz")], np.float64),
    )
    # fromisoformat takes no Z before Python 3.11
    at = datetime.fromisoformat(datum["id"]["timestamp"].replace("Z", "+00:00"))
    since = at - datetime(1970, 1, 1, tzinfo=timezone.utc)
    return (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000, cloud["filename"], pose
