"""Bags as recordings."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from potclient.datasets import open_dataset
from potclient.datasets.bags import open_bag
from potclient.errors import DatasetError
from potclient.poses import yaw_pose
from tests.ros import messages as ros
from tests.ros.bags import START_NS, bag_of, writing

S = 10**9
POINTS = np.array([[1, 2, 3], [4, 5, 6.5]], np.float32)


@pytest.mark.parametrize(
    ("plugin", "suffix"), [(StoragePlugin.MCAP, ".mcap"), (StoragePlugin.SQLITE3, ".db3")]
)
def test_a_bag_plays_as_what_it_was_made_of(tmp_path: Path, plugin: StoragePlugin, suffix: str) -> None:
    made = open_dataset("generated")[:3]
    bag_of(made, tmp_path / "drive", plugin)
    (file,) = (tmp_path / "drive").glob(f"*{suffix}")
    for path in (tmp_path / "drive", file):
        played = open_dataset(path)
        assert played.format == "bag"
        assert played.notes == ("topic /points", "poses in 'map' from /tf, /tf_static")
        assert [scan.stamp_ns for scan in played] == [START_NS, START_NS + S // 10, START_NS + 2 * S // 10]
        for scan, source in zip(played, made, strict=True):
            assert np.array_equal(scan.points, source.points)
            assert np.allclose(scan.T_map_sensor, source.T_map_sensor, atol=1e-9)
            assert scan.is_return.all()


def test_scans_without_a_pose_are_left_out_with_the_reason(tmp_path: Path) -> None:
    with writing(tmp_path / "bag") as put:
        for i in range(4):
            put("/points", ros.cloud(ros.xyz_rows(POINTS), "lidar", i * S), i * S)
        for i in (1, 2):
            put("/tf", ros.tf(ros.transform("map", "lidar", i * S, (i, 0, 0))), i * S)
    played = open_bag(tmp_path / "bag")
    assert [scan.stamp_ns for scan in played] == [S, 2 * S]
    assert played.notes[-1].startswith(
        "2 of 4 scans have no pose at their stamp: transform from 'lidar' to 'map' at 0.000"
    )


def test_messages_logged_at_one_time_are_told_apart(tmp_path: Path) -> None:
    with writing(tmp_path / "bag") as put:
        for i in range(3):
            put("/points", ros.cloud(ros.xyz_rows(POINTS + i), "lidar", i * S), 7)
            put("/tf", ros.tf(ros.transform("map", "lidar", i * S, (i, 0, 0))), 7)
    played = open_bag(tmp_path / "bag")
    assert [scan.points[0, 0] for scan in played] == [1, 2, 3]


def test_poses_come_from_odometry_and_the_way_to_the_sensor_from_tf(tmp_path: Path) -> None:
    with writing(tmp_path / "bag") as put:
        put("/tf_static", ros.tf(ros.transform("base", "lidar", 0, (0, 0, 2))), 0)
        for i in range(3):
            put("/odom", ros.odometry("odom", "base", i * S, (i, 0, 0)), i * S)
        put("/points", ros.cloud(ros.xyz_rows(POINTS), "lidar", S // 2), S // 2)
    with pytest.raises(DatasetError, match=r"try --poses /odom"):
        open_bag(tmp_path / "bag", frame="map")
    (scan,) = open_bag(tmp_path / "bag", poses="/odom")
    assert np.allclose(scan.T_map_sensor, yaw_pose(0.5, 0, 0, 2.0))


def test_a_laser_scan_is_planar_with_its_no_returns(tmp_path: Path) -> None:
    with writing(tmp_path / "bag") as put:
        put("/pose", ros.pose_stamped("map", S, (1, 2, 0.4), yaw=0.3), S)
        put("/scan", ros.laser([1.0, math.inf, 2.0], stamp_ns=S), S)
    (scan,) = open_bag(tmp_path / "bag", poses="/pose", max_range_m=1.5)
    assert scan.is_planar
    assert scan.is_return.tolist() == [True, False, False]
    assert np.allclose(np.linalg.norm(scan.to_send, axis=1), [1.0, 1.5, 1.5])
    assert np.allclose(scan.T_map_sensor, yaw_pose(1, 2, 0.3))


def test_one_topic_of_several_must_be_named(tmp_path: Path) -> None:
    with writing(tmp_path / "bag") as put:
        for topic in ("/front", "/rear"):
            put(topic, ros.cloud(ros.xyz_rows(POINTS), "lidar", S), S)
        put("/pose", ros.pose_stamped("map", S, (1, 2, 3)), S)
    with pytest.raises(DatasetError, match=r"several topics of scans; name one, e\.g\. --topic /front"):
        open_dataset(tmp_path / "bag")
    assert len(open_bag(tmp_path / "bag", topic="/rear", poses="/pose")) == 1
    with pytest.raises(DatasetError, match=r"no scans on /pose.*all topics: .*/pose \(geometry_msgs"):
        open_bag(tmp_path / "bag", topic="/pose")
    with pytest.raises(DatasetError, match="nothing on /tf and /tf_static"):
        open_bag(tmp_path / "bag", topic="/rear")


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"no bag at all" * 99])
def test_a_file_that_is_no_bag_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "drive.mcap").write_bytes(content)
    with pytest.raises(DatasetError, match="not a bag that can be read"):
        open_dataset(tmp_path / "drive.mcap")


def test_a_bag_that_is_cut_off_is_refused_or_plays_whole_scans(tmp_path: Path) -> None:
    bag_of(open_dataset("generated")[:3], tmp_path / "drive")
    (file,) = (tmp_path / "drive").glob("*.mcap")
    whole = file.read_bytes()
    for share in (0.2, 0.5, 0.8, 0.99):
        file.write_bytes(whole[: int(len(whole) * share)])
        try:
            scans = list(open_dataset(file))
        except DatasetError:
            continue
        assert all(len(scan) > 1000 for scan in scans)
