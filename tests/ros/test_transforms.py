"""Poses at a stamp: found by the tree of transforms or on a topic, and refused by name where there are none."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.errors import NoTransformError, RosMessageError
from potclient.poses import yaw_pose
from potclient.ros.transforms import PoseTopic, TransformTree
from potclient.ros.types import ODOMETRY, POSE
from tests.ros import messages as ros

S = 10**9


def tree_of(*moving: object, static: tuple = (), **options: float) -> TransformTree:
    tree = TransformTree(**({"max_gap_s": 1.0} | options))
    tree.add(ros.tf(*moving), static=False)
    tree.add(ros.tf(*static), static=True)
    return tree


def robot(**options: float) -> TransformTree:
    """A robot that drives from x = 0 at 10 s to x = 1 at 11 s; its lidar is 2 m up."""
    return tree_of(
        ros.transform("odom", "base", 10 * S, (0, 0, 0)),
        ros.transform("odom", "base", 11 * S, (1, 0, 0)),
        static=(
            ros.transform("map", "odom", 0, (5, 0, 0), yaw=math.pi / 2),
            ros.transform("base", "lidar", 0, (0, 0, 2)),
        ),
        **options,
    )


def test_links_are_multiplied_and_moving_ones_interpolated() -> None:
    pose = robot().at("map", "lidar", 10 * S + S // 4)
    assert np.allclose(pose, yaw_pose(5.0, 0.25, math.pi / 2, 2.0))


def test_frames_of_two_branches_meet_where_the_branches_do() -> None:
    tree = tree_of(
        static=(ros.transform("base", "a", 0, (1, 0, 0)), ros.transform("base", "b", 0, (0, 1, 0)))
    )
    assert np.allclose(tree.at("a", "b", 0)[:3, 3], [-1, 1, 0])
    assert np.array_equal(tree.at("a", "a", 0), np.eye(4))


@given(fraction=st.floats(0, 1), yaw=st.floats(-1.5, 1.5), x=st.floats(-9, 9))
def test_there_and_back_is_the_identity(fraction: float, yaw: float, x: float) -> None:
    tree = tree_of(
        ros.transform("odom", "base", 10 * S, (0, 0, 0)),
        ros.transform("odom", "base", 11 * S, (x, 1, 0), yaw=yaw),
    )
    stamp = 10 * S + int(fraction * S)
    assert np.allclose(tree.at("odom", "base", stamp) @ tree.at("base", "odom", stamp), np.eye(4), atol=1e-9)


def test_the_latest_transform_is_never_taken_for_a_later_stamp() -> None:
    with pytest.raises(
        NoTransformError, match=r"from 'base' to 'odom' at 11\.100: the newest is 0\.100 s before it"
    ) as caught:
        robot().at("map", "lidar", 11 * S + S // 10)
    assert caught.value.may_come


def test_a_stamp_before_the_oldest_transform_will_never_get_one() -> None:
    with pytest.raises(
        NoTransformError, match=r"'base' to 'odom' at 9\.000: the oldest is 1\.000 s after it"
    ) as caught:
        robot().at("map", "lidar", 9 * S)
    assert not caught.value.may_come


def test_a_hole_is_not_bridged() -> None:
    with pytest.raises(NoTransformError, match=r"neighbours are 1\.00 s apart"):
        robot(max_gap_s=0.5).at("map", "lidar", 10 * S + 1)


def test_missing_frames_are_named() -> None:
    with pytest.raises(NoTransformError, match=r"from 'camera' to 'map': the frames above 'camera' are none"):
        robot().at("map", "camera", 10 * S)
    with pytest.raises(
        NoTransformError, match=r"above 'lidar' are 'base', 'odom', 'map', those above 'earth' are none"
    ):
        robot().at("earth", "lidar", 10 * S)


def test_a_simulation_that_begins_anew_begins_a_new_track() -> None:
    tree = robot(keep_s=5.0)
    tree.add(ros.tf(ros.transform("odom", "base", 0, (7, 0, 0))), static=False)
    assert np.allclose(tree.at("odom", "base", 0)[:3, 3], [7, 0, 0])
    with pytest.raises(NoTransformError, match="newest"):
        tree.at("odom", "base", 10 * S)


def test_old_transforms_are_forgotten_and_those_within_the_time_kept() -> None:
    tree = TransformTree(max_gap_s=1.0, keep_s=5.0)
    for i in range(1000):
        tree.add(ros.tf(ros.transform("odom", "base", i * S // 10, (i, 0, 0))), static=False)
    assert np.allclose(tree.at("odom", "base", 95 * S)[:3, 3], [950, 0, 0])
    with pytest.raises(NoTransformError, match="oldest"):
        tree.at("odom", "base", 80 * S)


def test_a_frame_that_gets_another_parent_has_only_that() -> None:
    tree = robot()
    tree.add(ros.tf(ros.transform("map", "base", 10 * S, (3, 3, 3))), static=False)
    assert np.allclose(tree.at("map", "base", 10 * S)[:3, 3], [3, 3, 3])
    assert tree.root_of("lidar") == "map"


def test_a_loop_of_frames_ends() -> None:
    tree = tree_of(static=(ros.transform("a", "b", 0), ros.transform("b", "a", 0)))
    with pytest.raises(NoTransformError):
        tree.at("map", "a", 0)


def test_a_transform_that_is_late_is_waited_for() -> None:
    tree = robot()
    late = ros.tf(ros.transform("odom", "base", 12 * S, (2, 0, 0)))
    timer = threading.Timer(0.05, lambda: tree.add(late, static=False))
    timer.start()
    assert np.allclose(tree.at("odom", "base", 11 * S + S // 2, wait_s=30.0)[:3, 3], [1.5, 0, 0])
    timer.join()


@pytest.mark.parametrize("bad", [(math.nan, 0, 0), (0, math.inf, 0)])
def test_a_transform_that_is_no_motion_is_refused(bad: tuple) -> None:
    with pytest.raises(RosMessageError, match="from lidar to base"):
        tree_of(ros.transform("base", "lidar", 0, bad))


def test_a_transform_without_a_rotation_is_refused() -> None:
    message = ros.transform("base", "lidar", 0)
    message.transform.rotation.w = 0.0
    with pytest.raises(RosMessageError, match="length 0"):
        tree_of(message)


def test_a_pose_topic_is_interpolated_and_tells_whose_pose_it_is() -> None:
    poses = PoseTopic("/odom", max_gap_s=1.0)
    for i in range(3):
        poses.add(ros.odometry("odom", "base", i * S // 2, (i, 0, 0), yaw=0.1 * i), ODOMETRY)
    assert np.allclose(poses.at(S // 4), yaw_pose(0.5, 0.0, 0.05))
    assert poses.child == "base"
    with pytest.raises(NoTransformError, match=r"pose on /odom at 2\.000: the newest is 1\.000 s before it"):
        poses.at(2 * S)


def test_a_stamped_pose_has_no_child_frame() -> None:
    poses = PoseTopic("/pose", max_gap_s=1.0)
    with pytest.raises(NoTransformError, match="not there"):
        poses.at(0)
    poses.add(ros.pose_stamped("map", 5 * S, (1, 2, 3), yaw=0.5), POSE)
    assert poses.child is None
    assert np.allclose(poses.at(5 * S), yaw_pose(1, 2, 0.5, 3))
