"""Poses published on `in/<robot>/pose`."""

from __future__ import annotations

import zenoh

from potschemas import keys, messages
from potserver.adapters import codec
from potserver.adapters.key_exprs import sender_of
from potserver.adapters.log import get_logger
from potserver.adapters.poses import PoseBuffer
from potserver.errors import PotserverError
from potserver.health import Health

log = get_logger("potserver.poses")

_MAX_POSE_BYTES = 4096
_NEWEST_KEPT = 256  # a burst beyond this loses its oldest poses; interpolation bridges the hole


class PoseSubscriber:
    """Fills the pose buffer."""

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
            map_keys.pose("*"), zenoh.handlers.RingChannel(_NEWEST_KEPT)
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
        codec.check_robot_id(robot_id, self._allowed_robots)
        codec.check_encoding(str(sample.encoding), messages.Pose)
        codec.check_size(len(sample.payload), _MAX_POSE_BYTES, "pose")
        self._poses.add(robot_id, *codec.decode_pose(sample.payload.to_bytes()))
