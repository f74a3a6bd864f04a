"""What comes in: clouds to the feeds of their robots, transforms and poses to where these look them up."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
import zenoh
from zenoh import ext

from potclient.arrays import Float64
from potclient.errors import RosMessageError
from potclient.ros.transforms import PoseTopic, TransformTree
from potclient.ros.types import (
    LASER_SCAN,
    ODOMETRY,
    POINT_CLOUD,
    POSE,
    POSE_WITH_COVARIANCE,
    TF,
    decode,
)
from potserver.log import get_logger
from potserver.ros.drops import Drops
from potserver.ros.names import (
    DDS_TOKENS,
    Endpoint,
    Names,
    Source,
    check_hash,
    publishers_expr,
    robot_id,
    type_of_dds_token,
)
from potserver.ros.robot_feed import MapSide, RobotFeed, Waiting
from potserver.ros.settings import TF as TF_TOPIC
from potserver.ros.settings import RosSettings
from potserver.ros.topics import RosNode
from potserver.threads import spawn

log = get_logger("potserver.ros")

TF_STATIC_TOPIC = "/tf_static"
MAX_ROBOTS = 64  # each has a thread and may hold clouds
_MAX_GAP_S = (
    1.0  # between two transforms or poses that are interpolated; some localisers speak twice a second
)
_KEEP_S = 30.0  # of transforms and poses; a stamp further back tells that the clock was set back
_CLOUD_CHANNEL, _POSE_CHANNEL = 4, 256
_STATIC_SAMPLES = 64  # of each late publisher of /tf_static: every node that has one publishes its own
_JOIN_S = 3.0

Kept = TypeVar("Kept", TransformTree, PoseTopic)
Take = Callable[[zenoh.Sample, Source], None]


class Inbound:
    """All subscriptions of a bridge.

    Threads: one a subscription, which only hands on; one a robot.
    """

    def __init__(self, session: zenoh.Session, node: RosNode, settings: RosSettings, side: MapSide) -> None:
        self._session, self._node, self._settings, self._side = session, node, settings, side
        self._health = side.health
        self._pose_drops = Drops(side.health, "poses")
        self._lock = threading.Lock()
        self._trees: dict[str, TransformTree] = {}  # by namespace
        self._poses: dict[str, PoseTopic] = {}  # by namespace
        self._feeds: dict[str, RobotFeed] = {}  # by robot
        self._dds_types: dict[str, str] = {}  # by key of a bridge
        self._topics: list[Names] = []  # that are subscribed to
        self._subscribers: list[Any] = []
        self._threads: list[threading.Thread] = []
        self._subscribe_all()

    def close(self) -> bool:
        """Take no more, end all threads; false if one did not end in time."""
        for subscriber in self._subscribers:
            subscriber.undeclare()
        for thread in self._threads:
            thread.join(_JOIN_S)
        for feed in self._feeds.values():
            feed.stop()
        ended = [feed.join(_JOIN_S + self._settings.wait_s) for feed in self._feeds.values()]
        return all(ended) and not any(thread.is_alive() for thread in self._threads)

    # --- subscriptions ------------------------------------------------------------------------------------------

    def _subscribe_all(self) -> None:
        s = self._settings
        if s.poses != TF_TOPIC:
            self._subscribe(s.poses, self._take_pose, _POSE_CHANNEL)
        if s.poses == TF_TOPIC or s.sensor_pose is None:
            self._subscribe(TF_TOPIC, functools.partial(self._take_tf, static=False), _POSE_CHANNEL)
            self._subscribe(
                TF_STATIC_TOPIC, functools.partial(self._take_tf, static=True), _POSE_CHANNEL, latched=True
            )
        for topic in s.clouds:
            self._subscribe(topic, functools.partial(self._take_cloud, topic), _CLOUD_CHANNEL)
        for expr, take_token in (
            (DDS_TOKENS, self._take_dds_token),
            (publishers_expr(s.domain), self._take_rmw_token),
        ):
            channel = zenoh.handlers.FifoChannel(_POSE_CHANNEL)
            tokens = self._session.liveliness().declare_subscriber(expr, channel, history=True)
            self._read(tokens, take_token, "tokens")

    def _subscribe(self, topic: str, take: Take, channel: int, *, latched: bool = False) -> None:
        """Take a topic in all namespaces, as rmw_zenoh and as zenoh-bridge-ros2dds have it.

        Args:
            latched: Ask for what was published before we came (transient local).
        """
        names = Names(self._settings.domain, topic)
        self._topics.append(names)
        for expr, source_of in ((names.rmw_expr, names.of_rmw_key), (names.dds_expr, names.of_dds_key)):
            handler = zenoh.handlers.FifoChannel(channel)
            subscriber = (
                ext.declare_advanced_subscriber(
                    self._session,
                    expr,
                    handler,
                    history=ext.HistoryConfig(detect_late_publishers=True, max_samples=_STATIC_SAMPLES),
                )
                if latched
                else self._session.declare_subscriber(expr, handler)
            )
            self._read(subscriber, functools.partial(_taken, take, source_of), topic)

    def _read(self, subscriber: Any, take: Callable[[zenoh.Sample], None], name: str) -> None:
        def run() -> None:
            for sample in subscriber:
                try:
                    take(sample)
                except Exception:
                    log.exception("ros_sample_failed", key=str(sample.key_expr))

        self._subscribers.append(subscriber)
        self._threads.append(spawn(f"ros-read-{name}", run))

    # --- samples ------------------------------------------------------------------------------------------------

    def _take_dds_token(self, sample: zenoh.Sample) -> None:
        key, kind = type_of_dds_token(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT and any(names.is_of(f"/{key}") for names in self._topics):
            self._dds_types[key] = kind

    def _take_rmw_token(self, sample: zenoh.Sample) -> None:
        publisher = Endpoint.of_token(str(sample.key_expr))
        if sample.kind == zenoh.SampleKind.PUT and any(
            names.is_of(publisher.topic) for names in self._topics
        ):
            self._node.list_subscription(publisher)

    def _take_cloud(self, topic: str, sample: zenoh.Sample, source: Source) -> None:
        self._health.count("ros.clouds.received")
        name = source.namespace or self._settings.robot
        if len(self._settings.clouds) > 1:  # stamps of two sensors need not grow together
            name = f"{name}{topic}"
        robot = robot_id(name, self._settings.robot)
        type_name = self._typed(sample, source, (POINT_CLOUD, LASER_SCAN), self._side.drops, robot)
        if type_name is None:
            return
        with self._lock:  # one topic is read by two threads
            feed = self._feeds.get(robot)
            if feed is None and len(self._feeds) < MAX_ROBOTS:
                pose_of = functools.partial(self._pose_of, source.namespace)
                feed = self._feeds[robot] = RobotFeed(robot, pose_of, self._side)
        if feed is None:
            self._side.drops.count("too_many_robots", robot, f"a bridge takes {MAX_ROBOTS} robots")
            return
        feed.offer(Waiting(type_name, sample.payload))

    def _take_tf(self, sample: zenoh.Sample, source: Source, *, static: bool) -> None:
        topic = f"{source.namespace}{TF_STATIC_TOPIC if static else TF_TOPIC}"
        if (
            source.type_name is not None
            and self._typed(sample, source, (TF,), self._pose_drops, topic) is None
        ):
            return
        tree = self._of_namespace(self._trees, source.namespace, self._new_tree)
        self._note_pose(topic, lambda: tree.add(decode(sample.payload.to_bytes(), TF), static=static))

    def _take_pose(self, sample: zenoh.Sample, source: Source) -> None:
        topic = f"{source.namespace}{self._settings.poses}"
        types = (ODOMETRY, POSE, POSE_WITH_COVARIANCE)
        type_name = self._typed(sample, source, types, self._pose_drops, topic)
        if type_name is None:
            return
        poses = self._of_namespace(self._poses, source.namespace, self._new_poses)
        self._note_pose(topic, lambda: poses.add(decode(sample.payload.to_bytes(), type_name), type_name))

    def _of_namespace(self, table: dict[str, Kept], namespace: str, make: Callable[[], Kept]) -> Kept:
        """The namespace's own entry; one that nobody keeps where there are too many."""
        with self._lock:
            if namespace in table or len(table) <= MAX_ROBOTS:
                return table.setdefault(namespace, make())
        self._pose_drops.count("too_many_robots", namespace, f"a bridge takes {MAX_ROBOTS} robots")
        return make()

    def _note_pose(self, topic: str, take: Callable[[], None]) -> None:
        try:
            take()
            self._health.count("ros.poses.taken")
        except RosMessageError as error:
            self._pose_drops.count(error.reason, topic, str(error))

    def _typed(
        self, sample: zenoh.Sample, source: Source, types: tuple[str, ...], drops: Drops, who: str
    ) -> str | None:
        """The type of a sample that can be decoded; None, and counted, of another."""
        key = str(sample.key_expr)
        type_name = source.type_name or self._dds_types.get(key)
        if type_name is None:
            drops.count("unknown_type", who, f"no bridge has said what is on {key}")
        elif type_name not in types:
            drops.count("wrong_type", who, f"{type_name} on {key}; need {' or '.join(types)}")
        elif not check_hash(source):
            drops.count(
                "other_definition", who, f"{key}: the sender's {type_name} is defined otherwise than ours"
            )
        else:
            return type_name
        return None

    # --- poses --------------------------------------------------------------------------------------------------

    def _pose_of(self, namespace: str, frame_id: str, stamp_ns: int) -> Float64:
        """(4, 4) T_map_sensor of a robot at a stamp; waits for what may still come.

        Raises:
            NoTransformError, RosMessageError: there is none.
        """
        s = self._settings
        if s.poses != TF_TOPIC:
            return self._pose_by_topic(namespace, frame_id, stamp_ns)
        if frame_id == s.map_frame.strip("/"):
            raise RosMessageError(
                f"the cloud is in {frame_id!r} already, so nobody knows where its beams began: take the sensor's own topic",
                reason="no_origin",
            )
        return self._tree_of(namespace).at(s.map_frame.strip("/"), frame_id, stamp_ns, wait_s=s.wait_s)

    def _pose_by_topic(self, namespace: str, frame_id: str, stamp_ns: int) -> Float64:
        s = self._settings
        with self._lock:
            poses = self._poses.get(namespace) or self._poses.setdefault("", self._new_poses())
        pose = poses.at(stamp_ns, wait_s=s.wait_s)
        if s.sensor_pose is not None:
            return np.asarray(pose @ s.sensor_pose)
        if poses.child is None:
            return pose  # of the sensor itself
        return np.asarray(
            pose @ self._tree_of(namespace).at(poses.child, frame_id, stamp_ns, wait_s=s.wait_s)
        )

    def _tree_of(self, namespace: str) -> TransformTree:
        """The tree of the robot's own /tf, or else that of all robots, which may still be empty and can be waited on."""
        with self._lock:
            return self._trees.get(namespace) or self._trees.setdefault("", self._new_tree())

    def _new_tree(self) -> TransformTree:
        return TransformTree(max_gap_s=_MAX_GAP_S, keep_s=_KEEP_S)

    def _new_poses(self) -> PoseTopic:
        return PoseTopic(self._settings.poses, max_gap_s=_MAX_GAP_S, keep_s=_KEEP_S)


def _taken(take: Take, source_of: Callable[[str], Source], sample: zenoh.Sample) -> None:
    if sample.kind == zenoh.SampleKind.PUT:
        take(sample, source_of(str(sample.key_expr)))
