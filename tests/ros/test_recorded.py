"""What a stranger's node once put on Zenoh, read as it was meant: golden vectors, see `record.py`."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from potclient.poses import yaw_pose
from potclient.ros import types
from potclient.ros.laser_scans import read_laser_scan
from potclient.ros.point_clouds import read_point_cloud
from potclient.ros.transforms import TransformTree
from potserver.ros.names import Names, Source, attachment, check_hash
from tests.ros import record


def test_the_recorded_cloud_is_found_and_read() -> None:
    key, _, payload = record.load("point_cloud")
    source = Names(0, "/points").of_rmw_key(key)
    assert source == Source("r1", types.POINT_CLOUD, types.type_hash(types.POINT_CLOUD))
    assert check_hash(source)
    cloud = read_point_cloud(types.decode(payload, types.POINT_CLOUD))
    assert cloud.points.tolist() == [[1, 0.5, -1], [2, 0.5, 0], [3, 0.5, 1], [5, 0.5, 3], [6, 0.5, 4]]
    assert cloud.times is not None
    assert cloud.times.tolist() == [0, 10, 20, 40, 50]
    assert (cloud.frame_id, cloud.stamp_ns, cloud.n_invalid) == ("lidar", record.STAMP_NS, 1)


def test_the_recorded_scan_is_found_and_read() -> None:
    key, _, payload = record.load("laser_scan")
    assert Names(0, "/scan").of_rmw_key(key).type_name == types.LASER_SCAN
    beams = read_laser_scan(types.decode(payload, types.LASER_SCAN))
    assert beams.is_return.tolist() == [True, False, True]
    assert np.allclose(np.linalg.norm(beams.points, axis=1), [1, 12, 3])


def test_the_recorded_transforms_place_the_sensor() -> None:
    tree = TransformTree(max_gap_s=1.0)
    for name in ("tf", "tf_static"):
        key, _, payload = record.load(name)
        assert Names(0, f"/{name}").of_rmw_key(key).namespace == ""
        tree.add(types.decode(payload, types.TF), static=name == "tf_static")
    assert np.allclose(tree.at("map", "lidar", record.STAMP_NS), yaw_pose(1, 2, 0.5, 1.5))


@pytest.mark.parametrize("name", ["point_cloud", "laser_scan", "tf", "tf_static"])
def test_our_attachments_are_made_as_the_recorded_ones(name: str) -> None:
    _, theirs, _ = record.load(name)
    sequence, stamp_ns, n = struct.unpack_from("<qqB", theirs)
    assert attachment(sequence, stamp_ns, theirs[-n:]) == theirs


@pytest.mark.parametrize("name", ["point_cloud", "laser_scan", "tf", "tf_static"])
def test_messages_are_written_as_the_recorded_ones(name: str) -> None:
    key, _, payload = record.load(name)
    type_name = types.ros_name(key.split("/")[-2])
    assert type_name is not None
    assert types.encode(types.decode(payload, type_name), type_name) == payload
