"""Poses at a stamp: the tree of `/tf` and `/tf_static`, and the track of a pose topic. Nothing is extrapolated."""

from __future__ import annotations

import bisect
import math
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from potclient.arrays import Float64
from potclient.errors import NoTransformError, RosMessageError
from potclient.poses import interpolate, quaternion_of, quaternion_pose
from potclient.ros.types import ODOMETRY, POSE_WITH_COVARIANCE, TF, frame_of, header, make, stamp_of

MAX_FRAMES = 10_000  # of a tree


def transform(parent: str, child: str, T_parent_child: Float64, stamp_ns: int) -> Any:
    """A `TFMessage` with one transform, (4, 4)."""
    x, y, z = T_parent_child[:3, 3].tolist()
    qw, qx, qy, qz = quaternion_of(T_parent_child[:3, :3]).tolist()
    stamped = make(
        "geometry_msgs/msg/TransformStamped",
        header=header(parent, stamp_ns),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )
    return make(TF, transforms=[stamped])


class Track:
    """Stamped poses of one thing.

    Args:
        max_gap_s: Two poses further apart are not interpolated between.
        keep_s: How far back poses are kept; None: all. A pose older than that tells that the clock was set back (a
            simulation began anew), and begins a new track.
    """

    def __init__(self, *, max_gap_s: float, keep_s: float | None = None) -> None:
        self._max_gap_ns = int(max_gap_s * 1e9)
        self._keep_ns = None if keep_s is None else int(keep_s * 1e9)
        self._stamps: list[int] = []
        self._poses: list[Float64] = []

    def add(self, stamp_ns: int, pose: Float64) -> None:
        """Keep a (4, 4) pose; it takes the place of one with the same stamp."""
        stamps, poses = self._stamps, self._poses
        if self._keep_ns is not None and stamps:
            if stamp_ns < stamps[-1] - self._keep_ns:
                stamps.clear()
                poses.clear()
            elif (
                stamps[0] < stamp_ns - 2 * self._keep_ns
            ):  # by halves, so that a pose costs the same however many there are
                first = bisect.bisect_left(stamps, stamp_ns - self._keep_ns)
                del stamps[:first], poses[:first]
        i = bisect.bisect_left(stamps, stamp_ns)
        if i < len(stamps) and stamps[i] == stamp_ns:
            poses[i] = pose
            return
        stamps.insert(i, stamp_ns)
        poses.insert(i, pose)

    def at(self, stamp_ns: int, name: str) -> Float64:
        """The (4, 4) pose at a stamp, between its two neighbours.

        Raises:
            NoTransformError: the stamp is outside the track, or in a hole of it.
        """
        after = bisect.bisect_left(self._stamps, stamp_ns)
        if after == len(self._stamps):
            since = f"{(stamp_ns - self._stamps[-1]) / 1e9:.3f} s before it" if self._stamps else "not there"
            raise NoTransformError(f"{name} at {stamp_ns / 1e9:.3f}: the newest is {since}", may_come=True)
        if self._stamps[after] == stamp_ns:
            return self._poses[after]
        if after == 0:
            early_s = (self._stamps[0] - stamp_ns) / 1e9
            raise NoTransformError(
                f"{name} at {stamp_ns / 1e9:.3f}: the oldest is {early_s:.3f} s after it", may_come=False
            )
        before = after - 1
        gap_ns = self._stamps[after] - self._stamps[before]
        if gap_ns > self._max_gap_ns:
            raise NoTransformError(
                f"{name} at {stamp_ns / 1e9:.3f}: its neighbours are {gap_ns / 1e9:.2f} s apart",
                may_come=False,
            )
        fraction = (stamp_ns - self._stamps[before]) / gap_ns
        return interpolate(self._poses[before], self._poses[after], fraction)


