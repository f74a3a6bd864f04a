"""ROS 2 clouds and poses into a map, from nodes that strangers wrote."""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import zenoh
import zenoh.ext

from potclient import MapClient
from potclient.datasets import open_dataset
from potclient.poses import yaw_pose
from potclient.ros import types
from potserver.config import load_settings
from potserver.health import Health
from potserver.ros.bridge import Bridge
from potserver.ros.names import topic_key
from potserver.ros.settings import RosSettings
from potserver.server import MapServer
from tests.ros import messages as ros

from .conftest import DEADLINE_S, MakeRig, Rig, until
from .ros_strangers import Stranger
from .scripted import free_port

S = 10**9
T0 = 1_700_000_000 * S
POINTS = np.random.default_rng(0).uniform(-9, 9, (500, 3)).astype(np.float32)


@pytest.fixture
def stranger() -> Iterator[Callable[[Rig], Stranger]]:
    """ROS nodes beside a server."""
    with contextlib.ExitStack() as stack:

        def make(rig: Rig) -> Stranger:
            nodes = Stranger(rig.server.endpoint)
            stack.callback(nodes.close)
            return nodes

        yield make


def ros_rig(make_rig: MakeRig, **changes: Any) -> Rig:
    return make_rig(**{"ros__clouds": ["/points"], "ros__wait_s": 5.0} | changes)


def n_scans(rig: Rig, n: int) -> None:
    until(lambda: len(rig.mapper.scans) == n, f"{n} scans; counters {rig.server.health.counters()}")


def dropped(rig: Rig, reason: str, n: int = 1) -> None:
    health = rig.server.health
    until(
        lambda: health.counter(f"ros.clouds.dropped.{reason}") == n, f"{reason}; counters {health.counters()}"
    )


def cloud(stamp_ns: int, frame: str = "lidar") -> Any:
    return ros.cloud(ros.xyz_rows(POINTS), frame, stamp_ns)


def a_router(endpoint: str) -> zenoh.Session:
    config = zenoh.Config()
    for key, value in (
        ("mode", "router"),
        ("listen/endpoints", [endpoint]),
        ("scouting/multicast/enabled", False),
        ("timestamping/enabled", True),
    ):
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


class BridgedDds:
    """What zenoh-bridge-ros2dds puts: plain keys, no attachment, and the type in a token."""

    def __init__(self, rig: Rig) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([rig.server.endpoint]))
        self._session = zenoh.open(config)
        self._publishers: dict[str, zenoh.Publisher] = {}

    def announce(self, key: str, kind: str) -> None:
        words = f"{key.replace('/', '§')}/{kind.replace('/', '§')}/:::"
        self._session.liveliness().declare_token(f"@/{self._session.info.zid()}/@ros2_lv/MP/{words}")

    def put(self, key: str, message: Any) -> None:
        if key not in self._publishers:
            self._publishers[key] = self._session.declare_publisher(key)
        publisher = self._publishers[key]
        until(lambda: publisher.matching_status.matching, f"a subscriber of {key}")
        publisher.put(ros.cdr(message, message.__msgtype__))

    def close(self) -> None:
        self._session.close()


