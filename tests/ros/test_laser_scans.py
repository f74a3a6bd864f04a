"""`LaserScan` as beams, and a planar laser seen from above."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.errors import RosMessageError
from potclient.poses import yaw_pose
from potclient.ros.laser_scans import level, read_laser_scan
from tests.ros import messages as ros


def test_infinity_is_no_echo_and_what_is_outside_the_limits_is_no_reading() -> None:
    beams = read_laser_scan(
        ros.laser([1.0, math.inf, math.nan, 0.05, 13.0, -math.inf, 12.0], step=math.pi / 2)
    )
    assert beams.is_return.tolist() == [True, False, True]
    assert np.allclose(beams.points, [[1, 0, 0], [0, 12, 0], [-12, 0, 0]], atol=1e-5)
    assert (beams.n_invalid, beams.frame_id) == (4, "laser")


def test_a_scanner_without_a_largest_range_has_no_free_beams() -> None:
    message = dataclasses.replace(ros.laser([1.0, math.inf]), range_max=math.inf)
    beams = read_laser_scan(message)
    assert beams.is_return.tolist() == [True]


@pytest.mark.parametrize("change", [{"range_min": 5.0, "range_max": 1.0}, {"angle_increment": math.nan}])
def test_a_scan_without_sound_limits_is_refused(change: dict) -> None:
    with pytest.raises(RosMessageError, match="laser scan"):
        read_laser_scan(dataclasses.replace(ros.laser([1.0]), **change))


def test_a_laser_that_hangs_upside_down_sees_the_same_place() -> None:
    upright, hanging = yaw_pose(3.0, -2.0, 0.7, 0.4), yaw_pose(3.0, -2.0, 0.7, 0.4)
    hanging[:3, :3] = hanging[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # rolled by half a turn
    points = np.array([[1, 2, 0], [3, -1, 0]], np.float32)
    flat_u, pose_u = level(points, upright)
    flat_h, pose_h = level(points * [1, -1, 1], hanging)
    assert np.allclose(flat_u, flat_h, atol=1e-6)
    assert np.allclose(pose_u, pose_h)
    assert pose_u[2, 3] == 0.0


@given(x=st.floats(-50, 50), y=st.floats(-50, 50), yaw=st.floats(-3, 3))
def test_levelled_points_lie_where_the_pose_puts_them(x: float, y: float, yaw: float) -> None:
    T = yaw_pose(x, y, yaw, 0.3)
    points = np.array([[1, 2, 0], [3, -1, 0]], np.float32)
    flat, pose = level(points, T)
    expected = points @ T[:3, :3].T + T[:3, 3]
    assert np.allclose(flat @ pose[:2, :2].T + pose[:2, 3], expected[:, :2], atol=1e-4)


def test_a_laser_that_looks_up_is_no_planar_laser() -> None:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    with pytest.raises(RosMessageError, match="tilted by 90 degrees"):
        level(np.zeros((1, 3), np.float32), T)
