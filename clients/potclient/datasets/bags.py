"""Bags: MCAP files, rosbag2 folders and ROS 1 `.bag` files, with poses from `/tf` or from a topic of poses.

Needs the extra `ros`.
"""

from __future__ import annotations

import contextlib
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from potclient.arrays import Bool, Float32, Float64
from potclient.datasets.scans import RangeLimited, RecordedScan, Recording, growing
from potclient.errors import DatasetError, NoTransformError
from potclient.ros.laser_scans import level, read_laser_scan
from potclient.ros.point_clouds import read_point_cloud
from potclient.ros.transforms import PoseTopic, TransformTree
from potclient.ros.types import (
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    POSE,
    POSE_WITH_COVARIANCE,
    frame_of,
    rosbags_missing,
    stamp_of,
    typestore,
)

SUFFIXES = (".mcap", ".db3", ".bag")
TF_TOPICS = ("/tf", "/tf_static")
_SCANS = (POINT_CLOUD, LASER_SCAN)
_POSES = (ODOMETRY, POSE, POSE_WITH_COVARIANCE)
_MAX_GAP_S = 1.0  # between two poses that are interpolated


class _Entry(NamedTuple):
    """One message of the scans' topic."""

    logged_ns: int
    nth: int  # of those logged at the same time
    frame_id: str
    stamp_ns: int


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag: a file by its suffix, a folder by its metadata.yaml."""
    return (path / "metadata.yaml").is_file() if path.is_dir() else path.suffix.lower() in SUFFIXES


def open_bag(
    path: Path,
    *,
    topic: str | None = None,
    poses: str | None = None,
    frame: str | None = None,
    min_range_m: float = 0.0,
    max_range_m: float | None = None,
    needs_poses: bool = True,
) -> Recording:
    """The scans of one topic of a bag.

    Args:
        path: A `.mcap`, `.db3` or `.bag` file, or a rosbag2 folder.
        topic: Of `PointCloud2` or `LaserScan`; None: the only one there is.
        poses: A topic of `Odometry`, `PoseStamped` or `PoseWithCovarianceStamped` with the poses; None: `/tf` and `/tf_static`.
        frame: The map's frame in `/tf`; None: the topmost above the first scan's.
        min_range_m: Points nearer than this are dropped.
        max_range_m: Beams beyond this are cut: free up to there, no echo.
        needs_poses: False: somebody else places the scans, which all come with the pose of the origin.
    Raises:
        DatasetError: no such topic, no poses, or a damaged bag.
        UsageError: the package rosbags is not installed.
    """
    bag = BagRecording(path, topic=topic, poses=poses, frame=frame, needs_poses=needs_poses)
    return RangeLimited(bag, min_range_m=min_range_m, max_range_m=max_range_m)


class BagRecording(Recording):
    """See `open_bag`. Scans without a pose at their stamp are left out, and a note says how many and why."""

    format = "bag"

    def __init__(
        self, path: Path, *, topic: str | None, poses: str | None, frame: str | None, needs_poses: bool = True
    ) -> None:
        super().__init__(path)
        self._reader = _open(path)
        weakref.finalize(self, self._reader.close)
        self._topic = _choose(self._reader, path, topic, _SCANS, "scans", "--topic")
        self._is_planar = self._type_of(self._topic) == LASER_SCAN
        self._tree = TransformTree(max_gap_s=_MAX_GAP_S)
        self._poses = None if poses is None else PoseTopic(poses, max_gap_s=_MAX_GAP_S)
        entries = self._index(poses)
        if not entries:
            raise DatasetError(f"{path}: no message on {self._topic}")
        self._scans: list[tuple[_Entry, Float64]] = []
        if not needs_poses:
            self.notes = (f"topic {self._topic}",)
            self._scans = [(entry, np.eye(4)) for entry in entries]
            self._stamps = growing([entry.stamp_ns for entry in entries])
            return
        if self._poses is None and len(self._tree) == 0:
            raise DatasetError(f"{path}: nothing on /tf and /tf_static, so no poses; {self._poses_hint()}")
        self._frame = self._tree.root_of(entries[0].frame_id) if frame is None else frame_of(frame)
        self._place(entries)
        self._stamps = growing([entry.stamp_ns for entry, _ in self._scans])

    def __len__(self) -> int:
        return len(self._scans)

    def read(self, i: int) -> RecordedScan:
        entry, pose = self._scans[i]
        with self._damage():
            messages = self._messages([self._topic], entry.logged_ns, entry.logged_ns + 1)
            _, message, _ = next(m for n, m in enumerate(messages) if n == entry.nth)
            points, is_return, pose = self._beams(message, pose)
        return RecordedScan(
            points=points,
            is_return=is_return,
            T_map_sensor=pose,
            stamp_ns=self._stamps[i],
            name=f"{self._topic}@{entry.stamp_ns / 1e9:.3f}",
            is_planar=self._is_planar,
        )

    def _beams(self, message: Any, pose: Float64) -> tuple[Float32, Bool, Float64]:
        """(N, 3) m in the sensor's frame, (N,) which are echoes, and the frame's pose."""
        if not self._is_planar:
            cloud = read_point_cloud(message)
            return cloud.points, np.ones(len(cloud.points), np.bool_), pose
        scan = read_laser_scan(message)
        flat, pose = level(scan.points, pose)
        points = np.zeros((len(flat), 3), np.float32)
        points[:, :2] = flat
        return points, scan.is_return, pose

    def _index(self, poses: str | None) -> list[_Entry]:
        """One pass over the bag: where its scans are, and all its poses."""
        if poses is not None:
            _choose(self._reader, self.path, poses, _POSES, "poses", "--poses")
        wanted = [self._topic, *TF_TOPICS, *([] if poses is None else [poses])]
        entries: list[_Entry] = []
        last_ns, nth = -1, 0
        with self._damage():
            for topic, message, logged_ns in self._messages(wanted):
                if topic == self._topic:
                    nth = nth + 1 if logged_ns == last_ns else 0
                    last_ns = logged_ns
                    entry = _Entry(
                        logged_ns, nth, frame_of(message.header.frame_id), stamp_of(message.header)
                    )
                    entries.append(entry)
                elif topic == poses and self._poses is not None:
                    self._poses.add(message, self._type_of(topic))
                else:
                    self._tree.add(message, static=topic == "/tf_static")
        return entries

    def _place(self, entries: list[_Entry]) -> None:
        """Give each scan its pose; say which have none."""
        missing: list[NoTransformError] = []
        for entry in entries:
            try:
                pose = self._pose_at(entry)
            except NoTransformError as error:
                missing.append(error)
            else:
                self._scans.append((entry, pose))
        where = (
            f"poses on {self._poses.topic}"
            if self._poses
            else f"poses in {self._frame!r} from /tf, /tf_static"
        )
        self.notes = (f"topic {self._topic}", where)
        if missing:
            lost = f"{len(missing)} of {len(entries)} scans have no pose at their stamp: {missing[0]}"
            if not self._scans:
                raise DatasetError(f"{self.path}: {lost}; {self._poses_hint()}")
            self.notes += (lost,)

    def _pose_at(self, entry: _Entry) -> Float64:
        if self._poses is None:
            return self._tree.at(self._frame, entry.frame_id, entry.stamp_ns)
        pose = self._poses.at(entry.stamp_ns)
        child = self._poses.child
        if child is None:
            return pose  # of the sensor itself
        return np.asarray(pose @ self._tree.at(child, entry.frame_id, entry.stamp_ns))

    def _messages(
        self, topics: list[str], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[str, Any, int]]:
        """(topic, message, when it was logged, ns)."""
        connections = [c for c in self._reader.connections if c.topic in topics]
        for connection, logged_ns, raw in self._reader.messages(connections, start, stop):
            yield connection.topic, self._reader.deserialize(raw, connection.msgtype), logged_ns

    @contextlib.contextmanager
    def _damage(self) -> Iterator[None]:
        """Errors of damaged files become a DatasetError: rosbags raises whatever it meets, TypeErrors among them."""
        try:
            yield
        except Exception as error:
            raise DatasetError(f"{self.path}: damaged ({type(error).__name__}: {error})") from error

    def _type_of(self, topic: str) -> str:
        return str(next(c.msgtype for c in self._reader.connections if c.topic == topic))

    def _poses_hint(self) -> str:
        found = sorted(c.topic for c in self._reader.connections if c.msgtype in _POSES)
        if found:
            return f"topics with poses: {', '.join(found)}; try --poses {found[0]}"
        none = f"no topic of Odometry or PoseStamped either; topics: {_topics(self._reader)}"
        return f"{none}; --odometry kiss-icp places 3D scans"


def _open(path: Path) -> Any:
    try:
        from rosbags.highlevel import AnyReader
    except ImportError as error:
        raise rosbags_missing(error) from error
    store = typestore()
    try:
        reader = AnyReader([path], default_typestore=store)
        reader.open()
    except Exception as error:  # as `_damage` says
        raise DatasetError(f"{path}: not a bag that can be read ({error})") from error
    return reader


def _choose(reader: Any, path: Path, topic: str | None, types: tuple[str, ...], what: str, flag: str) -> str:
    """The topic that was named, if its messages fit, or else the only one that does.

    Raises:
        DatasetError: no or several such topics, or another type.
    """
    fitting = sorted({c.topic for c in reader.connections if c.msgtype in types})
    if topic is not None and topic in fitting:
        return topic
    if topic is None and len(fitting) == 1:
        return str(fitting[0])
    kinds = ", ".join(name.rpartition("/")[2] for name in types)
    found = f"topics of {kinds}: {', '.join(fitting) or 'none'}"
    if topic is None and fitting:
        raise DatasetError(f"{path}: several topics of {what}; name one, e.g. {flag} {fitting[0]}; {found}")
    named = "" if topic is None else f" on {topic}"
    raise DatasetError(f"{path}: no {what}{named}; {found}; all topics: {_topics(reader)}")


def _topics(reader: Any) -> str:
    return ", ".join(sorted({f"{c.topic} ({c.msgtype})" for c in reader.connections})) or "none"
