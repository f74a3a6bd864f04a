"""How ROS 2 topics stand in Zenoh: the keys and tokens of rmw_zenoh, and those of zenoh-bridge-ros2dds."""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from potclient.ros.types import NO_HASH, dds_name, ros_name, type_hash

NODE = "potserver"  # our node in the ROS graph
DDS_TOKENS = "@/*/@ros2_lv/MP/*/*/*"  # of the publishers behind all zenoh-bridge-ros2dds
_DDS_SLASH = "§"  # stands for a slash in them
_RELIABLE_LATEST = (
    ":{durability}:,1:,:,:,,"  # QoS: empty words are rmw_zenoh's defaults (reliable, volatile, keep last)
)


class Source(NamedTuple):
    """Where a sample came from."""

    namespace: str  # before the topic, without slashes at its ends; empty: none
    type_name: str | None  # None where the key does not say it
    hash: str | None


class Endpoint(NamedTuple):
    """What the token of a publisher or subscription of rmw_zenoh tells."""

    topic: str  # with its leading slash and its namespace
    dds: str  # the type, see `dds_name`
    hash: str

    @classmethod
    def ours(cls, topic: str, type_name: str) -> Endpoint:
        """Of a topic with a type as we know it."""
        return cls(topic, dds_name(type_name), type_hash(type_name))

    @classmethod
    def of_token(cls, token: str) -> Endpoint:
        """From a token that matches `publishers_expr`."""
        *_, topic, dds, found_hash, _qos = token.split("/")
        return cls(topic.replace("%", "/"), dds, found_hash)


class Names(NamedTuple):
    """The keys of one topic in a domain, as one subscribes to it in all namespaces."""

    domain: int
    topic: str  # with its leading slash

    @property
    def rmw_expr(self) -> str:
        """rmw_zenoh: `<domain>/<topic>/<type>/<hash>`."""
        return f"{self.domain}/**{self.topic}/*/*"

    def is_of(self, topic: str) -> bool:
        """Whether a topic, as ROS names it, is this one in some namespace."""
        return topic.endswith(self.topic)

    @property
    def dds_expr(self) -> str:
        """zenoh-bridge-ros2dds: `<namespace>/<topic>`; the type stands in a token only."""
        return f"**{self.topic}"

    def of_rmw_key(self, key: str) -> Source:
        """What a key that matches `rmw_expr` says."""
        *words, dds, found_hash = key.split("/")
        return Source(self._namespace("/".join(words[1:])), ros_name(dds), found_hash)

    def of_dds_key(self, key: str) -> Source:
        """What a key that matches `dds_expr` says."""
        return Source(self._namespace(key), None, None)

    def _namespace(self, name: str) -> str:
        return name.removesuffix(self.topic.lstrip("/")).strip("/")


def check_hash(source: Source) -> bool:
    """Whether the sender's definition of the type is ours; ROS 2 Humble does not say."""
    return source.hash in (None, NO_HASH) or (
        source.type_name is not None and source.hash == type_hash(source.type_name)
    )


def robot_id(namespace: str, default: str) -> str:
    """The id of a namespace's robot: `/Robot1/arm` is `robot1.arm`."""
    return re.sub(r"[^a-z0-9_.-]", "-", namespace.lower().replace("/", ".")).lstrip("_.-")[:63] or default


def publishers_expr(domain: int) -> str:
    """The tokens of all publishers of rmw_zenoh."""
    return f"@ros2_lv/{domain}/*/*/*/MP/*/*/*/*/*/*/*"


def type_of_dds_token(token: str) -> tuple[str, str]:
    """The key and the type that a token of a bridge announces."""
    *_, key, kind, _qos = token.split("/")
    return key.replace(_DDS_SLASH, "/"), kind.replace(_DDS_SLASH, "/")


def topic_key(domain: int, topic: str, type_name: str) -> str:
    """The key that rmw_zenoh publishes a topic under."""
    return f"{domain}{topic}/{dds_name(type_name)}/{type_hash(type_name)}"


def node_token(domain: int, zid: str) -> str:
    """The token that lists our node."""
    return f"@ros2_lv/{domain}/{zid}/0/0/NN/%/%/{NODE}"


def endpoint_token(node: str, entity: int, kind: str, said: Endpoint, *, latched: bool) -> str:
    """The token that lists an endpoint of our node: how `ros2 topic list` comes to show its topic.

    Args:
        node: Our node's token.
        entity: A number that no other endpoint of the node has.
        kind: `MP`, a publisher, or `MS`, a subscription.
        said: Topic and type.
        latched: Transient local.
    """
    here = node.split("/")
    here[4:6] = [str(entity), kind]
    qos = _RELIABLE_LATEST.format(durability="1" if latched else "")
    return "/".join([*here, said.topic.replace("/", "%"), said.dds, said.hash, qos])


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh puts beside every message; a subscriber that finds none refuses it.

    Args:
        sequence: Of the publisher, from 1.
        stamp_ns: Of the source, Unix time.
        gid: 16 bytes that name the publisher.
    """
    return struct.pack("<qqB", sequence, stamp_ns, len(gid)) + gid
