"""RobotFeed: the clouds of one robot on their way from a topic to the map."""

from __future__ import annotations

import collections
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import zenoh

from potclient.arrays import Bool, Float32, Float64
from potclient.client import MapClient
from potclient.datasets.scans import limit_range
from potclient.errors import (
    ClosedError,
    NoTransformError,
    PotclientError,
    QueryTimeoutError,
    RosMessageError,
)
from potclient.ros.laser_scans import level, read_laser_scan
from potclient.ros.point_clouds import read_point_cloud
from potclient.ros.types import LASER_SCAN, decode
from potserver.health import Health
from potserver.log import get_logger
from potserver.ros.drops import Drops
from potserver.threads import spawn

log = get_logger("potserver.ros")

MAX_WAITING = 4  # clouds of a robot that may wait for their pose and for the map; the oldest goes first
_SEND_S, _SLICE_S = 10.0, 1.0  # for the map to take one

PoseOf = Callable[[str, int], Float64]  # (4, 4) T_map_sensor of a frame at a stamp, ns


class Waiting(NamedTuple):
    """One message, not decoded yet."""

    type_name: str
    payload: zenoh.ZBytes


class MapSide(NamedTuple):
    """What all robots of a bridge share."""

    client: MapClient
    health: Health
    drops: Drops
    range_m: Callable[[], float]  # of the map; raises PotclientError
    min_range_m: float
    keep_stamps: bool
    note_stamp: Callable[[int], None]  # of a cloud that was sent, ns


class RobotFeed:
    """Takes messages, gives each its pose, and sends it; on a thread of its own, which may wait for poses.

    Args:
        robot: Its id in the map.
        pose_of: Raises NoTransformError where there is none.
    """

    def __init__(self, robot: str, pose_of: PoseOf, side: MapSide) -> None:
        self.robot = robot
        self._pose_of, self._side = pose_of, side
        self._changed = threading.Condition()
        self._waiting: collections.deque[Waiting] = collections.deque()
        self._closing = False
        self._thread = spawn(f"ros-{robot}", self._run)

    def offer(self, waiting: Waiting) -> None:
        """Take a message; never waits. The oldest one goes where too many wait."""
        with self._changed:
            self._waiting.append(waiting)
            n_too_many = len(self._waiting) - MAX_WAITING
            if n_too_many > 0:
                self._waiting.popleft()
            self._changed.notify_all()
        if n_too_many > 0:
            self._side.drops.count("busy", self.robot, f"more than {MAX_WAITING} clouds wait")

    def stop(self) -> None:
        """Take and send no more; a cloud that is on its way ends first."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def join(self, timeout_s: float) -> bool:
        """Wait for the end of the thread, after `stop`; false if it did not end in time."""
        self._thread.join(timeout_s)
        for _ in range(len(self._waiting)):
            self._side.drops.count("closing", self.robot, "the bridge was closed")
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (waiting := self._next()) is not None:
            try:
                self._send(waiting)
                self._side.health.count("ros.clouds.sent")
            except RosMessageError as error:
                self._side.drops.count(error.reason, self.robot, str(error))
            except NoTransformError as error:
                self._side.drops.count("no_pose", self.robot, str(error))
            except ClosedError as error:
                self._side.drops.count("closing", self.robot, str(error))
            except PotclientError as error:  # nobody serves the map, or it does not answer
                self._side.drops.count("no_server", self.robot, str(error))
            except Exception as error:
                log.exception("ros_cloud_failed", robot=self.robot)
                self._side.drops.count("internal", self.robot, repr(error))

    def _next(self) -> Waiting | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing)
            return None if self._closing else self._waiting.popleft()

    def _send(self, waiting: Waiting) -> None:
        side = self._side
        message = decode(waiting.payload.to_bytes(), waiting.type_name)
        points: Float32
        if waiting.type_name == LASER_SCAN:
            points, is_return, frame_id, stamp_ns, _ = read_laser_scan(message)
        else:
            points, _, frame_id, stamp_ns, _ = read_point_cloud(message)
            is_return = np.ones(len(points), np.bool_)
        pose = self._pose_of(frame_id, stamp_ns)
        points, is_return = limit_range(
            points, is_return, min_range_m=side.min_range_m, max_range_m=side.range_m()
        )
        if waiting.type_name == LASER_SCAN:
            points, pose = level(points, pose)
        if len(points) == 0:
            raise RosMessageError("no point of the scan is a number within the ranges", reason="empty")
        self._publish(points, pose, stamp_ns=stamp_ns if side.keep_stamps else None, is_return=is_return)
        side.note_stamp(stamp_ns)

    def _publish(self, points: Float32, pose: Float64, *, stamp_ns: int | None, is_return: Bool) -> None:
        """Send when there is credit, in slices of the time there is, so that a stop is seen."""
        deadline = time.monotonic() + _SEND_S
        while True:
            try:
                self._side.client.publish(
                    points,
                    pose,
                    robot=self.robot,
                    stamp_ns=stamp_ns,
                    is_return=is_return,
                    wait=True,
                    timeout_s=_SLICE_S,
                )
                return
            except QueryTimeoutError:
                if self._closing or time.monotonic() > deadline:
                    raise
