"""Bridge: ROS 2 on one side, a map's public keys on the other."""

from __future__ import annotations

import threading

import zenoh

from potclient.client import MapClient
from potclient.results import Receipt
from potclient.ros.types import typestore
from potserver.health import Health
from potserver.log import get_logger
from potserver.ros.drops import Drops
from potserver.ros.inbound import Inbound
from potserver.ros.outbound import Outbound
from potserver.ros.robot_feed import MapSide
from potserver.ros.settings import RosSettings
from potserver.ros.topics import RosNode

log = get_logger("potserver.ros")


class Bridge:
    """Clouds of ROS 2 topics go into a map, and the map goes out as ROS 2 topics, until closed.

    Args:
        session: Where the ROS topics are; stays open.
        client: Of the map; stays open. Its receipts are counted here.
        settings: What comes in and goes out.
        health: Takes the counters `ros.*`.
    Raises:
        UsageError: the package rosbags is not installed.
    """

    def __init__(
        self, session: zenoh.Session, client: MapClient, settings: RosSettings, health: Health
    ) -> None:
        typestore()  # now, and not with the first message: it takes a moment, or is missing
        self._client, self._health = client, health
        self._lock = threading.Lock()
        self._range_m: float | None = None
        client.on_receipt = self._count_receipt
        self._node = RosNode(session, settings.domain)
        self._outbound = Outbound(self._node, settings, client, health)
        side = MapSide(
            client=client,
            health=health,
            drops=Drops(health, "clouds"),
            range_m=self._map_range_m,
            min_range_m=settings.min_range_m,
            keep_stamps=not settings.sim_time,
            note_stamp=self._outbound.note_stamp,
        )
        self._inbound = Inbound(session, self._node, settings, side)
        log.info(
            "ros_bridge_started",
            domain=settings.domain,
            clouds=settings.clouds,
            poses=settings.poses,
            map=client.keys.map_id,
            out=settings.out,
        )

    def close(self) -> bool:
        """Take and publish no more; false if a thread did not end in time."""
        ended = self._inbound.close()
        ended = self._outbound.close() and ended
        self._node.close()
        return ended

    def _map_range_m(self) -> float:
        """The range up to which the map uses beams; asked for once.

        Raises:
            PotclientError: nobody serves the map.
        """
        with self._lock:
            if self._range_m is None:
                self._range_m = self._client.info().limits.max_range_m
            return self._range_m

    def _count_receipt(self, receipt: Receipt) -> None:
        reason = "" if receipt.message.reason is None else f".{receipt.message.reason}"
        self._health.count(f"ros.clouds.{receipt.message.status.value}{reason}")
