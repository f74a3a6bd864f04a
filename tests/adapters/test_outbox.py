"""Sending off the mapper's thread."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from potserver.adapters.outbox import End, Outbox


@pytest.fixture
def outbox() -> Iterator[Outbox]:
    box = Outbox("test", max_pending=2, max_pending_bytes=100)
    yield box
    box.close(10)


def hold(outbox: Outbox) -> threading.Event:
    """Keep the thread busy until the event is set."""
    gate, entered = threading.Event(), threading.Event()

    def task() -> None:
        entered.set()
        gate.wait(30)

    outbox.post_now(task)
    assert entered.wait(10)
    return gate


def test_tasks_run_in_order_and_close_waits_for_them(outbox: Outbox) -> None:
    done: list[int] = []
    for i in range(50):
        outbox.post(lambda i=i: done.append(i))  # type: ignore[misc]
    assert outbox.close(10)
    assert done == list(range(50))


def test_offer_declines_when_full_and_post_now_does_not(outbox: Outbox) -> None:
    gate, done = hold(outbox), list[str]()
    assert outbox.offer(lambda: done.append("a"))
    assert outbox.offer(lambda: done.append("b"))
    assert not outbox.offer(lambda: done.append("c"))
    outbox.post_now(lambda: done.append("d"))
    assert outbox.depth == 3
    gate.set()
    assert outbox.close(10)
    assert done == ["a", "b", "d"]


def test_bytes_count_until_the_task_is_done(outbox: Outbox) -> None:
    gate = hold(outbox)
    assert outbox.offer(lambda: None, 100)
    assert not outbox.offer(lambda: None)
    gate.set()
    outbox.post(lambda: None)  # waits until there is room
    assert outbox.close(10)


def test_a_task_that_fails_does_not_end_the_thread(outbox: Outbox, caplog: pytest.LogCaptureFixture) -> None:
    done = threading.Event()
    outbox.post(lambda: 1 / 0 and None)
    outbox.post(done.set)
    assert done.wait(10)
    assert any("send_failed" in str(record.msg) for record in caplog.records)


def test_every_task_is_told_how_it_ended(outbox: Outbox) -> None:
    ends: list[End] = []
    outbox.post(lambda: None, ended=ends.append)
    outbox.post(lambda: 1 / 0 and None, ended=ends.append)
    gate = hold(outbox)
    outbox.post_now(lambda: None, ended=ends.append)
    assert not outbox.close(0.01)
    outbox.post_now(lambda: None, ended=ends.append)
    gate.set()
    assert ends == [End.SENT, End.FAILED, End.ABANDONED, End.ABANDONED]


def test_close_gives_up_in_time(outbox: Outbox) -> None:
    gate = hold(outbox)
    assert not outbox.close(0.01)
    assert not outbox.offer(lambda: None)
    outbox.post(lambda: None)  # does not wait for ever on a closed box
    outbox.post(lambda: None)
    outbox.post(lambda: None)
    gate.set()
