"""Poses of the robots' pose streams, published on `in/<robot>/pose`, and the pose at a cloud's stamp."""

from __future__ import annotations

import bisect
import collections
import threading
from collections.abc import Callable

import zenoh

from potclient.poses import interpolate
from potschemas import keys, messages
from potserver.adapters.key_exprs import check_robot_id, sender_of
from potserver.adapters.stamps import check_not_future
from potserver.codec.base import MAX_SMALL_BYTES, check_encoding, check_size
from potserver.codec.clouds import decode_pose
from potserver.domain.types import Float64, check_rigid
from potserver.errors import NoPoseError, PotserverError
from potserver.health import Health
from potserver.log import get_logger

log = get_logger("potserver.poses")

POSES_PER_ROBOT = 1024  # kept: 20 s at 50 Hz
WAIT_S = 0.2  # since a cloud came, for the stream to reach its stamp: a few of its periods
_LATEST_NS = 1_000_000_000  # behind the newest pose: what is older comes of a clock that went back
_CHANNEL = 256  # a burst beyond this loses its oldest poses; interpolation bridges the hole


class PoseNotYetError(NoPoseError):
    """The robot's stream has not reached the stamp, and may still do so."""

    def __init__(self, message: str, stamp_ns: int) -> None:
        super().__init__(message)
        self.stamp_ns = stamp_ns


class PoseSubscriber:
    """Fills the pose buffer of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        poses: PoseBuffer,
        health: Health,
        allowed_robots: frozenset[str],
    ) -> None:
        self._poses, self._health, self._allowed_robots = poses, health, allowed_robots
        self._subscriber = session.declare_subscriber(
            map_keys.pose("*"), zenoh.handlers.RingChannel(_CHANNEL)
        )

    def run(self) -> None:
        """Take samples until undeclared, on a thread of our own."""
        for sample in self._subscriber:
            robot_id = sender_of(sample.key_expr)
            if robot_id is None:
                self._health.count("poses.rejected.bad_key")
                continue
            try:
                self._add(robot_id, sample)
                self._health.count("poses.accepted")
            except PotserverError as error:
                self._health.count(f"poses.rejected.{error.code}")
                log.debug("pose_refused", key=str(sample.key_expr), reason=error.code, detail=str(error))
            except Exception:
                log.exception("pose_failed", key=str(sample.key_expr))
                self._health.count("poses.rejected.internal")

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._subscriber.undeclare()

    def _add(self, robot_id: str, sample: zenoh.Sample) -> None:
        self._health.count("poses.received")
        check_robot_id(robot_id, self._allowed_robots)
        check_encoding(str(sample.encoding), messages.Pose)
        check_size(len(sample.payload), MAX_SMALL_BYTES, "pose")
        self._poses.add(robot_id, *decode_pose(sample.payload.to_bytes()))


class PoseBuffer:
    """The last poses of every robot, bounded in robots and in poses a robot.

    Args:
        max_gap_s: Two poses further apart than this are not interpolated between.
        max_future_s: Poses further ahead of our clock are refused.
        max_robots: Robots kept; the one that has been silent longest goes first.
        max_per_robot: Poses kept of each.
    """

    def __init__(
        self,
        *,
        max_gap_s: float = 0.5,
        max_future_s: float = 5.0,
        max_robots: int = 1024,
        max_per_robot: int = POSES_PER_ROBOT,
    ) -> None:
        self._max_per_robot, self._max_robots = max_per_robot, max_robots
        self._max_gap_ns = int(max_gap_s * 1e9)
        self._max_future_s = max_future_s
        self._lock = threading.Lock()
        self._tracks: collections.OrderedDict[str, _Track] = collections.OrderedDict()

    def add(self, robot_id: str, stamp_ns: int, T_map_sensor: Float64) -> None:
        """Keep one pose; an older pose of the same stamp is replaced.

        Raises:
            BadPoseError: the pose is not rigid.
            OldStampError: the stamp is too far in the future.
        """
        check_rigid(T_map_sensor)
        check_not_future(stamp_ns, self._max_future_s)
        with self._lock:
            track = self._tracks.setdefault(robot_id, _Track())
            self._tracks.move_to_end(robot_id)
            if len(self._tracks) > self._max_robots:
                self._tracks.popitem(last=False)
            track.insert(stamp_ns, T_map_sensor, self._max_per_robot)
            tell = track.tell_if_reached()
        if tell is not None:
            tell()

    def at(self, robot_id: str, stamp_ns: int) -> Float64:
        """(4, 4) pose of a robot at a stamp, interpolated between its two neighbours.

        Raises:
            PoseNotYetError: the stream ends before the stamp.
            NoPoseError: no stream, the stamp is before it, or its neighbours are too far apart.
        """
        with self._lock:
            track = self._tracks.get(robot_id)
            if track is None:
                raise NoPoseError(f"the cloud has no pose, and {robot_id} has sent no pose stream")
            if stamp_ns > track.stamps[-1]:
                late_ms = (stamp_ns - track.stamps[-1]) / 1e6
                raise PoseNotYetError(
                    f"the cloud has no pose, and the stream of {robot_id} ends {late_ms:.1f} ms before it",
                    stamp_ns,
                )
            return track.at(stamp_ns, self._max_gap_ns)

    def tell_when_reached(self, robot_id: str, stamp_ns: int, tell: Callable[[], None]) -> None:
        """Call once the robot's stream reaches a stamp, at once if it has; a robot has one such wish, the latest."""
        with self._lock:
            track = self._tracks.get(robot_id)
            if track is None:
                return
            track.awaited = (stamp_ns, tell)
            reached = track.tell_if_reached()
        if reached is not None:
            reached()


class _Track:
    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.poses: list[Float64] = []
        self.awaited: tuple[int, Callable[[], None]] | None = None  # a stamp, and who wants to know

    def tell_if_reached(self) -> Callable[[], None] | None:
        """Who is to be told now, outside the lock."""
        if self.awaited is None or self.stamps[-1] < self.awaited[0]:
            return None
        tell, self.awaited = self.awaited[1], None
        return tell

    def insert(self, stamp_ns: int, pose: Float64, max_poses: int) -> None:
        i = bisect.bisect_left(self.stamps, stamp_ns)
        if i < len(self.stamps) and self.stamps[i] == stamp_ns:
            self.poses[i] = pose
            return
        is_full = len(self.stamps) == max_poses
        is_late = bool(self.stamps) and stamp_ns < self.stamps[-1] - _LATEST_NS
        if is_late or (is_full and i < max(1, max_poses // 2)):
            # no pose is that late: the robot's clock went back, or its log starts again
            self.stamps, self.poses = [stamp_ns], [pose]
            return
        if is_full:
            del self.stamps[0], self.poses[0]
            i -= 1
        self.stamps.insert(i, stamp_ns)
        self.poses.insert(i, pose)

    def at(self, stamp_ns: int, max_gap_ns: int) -> Float64:
        after = bisect.bisect_left(self.stamps, stamp_ns)
        if self.stamps[after] == stamp_ns:
            return self.poses[after]
        if after == 0:
            early_ms = (self.stamps[0] - stamp_ns) / 1e6
            raise NoPoseError(f"the cloud is {early_ms:.1f} ms older than the oldest pose kept")
        before = after - 1
        gap_ns = self.stamps[after] - self.stamps[before]
        if gap_ns > max_gap_ns:
            raise NoPoseError(f"the poses around the cloud's stamp are {gap_ns / 1e6:.0f} ms apart")
        return interpolate(self.poses[before], self.poses[after], (stamp_ns - self.stamps[before]) / gap_ns)
