"""Clouds and poses that go in: what a `MapClient` sends for its robots, and the receipts that come back."""

from __future__ import annotations

import functools
import logging
import secrets
import threading
import time
from collections.abc import Iterator

import msgspec
import numpy as np
import zenoh
from numpy.typing import ArrayLike

from potclient.arguments import legal_id, numbers, pose
from potclient.errors import UsageError
from potclient.feed import Feed, FeedOptions, Numbering
from potclient.link import Link, is_matching
from potclient.questions.params import watch_params
from potclient.results import FeedCounts, Receipt
from potschemas import messages
from potschemas.messages import ParamsKind
from potschemas.wire import encode_array

log = logging.getLogger("potclient")


class Clouds:
    """The robots of one client: a feed each for published clouds, numbers, pose streams and liveliness tokens."""

    def __init__(self, link: Link, options: FeedOptions) -> None:
        self._link, self._options = link, options
        self.on_receipt = options.on_receipt
        wanted = options.params or ("fitted" if options.on_params else None)
        self._params = params_kind(wanted)
        self.session = secrets.token_hex(8)
        self._lock = threading.RLock()
        self._feeds: dict[str, Feed] = {}
        self._numberings: dict[str, Numbering] = {}
        self._pose_publishers: dict[str, zenoh.Publisher] = {}
        self._announced: set[str] = set()

    def close(self) -> None:
        """End all feeds; what was not sent counts as dropped, what has no receipt as unknown."""
        with self._lock:  # a feed that is being opened is closed too
            feeds = list(self._feeds.values())
        for feed in feeds:
            feed.close()

    def integrate(
        self, cloud: messages.Cloud, *, seq: int | None, stamp_ns: int | None, timeout_s: float | None
    ) -> Receipt:
        """See `MapClient.integrate`.

        A cloud travels as a query on the lane of the clouds (DATA_LOW, BLOCK): megabytes must not delay the planners' questions
        on the same link, and the reply takes the lane of its query.
        """
        robot = cloud.robot
        assert robot is not None
        number, stamp_ns = self._numbering(robot).assign(seq, stamp_ns)
        cloud = msgspec.structs.replace(cloud, seq=number, stamp_ns=stamp_ns, session=self.session)
        started = time.monotonic()
        key = self._link.keys.integrate(robot)
        reply = self._link.ask(key, cloud, messages.Receipt, timeout_s)
        receipt = Receipt(reply, round_trip_s=time.monotonic() - started)
        if (error := receipt.error()) is not None:
            raise error
        return receipt

    def publish(
        self,
        cloud: messages.Cloud,
        *,
        seq: int | None,
        stamp_ns: int | None,
        wait: bool,
        timeout_s: float | None,
    ) -> int:
        """See `MapClient.publish`."""
        assert cloud.robot is not None
        if wait and timeout_s is None:
            timeout_s = 2.0 * self._options.receipt_timeout_s
        feed = self._feed(cloud.robot)
        cloud = msgspec.structs.replace(cloud, session=self.session, params=self._params)
        return feed.offer(cloud, seq=seq, stamp_ns=stamp_ns, wait=wait, timeout_s=timeout_s)

    def pose(self, T_map_sensor: ArrayLike, *, stamp_ns: int | None, robot: str) -> None:
        """See `MapClient.pose`."""
        legal_id(robot, "robot")
        message = messages.Pose(
            stamp_ns=time.time_ns() if stamp_ns is None else stamp_ns,
            T_map_sensor=encode_array(pose(T_map_sensor)),
        )
        with self._lock:
            self._link.check_open()
            publisher = self._pose_publishers.get(robot)
            if publisher is None:
                publisher = self._link.publisher(
                    self._link.keys.pose(robot),
                    messages.Pose,
                    congestion_control=zenoh.CongestionControl.DROP,
                    express=True,
                )
                self._pose_publishers[robot] = publisher
                self._announce(robot)
        self._link.put(publisher, message)

    def flush(self, timeout_s: float | None, *, late: bool) -> bool:
        """See `MapClient.flush`."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        done = True
        for feed in list(self._feeds.values()):
            done &= feed.flush(None if until is None else max(0.0, until - time.monotonic()), late=late)
        return done

    def receipts(self, robot: str, timeout_s: float | None) -> Iterator[Receipt]:
        """See `MapClient.receipts`."""
        feed = self._feeds.get(robot)
        if feed is not None:
            yield from feed.receipts(timeout_s)

    def counts(self, robot: str | None) -> FeedCounts:
        """See `MapClient.counts`."""
        feeds = [feed for name, feed in list(self._feeds.items()) if robot in (None, name)]
        return functools.reduce(FeedCounts.__add__, (feed.counts for feed in feeds), FeedCounts())

    def _numbering(self, robot: str) -> Numbering:
        with self._lock:
            return self._numberings.setdefault(robot, Numbering())

    def _feed(self, robot: str) -> Feed:
        with self._lock:
            self._link.check_open()
            if robot not in self._feeds:
                self._feeds[robot] = self._open_feed(robot)
            return self._feeds[robot]

    def _open_feed(self, robot: str) -> Feed:
        link, keys = self._link, self._link.keys
        publisher = link.publisher(
            keys.cloud(robot),
            messages.Cloud,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.DATA_LOW,
        )
        feed = Feed(
            robot,
            lambda cloud: link.put(publisher, cloud),
            numbering=self._numbering(robot),
            is_matched=lambda: is_matching(publisher),
            explain=lambda: link.why_no_receipt(robot, is_matched=is_matching(publisher)),
            credit=self._options.credit,
            receipt_timeout_s=self._options.receipt_timeout_s,
        )

        def settle(message: messages.Receipt) -> None:
            receipt = feed.settle(message)
            if receipt is None and feed.stray_receipts == 1:  # once
                log.warning(
                    "a receipt for cloud %d of %s, which this client did not send: another process uses the robot's id",
                    message.seq,
                    robot,
                )
            if receipt is not None and self.on_receipt is not None:
                self.on_receipt(receipt)

        channel = zenoh.handlers.FifoChannel(64)
        link.subscribe(keys.receipt(robot), messages.Receipt, settle, f"receipts-{robot}", channel)
        on_params = self._options.on_params
        if on_params is not None:
            watch_params(link, robot, on_params)
        self._announce(robot)
        return feed

    def _announce(self, robot: str) -> None:
        if robot not in self._announced:
            self._link.announce_robot(robot)
            self._announced.add(robot)


def params_kind(name: str | None) -> ParamsKind | messages.Absent:
    """What a cloud asks for.

    Raises:
        UsageError: there is no such kind.
    """
    if name is None:
        return messages.ABSENT
    try:
        return ParamsKind(name)
    except ValueError:
        raise UsageError(
            f"params is {name!r}, need one of {', '.join(kind.value for kind in ParamsKind)}"
        ) from None


def cloud_message(
    points: ArrayLike,
    T_map_sensor: ArrayLike | None,
    is_return: ArrayLike | None,
    robot: str,
    params: str | None = None,
) -> messages.Cloud:
    """A cloud without its number; arrays are copied. Values are left for the server to judge.

    Raises:
        UsageError: an array has the wrong shape, or the robot's id or the kind of parameters is not legal.
    """
    xyz = numbers(points, "cloud", np.float32)
    flags = None if is_return is None else numbers(is_return, "is_return", np.bool_)
    if xyz.ndim != 2 or xyz.shape[1] not in (2, 3):
        raise UsageError(f"cloud: points have shape {xyz.shape}, need (N, 3) or (N, 2)")
    if flags is not None and flags.shape != (len(xyz),):
        raise UsageError(f"cloud: is_return has shape {flags.shape}, need ({len(xyz)},)")
    return messages.Cloud(
        seq=0,
        stamp_ns=0,
        points=encode_array(xyz),
        T_map_sensor=None if T_map_sensor is None else encode_array(pose(T_map_sensor)),
        is_return=None if flags is None else encode_array(flags),
        robot=legal_id(robot, "robot"),
        params=params_kind(params),
    )
