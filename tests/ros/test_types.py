"""Type hashes and names, against rosbags' definitions, against the strangers' own hashing, and against what ROS 2 publishes."""

from __future__ import annotations

import re
from typing import Any

import pytest
from zenoh_ros2_sdk.utils import compute_type_hash_from_msg, ros2_to_dds_type

from potclient.errors import RosMessageError
from potclient.ros import types
from tests.ros import messages as ros

ALL = (
    types.POINT_CLOUD,
    types.LASER_SCAN,
    types.TF,
    types.ODOMETRY,
    types.POSE,
    types.POSE_WITH_COVARIANCE,
    types.OCCUPANCY_GRID,
    types.OCCUPANCY_GRID_UPDATE,
    types.OCTOMAP,
)


def definitions(type_name: str) -> tuple[str, dict[str, str]]:
    """The text of a message, and the texts of those that it needs, by name."""
    first, *others = ros.STORE.generate_msgdef(type_name, ros_version=2)[0].split("=" * 80 + "\n")
    needed = {}
    for text in others:
        head, _, body = text.partition("\n")
        package, name = re.fullmatch(r"MSG: (\w+)/(?:msg/)?(\w+)", head).groups()  # type: ignore[union-attr]
        needed[f"{package}/msg/{name}"] = body
    return first, needed


@pytest.mark.parametrize("type_name", ALL)
def test_hashes_are_those_of_rosbags_and_of_strangers(type_name: str) -> None:
    text, needed = definitions(type_name)
    ours = types.type_hash(type_name)
    assert ours == ros.STORE.hash_rihs01(type_name)
    assert ours == compute_type_hash_from_msg(type_name, text, needed)


def test_the_hash_of_a_cloud_is_the_one_in_the_keys_of_ros() -> None:
    assert types.type_hash(types.POINT_CLOUD) == (
        "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
    )


@pytest.mark.parametrize("type_name", ALL)
def test_names_are_those_of_strangers_and_turn_back(type_name: str) -> None:
    assert types.dds_name(type_name) == ros2_to_dds_type(type_name)
    assert types.ros_name(types.dds_name(type_name)) == type_name


@pytest.mark.parametrize("words", ["", "points", "a::b", "a::msg::dds_::B", "a::msg::other::B_"])
def test_other_words_are_no_type(words: str) -> None:
    assert types.ros_name(words) is None


def test_a_message_of_another_type_is_refused() -> None:
    payload = ros.cdr(ros.pose_stamped("map", 0, (0, 0, 0)), types.POSE)
    with pytest.raises(RosMessageError, match=r"bytes are not a sensor_msgs/msg/PointCloud2"):
        types.decode(payload, types.POINT_CLOUD)


def test_frames_lose_the_slash_of_old_drivers() -> None:
    message: Any = ros.cloud(ros.xyz_rows(ros.np.ones((1, 3))), "/lidar", 1_000_000_007)
    assert types.frame_of(message.header.frame_id) == "lidar"
    assert types.stamp_of(message.header) == 1_000_000_007
    assert types.stamp_of(types.header("x", 1_000_000_007)) == 1_000_000_007
