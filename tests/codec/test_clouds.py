"""Clouds and poses: bytes to scans, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potschemas import messages, wire
from potserver import errors
from potserver.codec.clouds import UNKNOWN_SEQ, decode_cloud, decode_cloud_head, decode_pose
from potserver.domain.types import Scan
from potserver.errors import PotserverError
from potserver.limits import Limits

LIMITS = Limits(max_cloud_bytes=10_000, max_cloud_points=100, max_coordinate_m=1000.0)


def no_pose(robot_id: str, stamp_ns: int) -> Any:
    raise errors.NoPoseError(f"{robot_id} at {stamp_ns}")


def cloud(**changes: Any) -> bytes:
    fields: dict[str, Any] = {
        "seq": 3,
        "stamp_ns": 17,
        "points": wire.encode_array(np.ones((5, 3), np.float32)),
        "T_map_sensor": wire.encode_array(np.eye(4)),
    }
    return wire.encode(messages.Cloud(**fields | changes))


def decode(payload: bytes, robot_id: str | None = "r1", pose_at: Any = no_pose) -> Scan:
    return decode_cloud(payload, robot_id=robot_id, limits=LIMITS, pose_at=pose_at)


def outcome(read: Callable[[bytes], Any], payload: bytes) -> str:
    """The code of the error, or `ok`; anything but a typed error is raised."""
    try:
        read(payload)
    except PotserverError as error:
        return error.code
    return "ok"


def test_a_cloud_becomes_a_scan() -> None:
    pose = np.eye(4)
    pose[:3, 3] = (1, 2, 3)
    echoes = np.array([True, False, True, True, True])
    scan = decode(
        cloud(T_map_sensor=wire.encode_array(pose), is_return=wire.encode_array(echoes), robot="r1")
    )
    assert (scan.robot_id, scan.seq, scan.stamp_ns, scan.is_planar) == ("r1", 3, 17, False)
    np.testing.assert_array_equal(scan.T_map_sensor, pose)
    np.testing.assert_array_equal(scan.is_return, echoes)
    assert scan.points.dtype == np.float32


def test_without_is_return_all_beams_returned() -> None:
    assert decode(cloud()).is_return.all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_two_columns_are_a_planar_scan_with_z_zero(dtype: Any) -> None:
    scan = decode(cloud(points=wire.encode_array(np.full((5, 2), 1.5, dtype))))
    assert scan.is_planar
    np.testing.assert_array_equal(scan.points, np.array([[1.5, 1.5, 0]] * 5, np.float32))


def test_a_cloud_without_a_pose_asks_for_one() -> None:
    asked = []

    def pose_at(robot_id: str, stamp_ns: int) -> Any:
        asked.append((robot_id, stamp_ns))
        return np.eye(4)

    decode(cloud(T_map_sensor=None), pose_at=pose_at)
    assert asked == [("r1", 17)]


@pytest.mark.parametrize(
    ("points", "error"),
    [
        (np.zeros((0, 3)), errors.EmptyError),
        (np.ones((101, 3)), errors.TooLargeError),
        (np.ones((5, 4)), errors.ShapeError),
        (np.ones(5), errors.ShapeError),
        (np.ones((5, 3), np.int64), errors.ShapeError),
        (np.array([[1.0, np.nan, 0]]), errors.BadPointsError),
        (np.array([[1.0, np.inf, 0]]), errors.BadPointsError),
        (np.array([[1.0, np.nan, 1e9]]), errors.BadPointsError),
        (np.array([[1.0, -1001, 0]]), errors.OutOfRangeError),
        (np.array([[1.0, 1e300, 0]]), errors.OutOfRangeError),
    ],
)
def test_bad_points_have_their_class(points: Any, error: type[PotserverError]) -> None:
    with pytest.raises(error):
        decode(cloud(points=wire.encode_array(points)))


@given(st.floats(-999, 999), st.floats(-0.99, 0.99), st.integers(0, 3))
def test_the_bound_is_on_placed_coordinates(x: float, c: float, axis: int) -> None:
    """The cheap bound never refuses what the exact one takes, and the other way round."""
    pose = np.eye(4)
    s = np.sqrt(1 - c * c)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[axis % 3, 3] = x
    points = np.array([[400.0, 30.0, 5.0]], np.float32)
    placed = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
    payload = cloud(points=wire.encode_array(points), T_map_sensor=wire.encode_array(pose))
    if np.abs(placed).max() > LIMITS.max_coordinate_m:
        with pytest.raises(errors.OutOfRangeError):
            decode(payload)
    else:
        decode(payload)


def test_the_robot_of_the_key_and_of_the_message_must_agree() -> None:
    assert decode(cloud(robot="r2"), robot_id=None).robot_id == "r2"
    with pytest.raises(errors.BadMessageError, match="needs the field `robot`"):
        decode(cloud(), robot_id=None)
    with pytest.raises(errors.BadMessageError, match="its key says"):
        decode(cloud(robot="r2"), robot_id="r1")


def test_too_many_bytes_are_not_parsed() -> None:
    with pytest.raises(errors.TooLargeError):
        decode(b"\xc1" * 10_001)


def test_the_number_of_a_bad_cloud_is_read_where_it_can_be() -> None:
    assert decode_cloud_head(cloud(robot="r9")) == (3, "r9")
    assert decode_cloud_head(cloud(points=wire.encode_array(np.ones(2, np.int64)))).seq == 3
    assert decode_cloud_head(cloud()[:-1]) == (UNKNOWN_SEQ, None)
    assert decode_cloud_head(b"") == (UNKNOWN_SEQ, None)


@given(st.binary(max_size=300))
def test_random_bytes_are_only_ever_typed_errors(payload: bytes) -> None:
    for read in (decode, decode_pose):
        assert outcome(read, payload) != "internal"


@given(st.data())
def test_a_changed_byte_is_a_scan_or_a_typed_error(data: st.DataObject) -> None:
    payload = bytearray(cloud(robot="r1"))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert outcome(decode, bytes(payload)) != "internal"