class TransformTree:
    """The frames of one robot, and how they lie to each other at a stamp. Any thread may call any method.

    Args:
        max_gap_s, keep_s: Of every moving frame, see `Track`.
    """

    def __init__(self, *, max_gap_s: float, keep_s: float | None = None) -> None:
        self._max_gap_s, self._keep_s = max_gap_s, keep_s
        self._parents: dict[str, str] = {}
        self._moving: dict[str, Track] = {}  # by child
        self._fixed: dict[str, Float64] = {}
        self._changed = threading.Condition()

    def __len__(self) -> int:
        """Frames that have a parent."""
        return len(self._parents)

    def add(self, message: Any, *, static: bool) -> None:
        """Take in a `TFMessage`.

        Raises:
            RosMessageError: a transform is not rigid; those before it were taken.
        """
        with self._changed:
            for transform in message.transforms:
                self._add_one(transform, static)
            self._changed.notify_all()

    def _add_one(self, transform: Any, static: bool) -> None:
        parent, child = frame_of(transform.header.frame_id), frame_of(transform.child_frame_id)
        if not parent or not child or parent == child:
            raise RosMessageError(
                f"transform from {child!r} to {parent!r}: need two frames", reason="bad_transform"
            )
        if child not in self._parents and len(self._parents) >= MAX_FRAMES:
            raise RosMessageError(
                f"frame {child!r}: a tree has {MAX_FRAMES} frames at most", reason="too_many_frames"
            )
        t, q = transform.transform.translation, transform.transform.rotation
        pose = _pose((t.x, t.y, t.z), q, f"transform from {child} to {parent}")
        if self._parents.get(child) != parent:
            self._moving.pop(child, None)
            self._fixed.pop(child, None)
        self._parents[child] = parent
        if static:
            self._fixed[child] = pose
            return
        track = self._moving.get(child)
        if track is None:
            track = self._moving[child] = Track(max_gap_s=self._max_gap_s, keep_s=self._keep_s)
        track.add(stamp_of(transform.header), pose)

    def root_of(self, frame: str) -> str:
        """The topmost frame above this one: itself, if it has no parent."""
        with self._changed:
            return self._chain(frame)[-1]

    def at(self, target: str, source: str, stamp_ns: int, *, wait_s: float = 0.0) -> Float64:
        """(4, 4) T_target_source at a stamp.

        Args:
            wait_s: How long to wait for a transform that may still come.
        Raises:
            NoTransformError: a frame is not known, the two are not connected, or a link has no transform at the stamp.
        """
        with self._changed:
            return _waiting(self._changed, lambda: self._at(target, source, stamp_ns), wait_s)

    def _at(self, target: str, source: str, stamp_ns: int) -> Float64:
        up, down = self._chain(source), self._chain(target)
        common = next((frame for frame in up if frame in down), None)
        if common is None:
            raise NoTransformError(
                f"no transform from {source!r} to {target!r}: the frames above {source!r} are"
                f" {_names(up[1:])}, those above {target!r} are {_names(down[1:])}",
                may_come=True,
            )
        T_common_source = self._climb(up[: up.index(common)], stamp_ns)
        T_common_target = self._climb(down[: down.index(common)], stamp_ns)
        return np.asarray(np.linalg.inv(T_common_target) @ T_common_source)

    def _climb(self, frames: list[str], stamp_ns: int) -> Float64:
        """(4, 4) from the first of these frames to the parent of the last."""
        pose: Float64 = np.eye(4)
        for child in frames:
            fixed = self._fixed.get(child)
            name = f"transform from {child!r} to {self._parents[child]!r}"
            pose = (self._moving[child].at(stamp_ns, name) if fixed is None else fixed) @ pose
        return pose

    def _chain(self, frame: str) -> list[str]:
        """The frame and all above it; a loop ends where it closes."""
        chain = [frame]
        while (parent := self._parents.get(chain[-1])) is not None and parent not in chain:
            chain.append(parent)
        return chain


class PoseTopic:
    """The poses that one topic of `Odometry`, `PoseStamped` or `PoseWithCovarianceStamped` brings. Any thread may call.

    Args:
        max_gap_s, keep_s: See `Track`.
    """

    def __init__(self, topic: str, *, max_gap_s: float, keep_s: float | None = None) -> None:
        self.topic = topic
        self._track = Track(max_gap_s=max_gap_s, keep_s=keep_s)
        self._child: str | None = None
        self._changed = threading.Condition()

    @property
    def child(self) -> str | None:
        """The frame whose pose it is, where the messages say so (`Odometry`)."""
        return self._child

    def add(self, message: Any, type_name: str) -> None:
        """Take in a message.

        Raises:
            RosMessageError: its pose is not rigid.
        """
        pose = message.pose.pose if type_name in (ODOMETRY, POSE_WITH_COVARIANCE) else message.pose
        p = pose.position
        matrix = _pose((p.x, p.y, p.z), pose.orientation, f"pose on {self.topic}")
        with self._changed:
            if type_name == ODOMETRY:
                self._child = frame_of(message.child_frame_id)
            self._track.add(stamp_of(message.header), matrix)
            self._changed.notify_all()

    def at(self, stamp_ns: int, *, wait_s: float = 0.0) -> Float64:
        """The (4, 4) pose at a stamp; `wait_s` as for `TransformTree.at`.

        Raises:
            NoTransformError: the topic has none there.
        """
        name = f"pose on {self.topic}"
        with self._changed:
            return _waiting(self._changed, lambda: self._track.at(stamp_ns, name), wait_s)


def _waiting(changed: threading.Condition, find: Callable[[], Float64], wait_s: float) -> Float64:
    """What `find` gives, tried again with every change until the time is over; the condition is held."""
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return find()
        except NoTransformError as error:
            if not error.may_come or not changed.wait(max(0.0, deadline - time.monotonic())):
                raise


def _pose(position: tuple[float, float, float], q: Any, what: str) -> Float64:
    quaternion = np.array([q.w, q.x, q.y, q.z], np.float64)
    length = float(np.linalg.norm(quaternion))
    if not (math.isfinite(length) and np.isfinite(position).all() and abs(length - 1.0) < 0.1):
        raise RosMessageError(
            f"{what}: position {position}, quaternion of length {length:g}", reason="bad_transform"
        )
    return quaternion_pose(np.array(position, np.float64), quaternion)


def _names(frames: list[str]) -> str:
    return ", ".join(map(repr, frames)) or "none"
