"""Clouds and poses that a `MapClient` sends to a real server, their receipts, and what can be watched."""

from __future__ import annotations

import gc
import queue
import time
import weakref
from typing import Any

import numpy as np
import pytest

from potclient import FeedOptions, MapClient, feed
from potclient.errors import NoPoseError, OldSequenceError, OverloadedError, UsageError
from potclient.kernels import KernelSet
from potclient.results import Receipt
from potschemas import messages
from potschemas.messages import ReceiptStatus
from potschemas.wire import decode
from potserver.server import MapServer

from .conftest import DEADLINE_S, Client, until
from .rooms import pose, room
from .scripted import ScriptedServer, receipt_of


@pytest.fixture
def numbers_from_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clouds that tests can name."""
    monkeypatch.setattr(feed, "first_number", lambda: 1)


# --- acknowledged --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("numbers_from_one")
def test_integrate_returns_the_receipt_with_its_kernels(map_client: MapClient) -> None:
    before = map_client.info().map_revision
    receipt = map_client.integrate(room(), pose(5.0), robot="r7")
    assert receipt.accepted
    assert (receipt.robot, receipt.seq, receipt.map_revision) == ("r7", 1, before + 1)
    assert isinstance(receipt.kernels, KernelSet)
    walls = room()[:100] + np.array([5, 0, 0])
    assert np.median(receipt.kernels.occupancy(walls).mean) > 0.7
    assert np.median(map_client.occupancy(walls).mean) > 0.7
    assert map_client.integrate(room(), pose(), robot="r7").seq == 2


def test_the_sender_says_which_kernels_come_back(map_client: MapClient) -> None:
    fitted, transported, none = (
        map_client.integrate(room(), pose(5.0), robot="r8", params=params)
        for params in ("fitted", "transported", "none")
    )
    assert fitted.kernels is not None
    assert len(fitted.kernels) == fitted.message.n_kernels > 0
    assert fitted.sectors == []
    assert transported.kernels is not None
    assert any(sector.atom_id for sector in transported.sectors)
    assert none.accepted
    assert none.kernels is None
    with pytest.raises(UsageError, match="fitted, transported, none"):
        map_client.integrate(room(), pose(), params="all")


def test_beams_without_return_are_free_to_their_ends(map_client: MapClient) -> None:
    map_client.integrate(room(), pose(), is_return=np.zeros(600, bool))
    answer = map_client.occupancy(0.8 * room())
    assert answer.observed.mean() > 0.7, "600 beams are a thin look"
    assert answer.mean[answer.observed].max() < 0.5


def test_a_cloud_goes_as_it_was_given() -> None:
    def receipt(question: bytes) -> messages.Receipt:
        cloud = decode(question, messages.Cloud)
        assert cloud.robot is not None
        return receipt_of(cloud.robot, cloud)

    with ScriptedServer() as server, MapClient(server.endpoint) as client:
        server.on("integrate", receipt)
        client.integrate(room()[:60, :2], None, robot="r7", stamp_ns=123, is_return=np.ones(60, bool))
        (cloud,) = (decode(question, messages.Cloud) for _, question in server.asked)
    assert (cloud.robot, cloud.T_map_sensor, cloud.stamp_ns) == ("r7", None, 123)
    assert cloud.points.shape == [60, 2]
    assert cloud.is_return is not None


def test_a_cloud_that_the_server_refuses_raises(map_client: MapClient) -> None:
    map_client.integrate(room(), pose(), robot="late", seq=7)
    with pytest.raises(OldSequenceError, match="8 or more would be taken") as caught:
        map_client.integrate(room(), pose(), robot="late", seq=7)
    assert not caught.value.retryable


def test_a_cloud_that_is_not_accepted_raises_with_its_receipt() -> None:
    def receipt(question: bytes) -> messages.Receipt:
        cloud = decode(question, messages.Cloud)
        return receipt_of("r1", cloud, status=ReceiptStatus.DROPPED, reason="overloaded")

    with ScriptedServer() as server, MapClient(server.endpoint) as client:
        server.on("integrate", receipt)
        with pytest.raises(OverloadedError) as caught:
            client.integrate(room(), pose())
    assert caught.value.receipt is not None
    assert caught.value.receipt.status is ReceiptStatus.DROPPED
    assert caught.value.retryable


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 4)), np.eye(4)), "shape"),
        ((np.zeros((3, 3)), np.eye(3)), "T_map_sensor"),
        (("abc", np.eye(4)), "numbers"),
    ],
)
def test_arguments_of_the_wrong_shape_are_refused_before_anything_is_sent(
    map_client: MapClient, arguments: tuple[Any, Any], message: str
) -> None:
    before = map_client.stats().counters.get("clouds.received")
    for send in (map_client.publish, map_client.integrate):
        with pytest.raises(UsageError, match=message):
            send(*arguments)
        with pytest.raises(UsageError, match="is_return"):
            send(room(), pose(), is_return=[True])
        with pytest.raises(UsageError, match="robot"):
            send(room(), pose(), robot="Not/An/Id")
    assert map_client.stats().counters.get("clouds.received") == before
    assert map_client.counts().offered == 0


# --- published -----------------------------------------------------------------------------------------------------


def test_published_clouds_all_get_receipts_when_nothing_may_be_dropped(map_client: MapClient) -> None:
    seen: list[Receipt] = []
    map_client.on_receipt = seen.append
    numbers = [map_client.publish(room(), pose(), robot="a", wait=True) for _ in range(6)]
    assert map_client.flush(DEADLINE_S)
    assert [r.seq for r in map_client.receipts("a", DEADLINE_S)] == numbers
    assert all(r.round_trip_s is not None for r in seen)
    counts = map_client.counts("a")
    assert (counts.offered, counts.accepted, counts.dropped_by_client) == (6, 6, 0)
    assert map_client.info().n_scans == 6


def test_publishing_never_blocks_and_the_newest_cloud_wins(make_rig: Any) -> None:
    rig = make_rig()
    rig.mapper.mapping.hold()
    with MapClient(rig.server.endpoint) as client:
        client.wait_ready()
        for _ in range(20):
            last = client.publish(room(), pose(), robot="a")
        counts = client.counts("a")
        assert counts.offered == 20
        assert counts.in_flight <= 2
        assert counts.accounted
        rig.mapper.mapping.release()
        assert client.flush(DEADLINE_S)
        counts = client.counts("a")
        assert counts.accepted == counts.sent < 20
        assert counts.accepted + counts.dropped_by_client == 20
        assert rig.mapper.scans[-1].seq == last


def test_a_late_receipt_does_not_stall_the_feed_and_still_counts(make_rig: Any) -> None:
    rig = make_rig()
    rig.mapper.mapping.hold()
    with MapClient(rig.server.endpoint, feed=FeedOptions(receipt_timeout_s=0.05)) as client:
        for _ in range(4):
            client.publish(room(), pose(), wait=True, timeout_s=DEADLINE_S)
        assert client.flush(DEADLINE_S)
        assert client.counts().unknown == 4
        rig.mapper.mapping.release()
        assert client.flush(DEADLINE_S, late=True)
        counts = client.counts()
    assert (counts.unknown, counts.accepted) == (0, 4)


@pytest.mark.usefixtures("numbers_from_one")
def test_a_lost_receipt_does_not_stall_the_feed() -> None:
    with ScriptedServer() as server:
        server.on_clouds(lambda robot, cloud: None if cloud.seq <= 2 else receipt_of(robot, cloud))
        with MapClient(server.endpoint, feed=FeedOptions(receipt_timeout_s=0.05)) as client:
            for _ in range(4):
                client.publish(room(), pose(), wait=True, timeout_s=DEADLINE_S)
            assert client.flush(DEADLINE_S)
            counts = client.counts()
    assert (counts.unknown, counts.accepted, counts.dropped_by_client) == (2, 2, 0)
    assert counts.accounted


def test_rejections_are_counted_with_their_reason(map_client: MapClient) -> None:
    map_client.integrate(room(), pose(), robot="b", seq=7)
    map_client.publish(room(), pose(), robot="b", seq=5, wait=True)
    receipts = list(map_client.receipts("b", DEADLINE_S))
    assert [(r.status, r.reason) for r in receipts] == [(ReceiptStatus.REJECTED, "old_seq")]
    assert receipts[0].message.next_seq == 8
    assert map_client.counts().rejected == 1


def test_two_processes_with_one_robot_id_keep_their_own_receipts(
    map_server: MapServer, caplog: pytest.LogCaptureFixture
) -> None:
    with MapClient(map_server.endpoint) as one, MapClient(map_server.endpoint) as other:
        for client in (one, other):
            client.publish(room(), pose(), robot="twin", wait=True)
            assert client.flush(DEADLINE_S)
        for _ in range(3):
            other.publish(room(), pose(), robot="twin", wait=True)
        assert other.flush(DEADLINE_S)
        one.publish(room(), pose(), robot="twin", wait=True)  # its receipt comes after those of the other's
        assert one.flush(DEADLINE_S)
        assert (one.counts().accepted, other.counts().accepted) == (2, 4)
    warnings = [record for record in caplog.records if "another process" in record.getMessage()]
    assert 1 <= len(warnings) <= 2, "once a client"


@pytest.mark.usefixtures("numbers_from_one")
def test_parameters_arrive(map_server: MapServer) -> None:
    got: queue.Queue[Any] = queue.Queue()
    with MapClient(map_server.endpoint, feed=FeedOptions(on_params=got.put)) as client:
        client.publish(room(), pose(), robot="p", wait=True)
        params = got.get(timeout=DEADLINE_S)
    assert (params.robot, params.seq) == ("p", 1)
    assert len(params.kernels) > 0
    assert params.map_revision == params.kernels.map_revision > 0


# --- poses and presence ----------------------------------------------------------------------------------------------


def test_the_server_interpolates_published_poses(map_client: MapClient) -> None:
    with pytest.raises(UsageError, match="T_map_sensor"):
        map_client.pose(np.eye(3), robot="odo")
    with pytest.raises(NoPoseError):
        map_client.integrate(room(), None, robot="odo")

    def send() -> Receipt | None:  # the pose stream may lose poses until both sides know of each other
        now = time.time_ns()
        map_client.pose(pose(2.0), stamp_ns=now - 50_000_000, robot="odo")
        map_client.pose(pose(4.0), stamp_ns=now + 50_000_000, robot="odo")
        try:
            return map_client.integrate(room(), None, robot="odo", stamp_ns=now)
        except NoPoseError:
            return None

    assert until(send, "a cloud between two poses").accepted
    at_three = map_client.occupancy(room() + np.array([3, 0, 0]))
    assert np.median(at_three.mean) > 0.7


def test_a_robot_that_publishes_is_alive_until_it_leaves(
    map_server: MapServer, map_client: MapClient
) -> None:
    before = map_client.stats().counters["robots.alive"]
    with MapClient(map_server.endpoint) as robot:
        robot.publish(room(), pose(), robot="here", wait=True)
        until(lambda: map_client.stats().counters["robots.alive"] == before + 1, "the robot's token")
    until(lambda: map_client.stats().counters["robots.alive"] == before, "the token to go")


# --- streams -------------------------------------------------------------------------------------------------------


def test_revisions_receipts_params_and_stats_can_be_watched(map_client: MapClient) -> None:
    events: queue.Queue[Any] = queue.Queue()

    def broken(_: messages.Revision) -> None:
        raise RuntimeError("a callback of the user's")

    map_client.watch_revisions(broken)
    subscription = map_client.watch_revisions(events.put)
    map_client.watch_receipts(events.put)
    map_client.watch_params(events.put)
    map_client.watch_stats(events.put)
    kinds: set[str] = set()
    while len(kinds) < 4:  # until both sides know of each other, what is published has no listener
        map_client.publish(room(), pose(), robot="a", wait=True)
        kinds.add(type(events.get(timeout=DEADLINE_S)).__name__)
        while not events.empty():
            kinds.add(type(events.get()).__name__)
    assert kinds == {"Revision", "Receipt", "TransportedParams", "Stats"}
    subscription.close()


def test_a_closed_subscription_is_forgotten(map_client: MapClient) -> None:
    for watch in (
        map_client.watch_revisions,
        map_client.watch_receipts,
        map_client.watch_stats,
        map_client.watch_params,
    ):
        with watch(lambda _: None) as subscription:  # type: ignore[operator]
            pass
        subscription.close()
        closed = weakref.ref(subscription)
        del subscription

        def is_gone(closed: weakref.ref[Any] = closed) -> bool:
            gc.collect()
            return closed() is None

        until(is_gone, "the last reference to go")


def test_a_message_of_another_kind_is_one_warning_line(
    map_server: MapServer, map_client: MapClient, caplog: pytest.LogCaptureFixture
) -> None:
    ticks: queue.Queue[Any] = queue.Queue()
    stranger = Client(map_server.endpoint)
    with map_client.watch_revisions(ticks.put):
        map_client.info()  # a round trip: the server knows of the subscription
        stranger.put(map_client.keys.revision, b"\x93\x01\x02\x03")
        until(lambda: any(map_client.keys.revision in r.getMessage() for r in caplog.records), "the warning")
        map_client.publish(room(), pose(), wait=True)
        ticks.get(timeout=DEADLINE_S)
    stranger.close()
    (record,) = [r for r in caplog.records if map_client.keys.revision in r.getMessage()]
    assert (record.levelname, record.exc_info) == ("WARNING", None)
