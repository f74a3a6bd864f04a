"""Clouds and poses: from robots, and to and from the journal."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from potschemas import messages, wire
from potschemas.messages import DType
from potserver.codec.base import FLOATS, MAX_SMALL_BYTES, decode, decode_array
from potserver.domain.types import Float64, ParamsKind, Scan, check_rigid
from potserver.errors import (
    BadMessageError,
    BadPointsError,
    EmptyError,
    NoPoseError,
    OutOfRangeError,
    TooLargeError,
)
from potserver.limits import Limits

UNKNOWN_SEQ = -1  # in the receipt of a cloud whose number could not be read
PoseAt = Callable[[str, int], Float64]  # (4, 4) T_map_sensor of a robot at a stamp, ns


class CloudHead(NamedTuple):
    """What of a cloud can be read even when the rest is unsound."""

    seq: int
    robot_id: str | None


class _CloudHead(messages.Message, frozen=True, kw_only=True):
    schema = messages.Cloud.schema
    seq: messages.Sequence
    robot: messages.Identifier | None = None


def decode_cloud_head(payload: bytes) -> CloudHead:
    """The number and sender of a cloud; `UNKNOWN_SEQ` when even they cannot be read."""
    try:
        head = wire.decode(payload, _CloudHead, wire.request_limits(len(payload)))
    except wire.WireError:
        return CloudHead(UNKNOWN_SEQ, None)
    return CloudHead(head.seq, head.robot)


@np.errstate(over="ignore", invalid="ignore")  # hostile numbers may overflow on the way to their error
def decode_cloud(payload: bytes, *, robot_id: str | None, limits: Limits, pose_at: PoseAt) -> Scan:
    """A scan from the payload of `in/<robot>/cloud` or `in/<robot>/integrate`.

    Args:
        payload: A `messages.Cloud`.
        robot_id: From the key; None for a kept cloud, which says it itself.
        limits: Bounds on bytes, points and coordinates.
        pose_at: Called when the cloud brings no pose.
    Raises:
        BadMessageError: not a cloud, or its robot is missing or not the key's.
        ShapeError: an array has the wrong dtype, shape or byte count.
        TooLargeError: too many bytes or points.
        EmptyError: no points.
        BadPointsError: NaN or infinite coordinates.
        OutOfRangeError: coordinates beyond the map's bounds, in the sensor frame or after the pose.
        BadPoseError: not rigid, or not finite.
        NoPoseError: no pose, and none at the stamp.
    """
    cloud = decode(payload, messages.Cloud, limits.max_cloud_bytes)
    sender = _sender(cloud, robot_id)
    points = decode_array(cloud.points, "points", FLOATS, (None, (2, 3)))
    n = len(points)
    if n > limits.max_cloud_points:
        raise TooLargeError(f"cloud of {n} points, the limit is {limits.max_cloud_points}")
    if n == 0:
        raise EmptyError("the cloud has no points")
    is_return = (
        np.ones(n, np.bool_)
        if cloud.is_return is None
        else decode_array(cloud.is_return, "is_return", (DType.BOOL,), (n,))
    )
    _check_coordinates(points, limits.max_coordinate_m)
    xyz = np.zeros((n, 3), np.float32)
    xyz[:, : points.shape[1]] = points
    pose = (
        pose_at(sender, cloud.stamp_ns)
        if cloud.T_map_sensor is None
        else decode_array(cloud.T_map_sensor, "T_map_sensor", (DType.FLOAT64,), (4, 4))
    )
    check_rigid(pose)
    _check_placed(xyz, pose, limits.max_coordinate_m)
    return Scan(
        robot_id=sender,
        session="" if cloud.session is messages.ABSENT else cloud.session,
        seq=cloud.seq,
        stamp_ns=cloud.stamp_ns,
        points=xyz,
        is_return=is_return,
        T_map_sensor=pose,
        is_planar=points.shape[1] == 2,
        params=None if cloud.params is messages.ABSENT else ParamsKind(cloud.params.value),
    )


def encode_cloud(scan: Scan) -> bytes:
    """The scan as `pot.cloud.v1`, complete: `read_cloud` needs nothing else to map the same scan again."""
    return wire.encode(
        messages.Cloud(
            seq=scan.seq,
            stamp_ns=scan.stamp_ns,
            points=wire.encode_array(scan.points[:, :2] if scan.is_planar else scan.points),
            T_map_sensor=wire.encode_array(scan.T_map_sensor),
            is_return=None if scan.is_return.all() else wire.encode_array(scan.is_return),
            robot=scan.robot_id,
            session=scan.session or messages.ABSENT,
        )
    )


def read_cloud(payload: bytes) -> Scan:
    """A scan that was accepted before: today's limits do not apply.

    Raises:
        PotserverError: it is no complete cloud.
    """
    unlimited = Limits(max_cloud_bytes=2**40, max_cloud_points=2**40, max_coordinate_m=math.inf)
    return decode_cloud(payload, robot_id=None, limits=unlimited, pose_at=_no_pose)


@np.errstate(over="ignore", invalid="ignore")
def decode_pose(payload: bytes, *, max_bytes: int = MAX_SMALL_BYTES) -> tuple[int, Float64]:
    """Stamp and (4, 4) matrix of one pose of a pose stream.

    Raises:
        BadMessageError, ShapeError, BadPoseError: see `decode_cloud`.
    """
    pose = decode(payload, messages.Pose, max_bytes)
    return pose.stamp_ns, decode_transform(pose.T_map_sensor, "T_map_sensor")


def decode_transform(array: messages.Array, name: str) -> Float64:
    """A (4, 4) rigid transform.

    Raises:
        ShapeError: another dtype, shape or byte count. BadPoseError: it is not rigid.
    """
    matrix = decode_array(array, name, (DType.FLOAT64,), (4, 4))
    check_rigid(matrix)
    return matrix


def _sender(cloud: messages.Cloud, robot_id: str | None) -> str:
    if robot_id is None:
        if cloud.robot is None:
            raise BadMessageError("pot.cloud.v1: a cloud that is kept needs the field `robot`")
        return cloud.robot
    if cloud.robot not in (None, robot_id):
        raise BadMessageError(
            f"pot.cloud.v1: the cloud says robot {cloud.robot!r}, its key says {robot_id!r}"
        )
    return robot_id


def _no_pose(robot_id: str, _stamp_ns: int) -> Float64:
    raise NoPoseError(f"the kept cloud of {robot_id} has no pose")


def _check_coordinates(points: NDArray[np.floating[Any]], max_coordinate_m: float) -> None:
    """One pass over the array when all is well: NaN and infinity survive a maximum."""
    extent = float(np.abs(points).max(initial=0.0))
    if extent <= max_coordinate_m:
        return
    bad = int((~np.isfinite(points)).any(axis=1).sum())
    if bad:
        raise BadPointsError(f"{bad} of {len(points)} points have NaN or infinite coordinates")
    raise OutOfRangeError(f"points reach {extent:.6g} m, the limit is {max_coordinate_m:.6g} m")


def _check_placed(points: NDArray[np.float32], pose: Float64, max_coordinate_m: float) -> None:
    """Bound the map-frame coordinates; exact only when the cheap bound does not already settle it."""
    reach = math.sqrt(3) * float(np.abs(points).max())
    if float(np.abs(pose[:3, 3]).max()) + reach <= max_coordinate_m:
        return
    placed = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    extent = max(float(np.abs(placed).max()), float(np.abs(pose[:3, 3]).max()))
    if extent > max_coordinate_m:
        raise OutOfRangeError(
            f"the placed cloud reaches {extent:.6g} m, the limit is {max_coordinate_m:.6g} m"
        )
