"""The robot's feed: newest cloud wins, at most `credit` on their way, every cloud counted once. No Zenoh here."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potclient.errors import ClosedError, QueryTimeoutError, UsageError
from potclient.feed import Feed, Numbering
from potclient.results import Receipt
from potschemas import messages
from potschemas.messages import ReceiptStatus
from potschemas.wire import encode_array

LIMIT_S = 10.0  # of a wait that must succeed; no test measures it


def cloud() -> messages.Cloud:
    return messages.Cloud(seq=0, stamp_ns=0, points=encode_array(np.zeros((1, 3), np.float32)))


def receipt(seq: int, status: ReceiptStatus = ReceiptStatus.ACCEPTED) -> messages.Receipt:
    return messages.Receipt(map="m", robot="r1", seq=seq, status=status)


class Network:
    """Where the feed puts its clouds; `gate` holds a put, `matched` hides the server, `now` is the feed's clock."""

    def __init__(self) -> None:
        self.sent: queue.Queue[messages.Cloud] = queue.Queue()
        self.gate = threading.Event()
        self.gate.set()
        self.matched = True
        self.now = 0.0
        self.error: Exception | None = None

    def put(self, item: messages.Cloud) -> None:
        assert self.gate.wait(LIMIT_S)
        if self.error is not None:
            raise self.error
        self.sent.put(item)

    def next_seq(self) -> int:
        return self.sent.get(timeout=LIMIT_S).seq


def make_feed(network: Network, credit: int = 2) -> Feed:
    return Feed(
        "r1",
        network.put,
        numbering=Numbering(first=1),
        is_matched=lambda: network.matched,
        credit=credit,
        receipt_timeout_s=5.0,
        clock=lambda: network.now,
    )


@pytest.fixture
def network() -> Network:
    return Network()


@pytest.fixture
def feed(network: Network) -> Iterator[Feed]:
    feed = make_feed(network)
    yield feed
    network.gate.set()
    feed.close()


def test_the_newest_cloud_waits_and_older_ones_are_dropped_and_counted(feed: Feed, network: Network) -> None:
    for _ in range(2):
        feed.offer(cloud())
        network.next_seq()
    for _ in range(5):
        feed.offer(cloud())  # no credit left: each replaces the one before
    counts = feed.counts
    assert (counts.offered, counts.sent, counts.waiting, counts.dropped_by_client) == (7, 2, 1, 4)
    assert counts.accounted
    feed.settle(receipt(1))
    assert network.next_seq() == 7


def test_no_more_than_the_credit_is_on_its_way(feed: Feed, network: Network) -> None:
    for _ in range(4):
        feed.offer(cloud())
        if feed.counts.in_flight < 2:
            network.next_seq()
    assert feed.counts.in_flight <= 2
    assert not feed.flush(0.0)


@pytest.mark.parametrize("status", list(ReceiptStatus))
def test_each_receipt_status_has_its_counter(feed: Feed, network: Network, status: ReceiptStatus) -> None:
    seq = feed.offer(cloud())
    network.next_seq()
    booked = feed.settle(receipt(seq, status))
    assert isinstance(booked, Receipt)
    assert booked.round_trip_s == 0.0
    assert feed.flush(LIMIT_S)
    assert getattr(feed.counts, status.value) == 1
    assert feed.counts.accounted
    assert [r.status for r in feed.receipts(LIMIT_S)] == [status]


def test_a_missing_receipt_frees_its_credit_and_counts_as_unknown(feed: Feed, network: Network) -> None:
    for _ in range(2):
        feed.offer(cloud())
        network.next_seq()
    feed.offer(cloud())
    network.now = 100.0
    while (
        feed.counts.unknown < 2
    ):  # the deadline starts when put has returned, which may be a moment from now
        network.now += 100.0
        feed.wake()
    assert network.next_seq() == 3
    assert feed.counts.accounted


def test_a_late_receipt_takes_its_cloud_back_from_unknown(feed: Feed, network: Network) -> None:
    seq = feed.offer(cloud())
    network.next_seq()
    while feed.counts.unknown < 1:
        network.now += 100.0
        feed.wake()
    assert feed.settle(receipt(seq)) is not None
    assert (feed.counts.unknown, feed.counts.accepted) == (0, 1)
    assert feed.settle(receipt(seq)) is None, "a second receipt for the same cloud is not ours"
    assert feed.stray_receipts == 1


def test_a_receipt_of_another_process_with_the_same_id_is_not_booked(feed: Feed) -> None:
    assert feed.settle(receipt(77)) is None
    assert feed.stray_receipts == 1
    assert feed.counts.offered == 0


def test_clouds_wait_while_nobody_takes_them(feed: Feed, network: Network) -> None:
    network.matched = False
    for _ in range(3):
        feed.offer(cloud())
    assert (feed.counts.sent, feed.counts.waiting, feed.counts.dropped_by_client) == (0, 1, 2)
    network.matched = True
    assert network.next_seq() == 3


def test_waiting_for_credit_loses_nothing(feed: Feed, network: Network) -> None:
    n = 20

    def answer() -> None:
        for _ in range(n):
            feed.settle(receipt(network.next_seq()))

    server = threading.Thread(target=answer, daemon=True)
    server.start()
    for _ in range(n):
        feed.offer(cloud(), wait=True, timeout_s=LIMIT_S)
    assert feed.flush(LIMIT_S)
    server.join(LIMIT_S)
    assert (feed.counts.accepted, feed.counts.dropped_by_client) == (n, 0)


