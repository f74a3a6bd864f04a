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


class Names(NamedTuple):
    """The keys of one topic in a domain, as one subscribes to it in all namespaces."""

    domain: int
    topic: str  # with its leading slash

    @property
    def rmw_expr(self) -> str:
        """rmw_zenoh: `<domain>/<topic>/<type>/<hash>`."""
        return f"{self.domain}/**{self.topic}/*/*"

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


def publisher_token(domain: int, zid: str, entity: int, topic: str, type_name: str, *, latched: bool) -> str:
    """The token that lists a publisher of our node: how `ros2 topic list` comes to show its topic."""
    name = topic.replace("/", "%")
    qos = _RELIABLE_LATEST.format(durability="1" if latched else "")
    kind = f"{dds_name(type_name)}/{type_hash(type_name)}"
    return f"@ros2_lv/{domain}/{zid}/0/{entity}/MP/%/%/{NODE}/{name}/{kind}/{qos}"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """What rmw_zenoh puts beside every message; a subscriber that finds none refuses it.

    Args:
        sequence: Of the publisher, from 1.
        stamp_ns: Of the source, Unix time.
        gid: 16 bytes that name the publisher.
    """
    return struct.pack("<qqB", sequence, stamp_ns, len(gid)) + gid
