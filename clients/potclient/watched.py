"""Clouds that robots publish, as somebody sees them who only watches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import zenoh

from potclient.arrays import Bool, Float32, Float64
from potclient.errors import BadReplyError
from potclient.link import Link, Subscription, decoded
from potschemas import messages
from potschemas.keys import robot_of
from potschemas.messages import DType
from potschemas.wire import WireError, decode_array

_WAITING = 16  # clouds that wait for a slow watcher


class WatchedCloud(NamedTuple):
    """One cloud on its way to the server; whether it is taken, its receipt says."""

    robot: str
    seq: int
    stamp_ns: int
    points: Float32  # (N, 3) m, sensor frame
    is_return: Bool  # (N,)
    T_map_sensor: Float64 | None  # (4, 4); None where the robot's pose stream says it


def watch_clouds(link: Link, robot: str, callback: Callable[[WatchedCloud], None]) -> Subscription:
    """See `MapClient.watch_clouds`."""

    def deliver(sample: zenoh.Sample) -> None:
        message = decoded(sample.payload, messages.Cloud)
        try:
            callback(cloud_of(robot_of(str(sample.key_expr)), message))
        except (WireError, ValueError) as error:
            raise BadReplyError(f"a cloud that is none: {error}") from error

    key, channel = link.keys.cloud(robot), zenoh.handlers.RingChannel(_WAITING)
    return link.subscribe_samples(key, deliver, f"clouds-{robot}", channel)


def cloud_of(robot: str, message: messages.Cloud) -> WatchedCloud:
    """The arrays of a message, checked.

    Raises:
        WireError: they are not what a cloud has.
    """
    raw = decode_array(message.points, "points", dtypes=(DType.FLOAT32,), shape=(None, (2, 3)))
    points = np.zeros((len(raw), 3), np.float32)
    points[:, : raw.shape[1]] = raw
    is_return = np.ones(len(points), np.bool_)
    if message.is_return is not None:
        is_return = decode_array(
            message.is_return, "is_return", dtypes=(DType.BOOL,), shape=(len(points),)
        ).astype(np.bool_)
    pose = None
    if message.T_map_sensor is not None:
        pose = decode_array(message.T_map_sensor, "T_map_sensor", dtypes=(DType.FLOAT64,), shape=(4, 4))
    return WatchedCloud(robot, message.seq, message.stamp_ns, points, is_return, pose)
