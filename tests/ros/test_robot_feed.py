"""The clouds of one robot: in order, bounded, and each one that does not get through is counted."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import zenoh

from potclient.errors import NoServerError, NoTransformError, QueryTimeoutError
from potclient.ros.types import POINT_CLOUD
from potserver.health import Health
from potserver.ros import robot_feed
from potserver.ros.drops import Drops
from potserver.ros.robot_feed import MapSide, RobotFeed, Waiting
from tests.ros import messages as ros

S = 10**9
WAIT_S = 30.0


class Desk:
    """A map's client and a source of poses, both held by the test."""

    def __init__(self) -> None:
        self.health = Health()
        self.sent: queue.Queue[dict[str, Any]] = queue.Queue()
        self.asked: queue.Queue[int] = queue.Queue()  # stamps whose pose is wanted
        self.poses: queue.Queue[Any] = queue.Queue()  # answers: a matrix, or an error
        self.failures: list[Exception] = []
        self.stamps: list[int] = []
        side = MapSide(
            client=self,  # type: ignore[arg-type]
            health=self.health,
            drops=Drops(self.health, "clouds"),
            range_m=lambda: 20.0,
            min_range_m=0.0,
            keep_stamps=True,
            note_stamp=self.stamps.append,
        )
        self.feed = RobotFeed("r1", self.pose_of, side)

    def pose_of(self, frame: str, stamp_ns: int) -> Any:
        self.asked.put(stamp_ns)
        answer = self.poses.get(timeout=WAIT_S)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def publish(self, points: Any, pose: Any, **how: Any) -> None:
        if self.failures:
            raise self.failures.pop()
        self.sent.put({"points": points, "pose": pose, **how})

    def offer(self, second: int) -> None:
        message = ros.cloud(ros.xyz_rows(np.ones((2, 3))), "lidar", second * S)
        self.feed.offer(Waiting(POINT_CLOUD, zenoh.ZBytes(ros.cdr(message, POINT_CLOUD))))

    def next_stamp(self) -> int:
        return int(self.sent.get(timeout=WAIT_S)["stamp_ns"]) // S


@pytest.fixture
def desk() -> Iterator[Desk]:
    desk = Desk()
    yield desk
    desk.feed.stop()
    desk.poses.put(NoTransformError("the end", may_come=False))
    assert desk.feed.join(WAIT_S)


def test_the_oldest_cloud_goes_when_too_many_wait(desk: Desk) -> None:
    desk.offer(0)
    assert desk.asked.get(timeout=WAIT_S) == 0  # it waits for its pose, and the others behind it
    for second in range(1, 8):
        desk.offer(second)
    assert desk.health.counter("ros.clouds.dropped.busy") == 7 - robot_feed.MAX_WAITING
    for _ in range(5):
        desk.poses.put(np.eye(4))
    assert [desk.next_stamp() for _ in range(5)] == [0, 4, 5, 6, 7]


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (NoTransformError("no way", may_come=False), "no_pose"),
        (NoServerError("nobody"), "no_server"),
        (ZeroDivisionError("a bug"), "internal"),
    ],
)
def test_an_error_is_counted_and_the_next_cloud_goes_in(desk: Desk, error: Exception, reason: str) -> None:
    if reason == "no_server":
        desk.failures.append(error)
        desk.poses.put(np.eye(4))
    else:
        desk.poses.put(error)
    desk.offer(0)
    desk.poses.put(np.eye(4))
    desk.offer(1)
    assert desk.next_stamp() == 1
    assert desk.health.counter(f"ros.clouds.dropped.{reason}") == 1


def test_a_map_that_is_busy_is_asked_again(desk: Desk) -> None:
    desk.failures += [QueryTimeoutError("busy"), QueryTimeoutError("busy")]
    desk.poses.put(np.eye(4))
    desk.offer(3)
    assert desk.next_stamp() == 3
    assert "ros.clouds.dropped.no_server" not in desk.health.counters()


def test_a_feed_that_is_stopped_counts_what_waits() -> None:
    desk = Desk()
    desk.offer(0)
    desk.asked.get(timeout=WAIT_S)
    desk.offer(1)
    desk.feed.stop()
    desk.poses.put(np.eye(4))
    assert desk.feed.join(WAIT_S)
    assert desk.next_stamp() == 0
    assert desk.health.counter("ros.clouds.dropped.closing") == 1
    assert desk.stamps == [0]
