"""Keys, tokens, robots' ids and attachments."""

from __future__ import annotations

import struct

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh_ros2_sdk.attachment import Attachment
from zenoh_ros2_sdk.qos import QosDurability, QosProfile

from potclient.ros.types import NO_HASH, POINT_CLOUD, dds_name, type_hash
from potschemas.keys import check_id
from potserver.ros.names import (
    Endpoint,
    Names,
    Source,
    attachment,
    check_hash,
    endpoint_token,
    node_token,
    publishers_expr,
    robot_id,
    topic_key,
    type_of_dds_token,
)

DDS, HASH = dds_name(POINT_CLOUD), type_hash(POINT_CLOUD)


@pytest.mark.parametrize("topic", ["/points", "/lidar/points"])
@pytest.mark.parametrize("namespace", ["", "r1", "fleet/r1"])
def test_a_topic_is_found_in_every_namespace(topic: str, namespace: str) -> None:
    names = Names(7, topic)
    name = f"{namespace}{topic}".strip("/")
    key = f"7/{name}/{DDS}/{HASH}"
    assert zenoh.KeyExpr(names.rmw_expr).includes(zenoh.KeyExpr(key))
    assert names.of_rmw_key(key) == Source(namespace, POINT_CLOUD, HASH)
    assert zenoh.KeyExpr(names.dds_expr).includes(zenoh.KeyExpr(name))
    assert names.of_dds_key(name) == Source(namespace, None, None)


@pytest.mark.parametrize("other", ["8/points/T/H", "7/mypoints/T/H", "7/points/deep/T/H", "points"])
def test_other_keys_are_not_taken(other: str) -> None:
    assert not zenoh.KeyExpr(Names(7, "/points").rmw_expr).intersects(zenoh.KeyExpr(other))


def test_our_own_key_is_the_one_that_is_subscribed_to() -> None:
    assert topic_key(0, "/points", POINT_CLOUD) == f"0/points/{DDS}/{HASH}"


@pytest.mark.parametrize(
    ("source", "fits"),
    [
        (Source("", POINT_CLOUD, HASH), True),
        (Source("", POINT_CLOUD, NO_HASH), True),
        (Source("", POINT_CLOUD, None), True),
        (Source("", POINT_CLOUD, "RIHS01_0"), False),
    ],
)
def test_definitions_that_differ_never_meet(source: Source, fits: bool) -> None:
    assert check_hash(source) == fits


@pytest.mark.parametrize(
    ("namespace", "robot"),
    [
        ("r1", "r1"),
        ("Fleet/Robot_1", "fleet.robot_1"),
        ("", "ros"),
        ("__", "ros"),
        ("_r", "r"),
        ("x" * 90, "x" * 63),
    ],
)
def test_a_namespace_is_a_robot(namespace: str, robot: str) -> None:
    assert robot_id(namespace, "ros") == robot


@given(st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,40}(/[A-Za-z_][A-Za-z0-9_]{0,40}){0,3}", fullmatch=True))
def test_every_namespace_makes_a_legal_id(namespace: str) -> None:
    check_id(robot_id(namespace, "ros"), "robot")


def test_a_bridges_token_tells_key_and_type() -> None:
    token = "@/abc/@ros2_lv/MP/r1§points/sensor_msgs§msg§PointCloud2/:1::1,5"
    assert type_of_dds_token(token) == ("r1/points", POINT_CLOUD)


def test_tokens_are_those_of_rmw_zenoh() -> None:
    assert node_token(3, "abc") == "@ros2_lv/3/abc/0/0/NN/%/%/potserver"
    said = Endpoint.ours("/potserver/map", POINT_CLOUD)
    token = endpoint_token(node_token(3, "abc"), 2, "MP", said, latched=True)
    assert Endpoint.of_token(token) == said
    assert zenoh.KeyExpr(publishers_expr(3)).includes(zenoh.KeyExpr(token))
    *_, namespace, node, topic, dds, found_hash, qos = token.split("/")
    assert token.startswith("@ros2_lv/3/abc/0/2/MP/%/")
    assert (namespace, node, topic, dds, found_hash) == ("%", "potserver", "%potserver%map", DDS, HASH)
    assert QosProfile.decode(qos) == QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)
    volatile = endpoint_token(node_token(3, "abc"), 2, "MS", said, latched=False).rpartition("/")[2]
    assert QosProfile.decode(volatile) == QosProfile(history_depth=1)


def test_an_attachment_is_read_by_strangers() -> None:
    data = attachment(5, 1_700_000_000_000_000_001, bytes(range(16)))
    assert Attachment.from_bytes(data) == Attachment(5, 1_700_000_000_000_000_001, bytes(range(16)))
    with pytest.raises(struct.error):
        attachment(2**64, 0, b"")