def test_a_cloud_goes_in_with_the_pose_at_its_stamp(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig)
    nodes = stranger(rig)
    nodes.publish("/tf_static", ros.tf(ros.transform("base", "lidar", 0, (0, 0, 2))))
    nodes.publish("/points", cloud(T0 + S // 4))  # before its transforms: it waits
    nodes.publish("/tf", ros.tf(ros.transform("map", "base", T0, (1, 0, 0))))
    nodes.publish("/tf", ros.tf(ros.transform("map", "base", T0 + S // 2, (3, 0, 0), yaw=0.4)))
    n_scans(rig, 1)
    (scan,) = rig.mapper.scans
    assert (scan.robot_id, scan.stamp_ns) == ("ros", T0 + S // 4)
    assert np.allclose(scan.T_map_sensor, yaw_pose(2.0, 0.0, 0.2, 2.0))
    assert np.array_equal(scan.points, POINTS)
    counters = rig.server.health.counters()
    assert counters["ros.clouds.received"] == counters["ros.clouds.sent"] == 1
    until(lambda: rig.server.health.counter("ros.clouds.accepted") == 1, "the receipt")


def test_we_are_listed_as_subscribers_because_some_publish_only_then(
    make_rig: MakeRig, stranger: Callable
) -> None:
    rig = ros_rig(make_rig)
    nodes = stranger(rig)
    nodes.publish("/r1/points", cloud(T0))
    nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", T0)))
    for topic in ("/r1/points", "/tf"):
        info = until(lambda t=topic: (i := nodes.info(t)) and i.subscriber_count and i, topic)
        assert [s.node_name for s in info.subscribers] == ["potserver"]


def test_namespaces_are_robots_each_with_its_own_transforms(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig)
    nodes = stranger(rig)
    for i, name in enumerate(("Robot1", "robot2")):
        nodes.publish(f"/{name}/tf", ros.tf(ros.transform("map", "lidar", T0, (i, 0, 0))))
    nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", T0, (7, 0, 0))))
    until(lambda: rig.server.health.counter("ros.poses.taken") == 3, "all transforms")
    for name in ("Robot1", "robot2", "robot3"):  # the third has no /tf of its own
        nodes.publish(f"/{name}/points", cloud(T0))
    n_scans(rig, 3)
    poses = {scan.robot_id: scan.T_map_sensor[0, 3] for scan in rig.mapper.scans}
    assert poses == {"robot1": 0.0, "robot2": 1.0, "robot3": 7.0}


def test_static_transforms_from_before_the_server_are_asked_for(make_rig: MakeRig) -> None:
    """A latched topic as rmw_zenoh has it: an advanced publisher with a cache, on a router that the server joins later."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with contextlib.closing(a_router(endpoint)) as router:
        key = topic_key(0, "/tf_static", types.TF)
        publisher = zenoh.ext.declare_advanced_publisher(
            router, key, cache=zenoh.ext.CacheConfig(1), publisher_detection=True
        )
        publisher.put(ros.cdr(ros.tf(ros.transform("map", "lidar", 0, (1, 2, 3))), types.TF))
        rig = ros_rig(make_rig, zenoh__connect=[endpoint])
        until(lambda: rig.server.health.counter("ros.poses.taken") == 1, "the transform from before")
        client = rig.client()
        client.put(topic_key(0, "/points", types.POINT_CLOUD), ros.cdr(cloud(T0), types.POINT_CLOUD))
        n_scans(rig, 1)
        assert rig.mapper.scans[0].T_map_sensor[:3, 3].tolist() == [1, 2, 3]
        publisher.undeclare()
        rig.close()


def test_a_cloud_without_a_pose_is_counted_and_the_log_names_the_frames(
    make_rig: MakeRig, stranger: Callable, caplog: pytest.LogCaptureFixture
) -> None:
    rig = ros_rig(make_rig, ros__wait_s=0.0)
    nodes = stranger(rig)
    nodes.publish("/tf", ros.tf(ros.transform("odom", "base", T0)))
    until(lambda: rig.server.health.counter("ros.poses.taken") == 1, "the transform")
    nodes.publish("/points", cloud(T0))
    dropped(rig, "no_pose")
    until(
        lambda: "no transform from 'lidar' to 'map': the frames above 'lidar' are none" in caplog.text,
        "the frames",
    )
    nodes.publish("/points", cloud(T0 + S, "base"))
    dropped(rig, "no_pose", 2)
    assert rig.mapper.scans == []


def test_the_latest_pose_is_never_taken_for_a_later_cloud(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig, ros__wait_s=0.0)
    nodes = stranger(rig)
    nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", T0)))
    until(lambda: rig.server.health.counter("ros.poses.taken") == 1, "the transform")
    nodes.publish("/points", cloud(T0 + 1))
    dropped(rig, "no_pose")
    nodes.publish("/points", cloud(T0))
    n_scans(rig, 1)


@pytest.mark.parametrize("has_extrinsic", [True, False])
def test_poses_come_from_odometry_and_an_extrinsic(
    make_rig: MakeRig, stranger: Callable, has_extrinsic: bool
) -> None:
    settings = {"ros__poses": "/odom"} | (
        {"ros__extrinsic": [0.5, 0, 1, 0, 0, 0, 1]} if has_extrinsic else {}
    )
    rig = ros_rig(make_rig, **settings)
    nodes = stranger(rig)
    if not has_extrinsic:
        nodes.publish("/tf_static", ros.tf(ros.transform("base", "lidar", 0, (0.5, 0, 1))))
    for i in range(2):
        nodes.publish("/r7/odom", ros.odometry("odom", "base", T0 + i * S, (2 * i, 0, 0)))
    nodes.publish("/r7/points", cloud(T0 + S // 2))
    n_scans(rig, 1)
    assert np.allclose(rig.mapper.scans[0].T_map_sensor, yaw_pose(1.5, 0, 0, 1.0))


def test_a_laser_scan_is_planar_with_its_no_returns(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig, ros__clouds=["/scan"], ros__poses="/pose")
    nodes = stranger(rig)
    nodes.publish("/pose", ros.pose_stamped("map", T0, (1, 2, 0.4), yaw=0.3))
    nodes.publish("/scan", ros.laser([2.0, math.inf, math.nan], stamp_ns=T0))
    n_scans(rig, 1)
    (scan,) = rig.mapper.scans
    assert scan.is_planar
    assert scan.is_return.tolist() == [True, False]
    assert np.allclose(np.linalg.norm(scan.points, axis=1), [2.0, 12.0])
    assert np.allclose(scan.T_map_sensor, yaw_pose(1, 2, 0.3))


def test_beams_are_cut_where_the_map_ends_and_near_points_are_the_robot(
    make_rig: MakeRig, stranger: Callable
) -> None:
    rig = ros_rig(make_rig, ros__poses="/pose", ros__min_range_m=1.0)
    reach = rig.server.settings.mapping.max_range_m
    nodes = stranger(rig)
    points = np.array([[0, 0, 0], [0.5, 0, 0], [5, 0, 0], [0, 2 * reach, 0]], np.float32)
    nodes.publish("/pose", ros.pose_stamped("map", T0, (0, 0, 0)))
    nodes.publish("/points", ros.cloud(ros.xyz_rows(points), "lidar", T0))
    n_scans(rig, 1)
    (scan,) = rig.mapper.scans
    assert np.allclose(scan.points, [[5, 0, 0], [0, reach, 0]])
    assert scan.is_return.tolist() == [True, False]


def test_humble_has_no_hashes_and_another_definition_is_refused(
    make_rig: MakeRig, stranger: Callable
) -> None:
    rig = ros_rig(make_rig, ros__poses="/pose")
    nodes = stranger(rig)
    nodes.publish("/pose", ros.pose_stamped("map", T0, (0, 0, 0)), type_hash=types.NO_HASH)
    nodes.publish("/points", cloud(T0), type_hash=types.NO_HASH)
    n_scans(rig, 1)
    nodes.publish("/r2/points", cloud(T0), type_hash="RIHS01_" + 64 * "0")
    dropped(rig, "other_definition")
    nodes.publish("/r3/points", ros.pose_stamped("map", T0, (0, 0, 0)))
    dropped(rig, "wrong_type")


def test_a_cloud_in_the_maps_frame_is_refused_because_its_beams_have_no_origin(
    make_rig: MakeRig, stranger: Callable
) -> None:
    rig = ros_rig(make_rig)
    stranger(rig).publish("/points", cloud(T0, "map"))
    dropped(rig, "no_origin")


def test_two_sensors_of_one_robot_have_an_order_of_stamps_each(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig, ros__clouds=["/front/points", "/rear/points"], ros__poses="/pose")
    nodes = stranger(rig)
    for i in range(2):
        nodes.publish("/pose", ros.pose_stamped("map", T0 + i * S, (0, 0, 0)))
    nodes.publish("/front/points", cloud(T0 + S))
    n_scans(rig, 1)
    nodes.publish("/rear/points", cloud(T0 + S // 2))
    n_scans(rig, 2)
    assert [scan.robot_id for scan in rig.mapper.scans] == ["ros.front.points", "ros.rear.points"]


def test_simulated_time_may_begin_anew(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig, ros__sim_time=True)
    nodes = stranger(rig)
    for run in range(2):
        for i in range(50, 53):
            nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", i * S, (run, i, 0))))
            nodes.publish("/points", cloud(i * S))
            n_scans(rig, 3 * run + i - 49)
        nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", 0)))
        until(lambda n=4 * (run + 1): rig.server.health.counter("ros.poses.taken") == n, "the new beginning")
    assert [scan.T_map_sensor[:2, 3].tolist() for scan in rig.mapper.scans] == [
        [run, i] for run in range(2) for i in range(50, 53)
    ]


def test_clouds_and_transforms_of_a_dds_bridge(make_rig: MakeRig) -> None:
    rig = ros_rig(make_rig)
    with contextlib.closing(BridgedDds(rig)) as bridge:
        bridge.put("r5/points", cloud(T0))
        dropped(rig, "unknown_type")
        bridge.announce("r5/points", types.POINT_CLOUD)
        bridge.put("tf_static", ros.tf(ros.transform("base", "lidar", 0, (0, 0, 2))))
        bridge.put("tf", ros.tf(ros.transform("map", "base", T0, (4, 0, 0))))

        def arrived() -> bool:  # the token comes when it comes
            bridge.put("r5/points", cloud(T0))
            return len(rig.mapper.scans) > 0

        until(arrived, f"a scan; counters {rig.server.health.counters()}")
        (scan, *_) = rig.mapper.scans
        assert scan.robot_id == "r5"
        assert np.allclose(scan.T_map_sensor, yaw_pose(4, 0, 0, 2.0))


def test_damaged_messages_are_counted_and_the_next_goes_in(make_rig: MakeRig, stranger: Callable) -> None:
    rig = ros_rig(make_rig, ros__poses="/pose")
    nodes = stranger(rig)
    nodes.publish("/pose", ros.pose_stamped("map", T0, (0, 0, 0)))
    client = rig.client()
    key = topic_key(0, "/points", types.POINT_CLOUD)
    whole = ros.cdr(cloud(T0), types.POINT_CLOUD)
    for n, bad in enumerate((b"", b"\x00", whole[:100], b"\xff" * 300), 1):
        client.put(key, bad)
        dropped(rig, "bad_message", n)
    client.put(key, ros.cdr(ros.cloud(ros.xyz_rows(np.full((3, 3), np.nan)), "lidar", T0), types.POINT_CLOUD))
    dropped(rig, "empty")
    client.put(topic_key(0, "/pose", types.POSE), whole[:50])
    until(lambda: rig.server.health.counter("ros.poses.dropped.bad_message") == 1, "the damaged pose")
    client.put(key, whole)
    n_scans(rig, 1)


def test_a_bridge_outlives_its_server(make_rig: MakeRig) -> None:
    """Clouds without a server are counted; when one comes, the next goes in."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    health = Health()
    with (
        contextlib.closing(a_router(endpoint)) as network,
        MapClient(session=network, timeout_s=1.0) as client,
    ):
        bridge = Bridge(network, client, RosSettings(clouds=("/points",), poses="/pose"), health)
        with contextlib.closing(bridge):
            network.put(
                topic_key(0, "/pose", types.POSE), ros.cdr(ros.pose_stamped("map", T0, (0, 0, 0)), types.POSE)
            )
            key, payload = topic_key(0, "/points", types.POINT_CLOUD), ros.cdr(cloud(T0), types.POINT_CLOUD)
            network.put(key, payload)
            until(lambda: health.counter("ros.clouds.dropped.no_server") == 1, "a cloud without a server")
            rig = make_rig(zenoh__connect=[endpoint])
            client.wait_ready(DEADLINE_S)
            network.put(key, payload)
            n_scans(rig, 1)
            until(lambda: health.counter("ros.clouds.accepted") == 1, "the receipt")
            rig.close()


def test_a_ros_robot_scores_as_the_same_scans_published(stranger: Callable) -> None:
    """The whole way with the real mapper: from a stranger's PointCloud2 and tf to answers."""
    scans = open_dataset("generated")[:3]
    maps = {"maps": ["direct", "ros"], "ros.map": "ros", "ros.clouds": ["/points"], "ros.wait_s": 5.0}
    with MapServer(load_settings(overrides=maps), listen="tcp/127.0.0.1:0") as server:
        nodes = Stranger(server.endpoint)
        with (
            contextlib.closing(nodes),
            MapClient(server.endpoint, map="direct", timeout_s=DEADLINE_S) as direct,
        ):
            for i, scan in enumerate(scans):
                pose, stamp = scan.T_map_sensor, T0 + i * S
                direct.integrate(scan.points, pose, stamp_ns=stamp, robot="ros")
                yaw = math.atan2(pose[1, 0], pose[0, 0])
                nodes.publish("/tf", ros.tf(ros.transform("map", "lidar", stamp, pose[:3, 3], yaw)))
                nodes.publish("/points", ros.cloud(ros.xyz_rows(scan.points), "lidar", stamp))
                until(lambda n=i: server.mapper("ros").n_scans == n + 1, "the scan")
            ends = np.concatenate([scan.in_map[::20] for scan in scans])
            with MapClient(server.endpoint, map="ros", timeout_s=DEADLINE_S) as over_ros:
                off = np.abs(over_ros.occupancy(ends).mean - direct.occupancy(ends).mean)
                # ROS rounds points to float32: a beam on the edge of a cell may lie beside it then
                assert np.quantile(off, 0.99) < 0.02
                assert off.mean() < 0.002
