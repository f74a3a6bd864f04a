"""Questions in turns: short ones past long ones, askers by their share, and none for askers that are gone."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterator

import pytest

from potserver.adapters.fairness import Rates
from potserver.adapters.query_pool import QueryJob, QueryPool
from potserver.errors import OverloadedError, PotserverError, ShuttingDownError, TooManyError

DEADLINE_S = 30.0


class Desk:
    """Jobs whose steps wait for the test, and what became of them."""

    def __init__(self) -> None:
        self.steps: queue.Queue[str] = queue.Queue()  # names, as their steps began
        self.ends: queue.Queue[tuple[str, str]] = queue.Queue()
        self.may_go = threading.Semaphore(0)
        self.may_go_first = threading.Semaphore(0)  # for jobs that are let go before others

    def job(
        self,
        name: str,
        asker: str,
        *,
        n_steps: int = 1,
        is_short: bool = False,
        n_bytes: int = 10,
        gate: threading.Semaphore | None = None,
    ) -> QueryJob:
        def steps() -> Iterator[bool]:
            for _ in range(n_steps):
                self.steps.put(name)
                assert (gate or self.may_go).acquire(timeout=DEADLINE_S)
                yield is_short
            self.ends.put((name, "ok"))

        def refuse(error: PotserverError) -> None:
            self.ends.put((name, error.code))

        return QueryJob(
            steps=steps(),
            refuse=refuse,
            abandon=lambda: self.ends.put((name, "gone")),
            asker=asker,
            n_bytes=n_bytes,
            is_short=is_short,
        )

    def next_step(self) -> str:
        return self.steps.get(timeout=DEADLINE_S)

    def next_end(self) -> tuple[str, str]:
        return self.ends.get(timeout=DEADLINE_S)


MakePool = Callable[..., QueryPool]


@pytest.fixture
def desk() -> Iterator[Desk]:
    desk = Desk()
    yield desk
    desk.may_go.release(1000)


@pytest.fixture
def make_pool(desk: Desk) -> Iterator[MakePool]:
    made: list[QueryPool] = []

    def make(*, max_queued: int = 100, max_queued_bytes: int = 10_000) -> QueryPool:
        made.append(QueryPool(threads=1, max_queued=max_queued, max_queued_bytes=max_queued_bytes))
        return made[0]

    yield make
    desk.may_go.release(1000)
    for pool in made:
        pool.close(DEADLINE_S)


def test_long_questions_of_several_askers_take_turns(desk: Desk, make_pool: MakePool) -> None:
    pool = make_pool()
    pool.submit(desk.job("a", "A", n_steps=3))
    assert desk.next_step() == "a"
    pool.submit(desk.job("b", "B", n_steps=3))
    order = ["a"]
    for _ in range(5):
        desk.may_go.release()
        order.append(desk.next_step())
    desk.may_go.release()
    assert order.index("b") == 1, "who has had nothing is next"
    assert {desk.next_end(), desk.next_end()} == {("a", "ok"), ("b", "ok")}


def test_one_asker_with_many_questions_gets_no_more_than_one_with_one(
    desk: Desk, make_pool: MakePool
) -> None:
    pool = make_pool()
    for i in range(5):
        pool.submit(desk.job(f"greedy{i}", "greedy", n_steps=2))
    assert desk.next_step() == "greedy0"
    pool.submit(desk.job("modest", "modest"))
    desk.may_go.release()
    assert desk.next_step() == "modest", "not behind five others"


def test_a_short_question_waits_for_no_long_one(desk: Desk, make_pool: MakePool) -> None:
    pool = make_pool()
    for i in range(3):
        pool.submit(desk.job(f"grid{i}", "A", n_steps=5))
    assert desk.next_step() == "grid0"
    pool.submit(desk.job("points", "A", is_short=True))
    assert desk.next_step() == "points", "the worker of short questions takes it while the other is busy"


def test_a_question_that_turns_out_long_makes_way(desk: Desk, make_pool: MakePool) -> None:
    """The plan of a grid looks short; its cells are not."""
    pool = make_pool()
    pool.submit(desk.job("busy", "A"))
    assert desk.next_step() == "busy"
    long = desk.job("grid", "B", n_steps=2, gate=desk.may_go_first)
    long.is_short = True  # as far as its size says
    pool.submit(long)
    assert desk.next_step() == "grid"
    pool.submit(desk.job("points", "C", is_short=True))
    desk.may_go_first.release()
    assert desk.next_step() == "points"
    desk.may_go_first.release()


def test_in_a_full_queue_the_newest_of_the_asker_with_most_makes_room(
    desk: Desk, make_pool: MakePool
) -> None:
    pool = make_pool(max_queued=3)
    pool.submit(desk.job("in work", "greedy"))
    assert desk.next_step() == "in work"
    for i in range(3):
        pool.submit(desk.job(f"greedy{i}", "greedy"))
    pool.submit(desk.job("modest0", "modest"))
    assert desk.next_end() == ("greedy2", "overloaded")
    with pytest.raises(OverloadedError) as caught:
        pool.submit(desk.job("greedy3", "greedy"))
    assert caught.value.retry_after_s == 0.2
    assert pool.depth == 3


def test_bytes_are_bounded_too(desk: Desk, make_pool: MakePool) -> None:
    pool = make_pool(max_queued_bytes=100)
    pool.submit(desk.job("in work", "A", n_bytes=90))
    assert desk.next_step() == "in work"
    pool.submit(desk.job("a", "A", n_bytes=90))
    with pytest.raises(OverloadedError):
        pool.submit(desk.job("b", "A", n_bytes=20))
    assert pool.n_bytes == 90


def test_questions_of_an_asker_that_is_gone_are_given_up(desk: Desk, make_pool: MakePool) -> None:
    pool = make_pool()
    pool.submit(desk.job("in work", "gone", n_steps=50))
    assert desk.next_step() == "in work"
    pool.submit(desk.job("waiting", "gone"))
    pool.submit(desk.job("other", "here"))
    assert pool.give_up("gone") == 2
    assert pool.give_up("unheard of") == 0
    assert desk.next_end() == ("waiting", "gone")
    desk.may_go.release(2)
    assert {desk.next_end(), desk.next_end()} == {("in work", "gone"), ("other", "ok")}
    assert desk.next_step() == "other"
    assert desk.steps.empty(), "not one of the 49 steps that were left"


def test_closing_refuses_what_waits_and_what_is_between_its_parts(desk: Desk, make_pool: MakePool) -> None:
    pool = make_pool()
    pool.submit(desk.job("in work", "A", n_steps=50))
    assert desk.next_step() == "in work"
    pool.submit(desk.job("waiting", "A"))
    closing = threading.Thread(target=pool.close, args=(DEADLINE_S,))
    closing.start()
    assert desk.next_end() == ("waiting", "shutting_down")
    desk.may_go.release()
    assert desk.next_end() == ("in work", "shutting_down")
    closing.join(DEADLINE_S)
    with pytest.raises(ShuttingDownError):
        pool.submit(desk.job("late", "A"))


def test_who_asks_too_often_is_told_when_to_come_back_and_others_are_not_held_up() -> None:
    now_s = 100.0
    rates = Rates(10.0, lambda: now_s)
    for _ in range(10):  # a second's worth at once
        rates.check("A")
    with pytest.raises(TooManyError, match="more than 10 questions a second") as early:
        rates.check("A")
    rates.check("B")
    now_s += early.value.retry_after_s or 0.0
    rates.check("A")
    with pytest.raises(TooManyError):
        rates.check("A")
    now_s += 60.0
    for _ in range(10):
        rates.check("A")


def test_askers_that_came_long_ago_are_not_remembered() -> None:
    now_s = 0.0
    rates = Rates(10.0, lambda: now_s)
    for number in range(3 * 4096):
        rates.check(f"{number}")
        now_s += 1.0
    assert len(rates._due_s) <= 4096