def test_a_newer_cloud_does_not_replace_one_that_somebody_waits_for(feed: Feed, network: Network) -> None:
    network.matched = False
    waiting = threading.Thread(target=lambda: feed.offer(cloud(), wait=True, timeout_s=LIMIT_S), daemon=True)
    waiting.start()
    while feed.counts.waiting == 0:
        pass
    newer = feed.offer(cloud())
    assert newer == 2
    assert feed.counts.dropped_by_client == 1
    network.matched = True
    feed.wake()
    assert network.next_seq() == 1
    waiting.join(LIMIT_S)


def test_a_wait_without_a_server_ends_with_a_hint_and_a_count(feed: Feed, network: Network) -> None:
    network.matched = False
    with pytest.raises(QueryTimeoutError, match="no server takes clouds"):
        feed.offer(cloud(), wait=True, timeout_s=0.01)
    assert (feed.counts.offered, feed.counts.dropped_by_client) == (1, 1)
    assert feed.counts.accounted


def test_a_number_without_a_receipt_cannot_be_used_again(feed: Feed, network: Network) -> None:
    feed.offer(cloud(), seq=7)
    network.next_seq()
    with pytest.raises(UsageError, match="cloud 7"):
        feed.offer(cloud(), seq=7)
    assert feed.offer(cloud()) == 8, "own numbers go on after the caller's"


def test_the_feed_pauses_longer_after_each_cloud_that_the_server_dropped(
    feed: Feed, network: Network
) -> None:
    seq = feed.offer(cloud())
    for pause_s in (0.05, 0.1, 0.2, 0.4, 0.8, 1.0, 1.0):
        assert network.next_seq() == seq
        feed.settle(receipt(seq, ReceiptStatus.DROPPED))
        seq = feed.offer(cloud())
        network.now += 0.99 * pause_s
        feed.wake()
        assert feed.counts.waiting == 1
        network.now += 0.02 * pause_s
        feed.wake()
    assert network.next_seq() == seq
    feed.settle(receipt(seq))
    seq = feed.offer(cloud())
    assert network.next_seq() == seq, "an accepted cloud ends the pauses"


def test_late_receipts_can_be_waited_for(feed: Feed, network: Network) -> None:
    seq = feed.offer(cloud())
    network.next_seq()
    while feed.counts.unknown < 1:
        network.now += 100.0
        feed.wake()
    assert feed.flush(LIMIT_S)
    assert not feed.flush(0.0, late=True)
    feed.settle(receipt(seq))
    assert feed.flush(LIMIT_S, late=True)


def test_a_put_that_fails_was_not_sent(feed: Feed, network: Network) -> None:
    network.error = RuntimeError("session closed")
    feed.offer(cloud())
    assert feed.flush(LIMIT_S)
    assert (feed.counts.sent, feed.counts.dropped_by_client) == (0, 1)
    assert feed.counts.accounted


def test_closing_gives_every_cloud_an_outcome_and_wakes_waiters(network: Network) -> None:
    feed = make_feed(network, credit=1)
    feed.offer(cloud())
    network.next_seq()
    errors: list[Exception] = []

    def wait() -> None:
        try:
            feed.offer(cloud(), wait=True, timeout_s=LIMIT_S)
        except Exception as error:
            errors.append(error)

    waiter = threading.Thread(target=wait, daemon=True)
    waiter.start()
    while feed.counts.waiting == 0:
        pass
    feed.close()
    waiter.join(LIMIT_S)
    assert [type(e) for e in errors] == [ClosedError]
    counts = feed.counts
    assert (counts.offered, counts.unknown, counts.dropped_by_client, counts.in_flight) == (2, 1, 1, 0)
    assert counts.accounted
    with pytest.raises(ClosedError):
        feed.offer(cloud())


def test_numbers_only_grow_and_stamps_are_the_clock() -> None:
    numbering = Numbering(first=1)
    first = numbering.assign(None, 2**62)  # far in the future
    second = numbering.assign(None, None)
    assert second[0] == first[0] + 1
    assert abs(second[1] - time.time_ns()) < 3600 * 10**9, "a clock that went back is believed"
    assert numbering.assign(100, 5) == (100, 5), "what the caller says is sent as it is"
    assert numbering.assign(None, None)[0] == 101


def test_two_processes_number_apart_and_within_the_wire() -> None:
    starts = {Numbering().assign(None, None)[0] for _ in range(100)}
    assert len(starts) == 100
    assert max(starts) < 2**53, "exact in JSON, legal on the wire"


@given(actions=st.lists(st.sampled_from(["offer", "accept", "reject", "lose", "stray"]), max_size=40))
def test_every_cloud_is_in_exactly_one_place_at_any_time(actions: list[str]) -> None:
    network = Network()
    feed = make_feed(network)
    try:
        for action in actions:
            if action == "offer":
                feed.offer(cloud())
            elif action == "lose":
                network.now += 100.0
                feed.wake()
            elif action == "stray":
                feed.settle(receipt(10_000))
            elif not network.sent.empty():
                status = ReceiptStatus.ACCEPTED if action == "accept" else ReceiptStatus.REJECTED
                feed.settle(receipt(network.next_seq(), status))
            assert feed.counts.accounted, (action, feed.counts)
    finally:
        feed.close()
    counts = feed.counts
    assert counts.accounted
    assert counts.waiting == counts.in_flight == 0
    assert counts.offered == actions.count("offer")
