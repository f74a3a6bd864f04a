"""RosTopic: a topic that we publish, as rmw_zenoh and as zenoh-bridge-ros2dds expect it."""

from __future__ import annotations

import contextlib
import itertools
import time
import uuid
from typing import Any

import zenoh
from zenoh import ext

from potclient.errors import UsageError
from potclient.link import is_matching
from potclient.ros.types import encode
from potclient.zenoh_config import reason_of
from potserver.ros.names import Endpoint, attachment, endpoint_token, node_token, topic_key

MAX_LISTED = 1024  # subscriptions of a node


class RosNode:
    """Our node in the ROS graph: it hands out topics, and is listed as long as it is open. Any thread may call."""

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._session, self._domain = session, domain
        self._name = node_token(domain, str(session.info.zid()))
        self._entities = itertools.count(1)
        self._tokens = [session.liveliness().declare_token(self._name)]
        self._listed: set[Endpoint] = set()

    def topic(self, name: str, type_name: str, *, latched: bool) -> RosTopic:
        """Declare a topic that we publish.

        Args:
            latched: Whoever subscribes later gets the last message (transient local).
        """
        said = Endpoint.ours(name, type_name)
        token = endpoint_token(self._name, next(self._entities), "MP", said, latched=latched)
        keys = (topic_key(self._domain, name, type_name), name.lstrip("/"))
        return RosTopic(self._session, keys, type_name, token)

    def list_subscription(self, publisher: Endpoint) -> None:
        """Say that we take what a publisher publishes; some publish only then. Once is enough."""
        if publisher in self._listed or len(self._listed) >= MAX_LISTED:
            return
        self._listed.add(publisher)
        token = endpoint_token(self._name, next(self._entities), "MS", publisher, latched=False)
        self._tokens.append(self._session.liveliness().declare_token(token))

    def close(self) -> None:
        """Leave the graph."""
        for token in self._tokens:
            token.undeclare()


class RosTopic:
    """One topic on two keys. Whoever asks the cache of either gets the last message.

    Args:
        keys: Of rmw_zenoh, and of zenoh-bridge-ros2dds.
        token: Lists the publisher.
    """

    def __init__(self, session: zenoh.Session, keys: tuple[str, str], type_name: str, token: str) -> None:
        self._type_name = type_name
        self._gid = uuid.uuid4().bytes
        self._sequence = 0
        # an advanced publisher does not tell whether anybody listens, so a plain one beside it does
        self._watches = [session.declare_publisher(key) for key in keys]
        try:
            self._publishers = [_latched(session, key) for key in keys]
        except zenoh.ZError as error:  # a configuration of the user's own without time stamps
            raise UsageError(f"Zenoh refuses the topic {keys[1]}: {reason_of(error)}") from error
        self._token = session.liveliness().declare_token(token)

    @property
    def has_listeners(self) -> bool:
        """Somebody subscribes."""
        return any(is_matching(watch) for watch in self._watches)

    def put(self, message: Any) -> None:
        """Publish a message of the topic's type."""
        payload = encode(message, self._type_name)
        self._sequence += 1
        beside = attachment(self._sequence, time.time_ns(), self._gid)
        for publisher in self._publishers:
            publisher.put(payload, attachment=beside)

    def close(self) -> None:
        """Withdraw the topic."""
        declarations: list[Any] = [self._token, *self._publishers, *self._watches]
        for declared in declarations:
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()


def _latched(session: zenoh.Session, key: str) -> ext.AdvancedPublisher:
    return ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.DATA_LOW,
        cache=ext.CacheConfig(1),
        publisher_detection=True,
    )
