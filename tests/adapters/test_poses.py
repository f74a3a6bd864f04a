"""The pose at a cloud's stamp."""

from __future__ import annotations

import math
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potserver.adapters.poses import PoseBuffer, PoseNotYetError, interpolate
from potserver.domain.types import yaw_pose
from potserver.errors import BadPoseError, NoPoseError, OldStampError

MS = 1_000_000


def random_pose(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = q, rng.normal(size=3) * 100
    return pose


def test_between_two_poses_it_goes_straight_and_turns_evenly() -> None:
    middle = interpolate(yaw_pose(0, 0, 0.0), yaw_pose(4, 2, 1.0), 0.25)
    np.testing.assert_allclose(middle, yaw_pose(1, 0.5, 0.25), atol=1e-12)


def test_it_turns_the_shorter_way() -> None:
    middle = interpolate(yaw_pose(0, 0, math.radians(170)), yaw_pose(0, 0, math.radians(-170)), 0.5)
    np.testing.assert_allclose(middle, yaw_pose(0, 0, math.pi), atol=1e-12)


@given(st.integers(0, 2**31), st.integers(0, 2**31), st.floats(0, 1))
def test_interpolation_is_rigid_meets_its_ends_and_turns_with_the_frame(
    a: int, b: int, fraction: float
) -> None:
    start, end, turn = random_pose(a), random_pose(b), random_pose(a ^ b)
    pose = interpolate(start, end, fraction)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(interpolate(start, end, 0.0), start, atol=1e-7)
    np.testing.assert_allclose(interpolate(start, end, 1.0), end, atol=1e-7)
    angle = math.acos(min(1.0, max(-1.0, (np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2)))
    if angle < math.pi - 1e-3:  # half a turn has two shortest ways
        np.testing.assert_allclose(interpolate(turn @ start, turn @ end, fraction), turn @ pose, atol=1e-6)


def test_poses_may_come_out_of_order() -> None:
    poses = PoseBuffer()
    for ms, x in ((30, 3.0), (10, 1.0), (20, 2.0)):
        poses.add("r", ms * MS, yaw_pose(x, 0, 0))
    assert poses.at("r", 25 * MS)[0, 3] == pytest.approx(2.5)
    assert poses.at("r", 10 * MS)[0, 3] == 1.0
    assert poses.at("r", 30 * MS)[0, 3] == 3.0


@pytest.mark.parametrize(
    ("robot", "ms", "why"),
    [
        ("r", 9, "older than"),
        ("r", 31, "ends 1.0 ms before"),
        ("r", 25, "10 ms apart"),
        ("x", 15, "no pose stream"),
    ],
)
def test_outside_the_buffer_there_is_no_pose(robot: str, ms: int, why: str) -> None:
    poses = PoseBuffer(max_gap_s=0.009)
    for stamp in (10, 15, 20, 30):
        poses.add("r", stamp * MS, yaw_pose(0, 0, 0))
    with pytest.raises(NoPoseError, match=why):
        poses.at(robot, ms * MS)


def test_who_waits_for_a_late_pose_is_told() -> None:
    poses, told = PoseBuffer(), []
    poses.add("r", 10 * MS, yaw_pose(1, 0, 0))
    with pytest.raises(PoseNotYetError) as caught:
        poses.at("r", 15 * MS)
    poses.tell_when_reached("r", caught.value.stamp_ns, lambda: told.append("r"))
    poses.add("other", 20 * MS, yaw_pose(0, 0, 0))
    poses.add("r", 12 * MS, yaw_pose(2, 0, 0))
    assert told == []
    poses.add("r", 20 * MS, yaw_pose(3, 0, 0))
    poses.add("r", 30 * MS, yaw_pose(3, 0, 0))
    assert told == ["r"], "once"
    poses.tell_when_reached("r", 15 * MS, lambda: told.append("late"))
    assert told == ["r", "late"], "it had come in between"
    poses.tell_when_reached("x", 15 * MS, lambda: told.append("x"))
    assert len(told) == 2


def test_it_is_bounded_in_poses_and_robots() -> None:
    poses = PoseBuffer(max_per_robot=3, max_robots=2)
    for ms in range(10):
        poses.add("a", ms * MS, yaw_pose(ms, 0, 0))
    with pytest.raises(NoPoseError, match="older than"):
        poses.at("a", 6 * MS)
    assert poses.at("a", 7 * MS)[0, 3] == 7.0
    poses.add("b", 0, yaw_pose(0, 0, 0))
    poses.add("a", 10 * MS, yaw_pose(10, 0, 0))
    poses.add("c", 0, yaw_pose(0, 0, 0))
    with pytest.raises(NoPoseError, match="no pose stream"):
        poses.at("b", 0)
    assert poses.at("a", 10 * MS)[0, 3] == 10.0


def test_a_full_track_starts_again_when_the_robots_clock_goes_back() -> None:
    poses = PoseBuffer(max_per_robot=4)
    for ms in (100, 110, 120, 130):
        poses.add("r", ms * MS, yaw_pose(ms, 0, 0))
    poses.add("r", 125 * MS, yaw_pose(125, 0, 0))
    assert poses.at("r", 125 * MS)[0, 3] == 125.0, "a late pose finds its place"
    for ms in (10, 20):
        poses.add("r", ms * MS, yaw_pose(ms, 0, 0))
    assert poses.at("r", 15 * MS)[0, 3] == pytest.approx(15.0)
    with pytest.raises(NoPoseError, match="ends"):
        poses.at("r", 120 * MS)


def test_a_pose_from_the_future_is_refused() -> None:
    poses = PoseBuffer(max_future_s=5.0)
    with pytest.raises(OldStampError, match="ahead"):
        poses.add("r", time.time_ns() + 3600 * 10**9, yaw_pose(0, 0, 0))
    with pytest.raises(NoPoseError, match="no pose stream"):
        poses.at("r", 0)


def test_a_pose_that_is_not_rigid_is_refused() -> None:
    with pytest.raises(BadPoseError):
        PoseBuffer().add("r", 0, np.diag([1.0, 1, -1, 1]))


@pytest.mark.parametrize("n_before", [1, 3, 500, 1024])
def test_a_stream_goes_on_at_once_when_the_robots_clock_goes_back(n_before: int) -> None:
    poses = PoseBuffer()
    hour = 3_600_000
    for i in range(n_before):
        poses.add("r", (hour + 20 * i) * MS, yaw_pose(i, 0, 0))
    for i in range(3):
        poses.add("r", 20 * i * MS, yaw_pose(1000 + i, 0, 0))
        with pytest.raises(PoseNotYetError):  # the next pose is on its way: worth a wait, as ever
            poses.at("r", (20 * i + 10) * MS)
    assert poses.at("r", 30 * MS)[0, 3] == pytest.approx(1001.5)
    poses.add("r", 10 * MS, yaw_pose(1000.5, 0, 0))
    assert poses.at("r", 5 * MS)[0, 3] == pytest.approx(1000.25), "a late pose still finds its place"


def test_one_pose_from_the_future_costs_the_stream_no_more_than_one_pose() -> None:
    poses = PoseBuffer()
    now_ns = time.time_ns()
    for ms in (0, 20, 4900, 40, 60):  # the third is forged, or comes of a clock that jumped
        poses.add("r", now_ns + ms * MS, yaw_pose(ms, 0, 0))
    assert poses.at("r", now_ns + 50 * MS)[0, 3] == pytest.approx(50.0)
