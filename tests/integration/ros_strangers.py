"""ROS 2 nodes that strangers wrote: the package zenoh-ros2-sdk, given its message definitions so that it downloads none."""

from __future__ import annotations

import dataclasses
import queue
from typing import Any

from zenoh_ros2_sdk import ROS2Publisher, ROS2Subscriber, get_topic_info, get_topic_names_and_types
from zenoh_ros2_sdk.qos import QosDurability, QosProfile
from zenoh_ros2_sdk.session import ZenohSession

from tests.ros import messages as ros

from .conftest import DEADLINE_S, until

LATCHED = QosProfile(durability=QosDurability.TRANSIENT_LOCAL, history_depth=1)


def definition(type_name: str) -> str:
    """The text of a message definition, with those that it needs."""
    return ros.STORE.generate_msgdef(type_name, ros_version=2)[0]


class Stranger:
    """A process with ROS 2 nodes; the package allows one session a process, so close one before the next."""

    def __init__(self, endpoint: str) -> None:
        self.port = int(endpoint.rpartition(":")[2])
        self._publishers: dict[str, ROS2Publisher] = {}
        self._subscribers: list[ROS2Subscriber] = []

    def publish(self, topic: str, message: Any, *, type_hash: str | None = None) -> None:
        """Publish, once somebody subscribes."""
        kind = message.__msgtype__
        if topic not in self._publishers:
            self._publishers[topic] = ROS2Publisher(
                topic,
                kind,
                msg_definition=definition(kind),
                type_hash=type_hash or ros.STORE.hash_rihs01(kind),
                router_port=self.port,
            )
        publisher = self._publishers[topic]
        until(lambda: publisher.pub.matching_status.matching, f"a subscriber of {topic}")
        publisher.publish(**{f.name: getattr(message, f.name) for f in dataclasses.fields(message) if f.init})

    def subscribe(
        self, topic: str, kind: str, *, latched: bool = False, inbox: queue.Queue[Any] | None = None
    ) -> queue.Queue[Any]:
        """Messages of a topic from now on, into this inbox or one of its own; latched: and the last one before."""
        inbox = queue.Queue() if inbox is None else inbox
        self._subscribers.append(
            ROS2Subscriber(
                topic,
                kind,
                inbox.put,
                msg_definition=definition(kind),
                type_hash=ros.STORE.hash_rihs01(kind),
                router_port=self.port,
                qos=LATCHED if latched else None,
            )
        )
        return inbox

    def topics(self) -> dict[str, list[str]]:
        """What `ros2 topic list -t` would show."""
        return dict(get_topic_names_and_types(router_port=self.port, timeout=DEADLINE_S))

    def info(self, topic: str) -> Any:
        """What `ros2 topic info --verbose` would show."""
        return get_topic_info(topic, router_port=self.port, timeout=DEADLINE_S, verbose=True)

    def close(self) -> None:
        for declared in (*self._publishers.values(), *self._subscribers):
            declared.close()
        ZenohSession.get_instance(router_port=self.port).close()
