"""The queue of clouds: bounds, order, fairness, barriers, and that no cloud is ever lost."""

from __future__ import annotations

import collections
import threading
import time

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from potserver.adapters.intake import Barrier, CloudJob, IntakeQueue
from potserver.errors import OverloadedError, PotserverError, ShuttingDownError


def job(robot: str = "r", n_bytes: int = 10) -> CloudJob:
    return CloudJob(robot_id=robot, payload=zenoh.ZBytes(bytes(n_bytes)))


def queue_of(n: int = 4, n_bytes: int = 1000) -> IntakeQueue:
    return IntakeQueue(max_queued=n, max_queued_bytes=n_bytes, retry_after_s=0.25)


def take(queue: IntakeQueue) -> CloudJob:
    taken = queue.take()
    assert isinstance(taken, CloudJob)
    queue.done()
    return taken


def test_one_robot_is_served_in_order() -> None:
    queue = queue_of()
    jobs = [job() for _ in range(3)]
    for each in jobs:
        assert queue.admit(each) == []
    assert (queue.depth, queue.n_bytes) == (3, 30)
    assert [take(queue) for _ in range(3)] == jobs
    assert (queue.depth, queue.n_bytes) == (0, 0)


def test_robots_take_turns() -> None:
    queue = queue_of(10)
    for robot in ("a", "a", "a", "b", "b", "c"):
        queue.admit(job(robot))
    assert [take(queue).lane for _ in range(6)] == ["a", "b", "c", "a", "b", "a"]


def test_a_full_queue_refuses_the_newcomer() -> None:
    queue = queue_of(2)
    queue.admit(job())
    queue.admit(job())
    late = job()
    ((refused, error),) = queue.admit(late)
    assert refused is late
    assert isinstance(error, OverloadedError)
    assert error.retry_after_s == 0.25
    assert queue.depth == 2


def test_bytes_are_bounded_too() -> None:
    queue = queue_of(100, n_bytes=100)
    assert queue.admit(job(n_bytes=60)) == []
    assert len(queue.admit(job(n_bytes=41))) == 1
    assert queue.admit(job(n_bytes=40)) == []
    assert queue.n_bytes == 100


def test_room_is_made_for_a_robot_that_holds_much_less() -> None:
    queue = queue_of(3)
    loud = [job("loud") for _ in range(3)]
    for each in loud:
        queue.admit(each)
    first, second = job("quiet"), job("quiet")
    assert [refusal.job for refusal in queue.admit(first)] == [loud[2]], "the newest of the loud one goes"
    assert [refusal.job for refusal in queue.admit(second)] == [second], "2 to 1 is fair enough"
    assert [take(queue) for _ in range(3)] == [loud[0], first, loud[1]]


def test_nobody_loses_a_place_to_a_newcomer_that_still_does_not_fit() -> None:
    queue = queue_of(100, n_bytes=100)
    loud, other = [job("loud", 20) for _ in range(3)], job("other", 40)
    for each in (*loud, other):
        queue.admit(each)
    huge = job("quiet", 90)
    assert [refusal.job for refusal in queue.admit(huge)] == [huge]
    assert (queue.depth, queue.n_bytes) == (4, 100)


def test_short_bytes_are_taken_from_who_holds_most_bytes() -> None:
    queue = queue_of(100, n_bytes=100)
    many_small, few_large = [job("small", 2) for _ in range(10)], [job("large", 40) for _ in range(2)]
    for each in (*many_small, *few_large):
        queue.admit(each)
    newcomer = job("new", 30)
    assert [refusal.job for refusal in queue.admit(newcomer)] == [few_large[1]]
    assert queue.n_bytes == 90
    assert queue.admit(job("new", 10)) == []
    assert len(queue.admit(job("new", 10))) == 1, "it holds as much as the largest by now"


def test_a_cloud_of_no_bytes_has_its_place() -> None:
    queue = queue_of(1)
    empty = job("a", 0)
    assert queue.admit(empty) == []
    assert len(queue.admit(job("b", 0))) == 1
    assert take(queue) is empty


def test_after_stop_admitting_only_what_is_queued_is_worked_off() -> None:
    queue = queue_of()
    kept, late = job(), job()
    queue.admit(kept)
    queue.stop_admitting()
    assert not queue.is_admitting
    ((refused, error),) = queue.admit(late)
    assert refused is late
    assert isinstance(error, ShuttingDownError)
    assert take(queue) is kept


def test_a_barrier_follows_what_came_before_it_and_leads_what_comes_after() -> None:
    queue = queue_of(10)
    before, after = [job("a"), job("b")], job("a")
    for each in before:
        queue.admit(each)
    barrier = Barrier(lambda: None, lambda _: None)
    queue.admit_barrier(barrier)
    queue.admit(after)
    assert [take(queue), take(queue)] == before
    assert queue.take() is barrier
    queue.done()
    assert take(queue) is after


def test_an_evicted_cloud_may_stand_on_either_side_of_a_barrier() -> None:
    queue = queue_of(2)
    early, late = job("loud"), job("loud")
    queue.admit(early)
    queue.admit_barrier(Barrier(lambda: None, lambda _: None))
    queue.admit(late)
    assert [r.job for r in queue.admit(job("quiet"))] == [late]
    assert take(queue) is early


def test_barriers_are_bounded() -> None:
    queue = queue_of()
    barrier = Barrier(lambda: None, lambda _: None)
    for _ in range(16):
        queue.admit_barrier(barrier)
    with pytest.raises(OverloadedError):
        queue.admit_barrier(barrier)


def test_idle_means_nothing_queued_and_nothing_in_work() -> None:
    queue = queue_of()
    assert queue.wait_idle(0)
    queue.admit(job())
    assert not queue.wait_idle(0)
    queue.take()
    assert not queue.wait_idle(0), "it is in work"
    queue.done()
    assert queue.wait_idle(0)


def test_close_wakes_the_consumer_and_hands_back_the_rest() -> None:
    queue = queue_of()
    ended = threading.Event()

    def consume() -> None:
        while queue.take() is not None:
            queue.done()
        ended.set()

    threading.Thread(target=consume, daemon=True).start()
    assert queue.close() == ([], [])
    assert ended.wait(10)

    queue = queue_of()
    left, barrier = job(), Barrier(lambda: None, lambda _: None)
    queue.admit(left)
    queue.admit_barrier(barrier)
    assert queue.close() == ([left], [barrier])
    assert queue.take() is None
    with pytest.raises(ShuttingDownError):
        queue.admit_barrier(barrier)


@given(
    st.lists(
        st.one_of(
            st.tuples(st.sampled_from("abcd"), st.integers(1, 60)), st.just("take"), st.just("barrier")
        ),
        max_size=60,
    )
)
def test_every_cloud_ends_exactly_once_and_the_bounds_hold(steps: list[tuple[str, int] | str]) -> None:
    queue = IntakeQueue(max_queued=5, max_queued_bytes=120)
    ends: collections.Counter[int] = collections.Counter()
    jobs: list[CloudJob] = []
    for step in steps:
        if step == "take":
            if queue.depth:
                taken = queue.take()
                queue.done()
                if isinstance(taken, CloudJob):
                    ends[id(taken)] += 1
        elif step == "barrier":
            try:
                queue.admit_barrier(Barrier(lambda: None, lambda _: None))
            except PotserverError:
                continue
        else:
            jobs.append(job(*step))
            ends.update(id(refusal.job) for refusal in queue.admit(jobs[-1]))
        assert queue.depth <= 5
        assert queue.n_bytes <= 120
    clouds, _ = queue.close()
    ends.update(id(left) for left in clouds)
    assert set(ends) == {id(each) for each in jobs}
    assert set(ends.values()) <= {1}


def test_many_producers_and_one_consumer_lose_nothing() -> None:
    queue = IntakeQueue(max_queued=8, max_queued_bytes=10**6)
    mapped: list[CloudJob] = []
    refused: list[CloudJob] = []

    def consume() -> None:
        while (taken := queue.take()) is not None:
            assert isinstance(taken, CloudJob)
            mapped.append(taken)
            queue.done()

    def produce(robot: str) -> None:
        for _ in range(300):
            refused.extend(refusal.job for refusal in queue.admit(job(robot)))

    consumer = threading.Thread(target=consume, daemon=True)
    consumer.start()
    producers = [threading.Thread(target=produce, args=(robot,)) for robot in "abcd"]
    for thread in producers:
        thread.start()
    for thread in producers:
        thread.join()
    assert queue.wait_idle(30)
    queue.close()
    consumer.join(10)
    assert len({id(each) for each in mapped + refused}) == len(mapped) + len(refused) == 1200


# --- clouds that cannot be mapped yet -----------------------------------------------------------------------


def test_a_robot_that_waits_holds_up_nobody_and_keeps_its_order() -> None:
    queue = queue_of(10)
    first, second, other = job("a"), job("a"), job("b")
    for each in (first, second, other):
        queue.admit(each)
    assert take(queue) is first
    assert queue.put_back(first, time.monotonic() + 1e6)
    assert take(queue) is other
    assert (queue.depth, queue.n_bytes) == (2, 20)
    queue.wake("a")
    assert [take(queue), take(queue)] == [first, second]


def test_a_cloud_that_waits_is_given_again_when_its_time_is_over() -> None:
    queue = queue_of()
    late = job("a")
    queue.admit(late)
    assert take(queue) is late
    queue.put_back(late, time.monotonic() + 0.01)
    assert take(queue) is late


def test_a_barrier_comes_after_the_clouds_that_wait() -> None:
    queue = queue_of()
    late, barrier = job("a"), Barrier(lambda: None, lambda _: None)
    queue.admit(late)
    assert take(queue) is late
    queue.put_back(late, time.monotonic() + 1e6)
    queue.admit_barrier(barrier)
    queue.admit(job("b"))
    queue.wake("a")
    assert take(queue) is late
    assert queue.take() is barrier


def test_a_closed_queue_takes_nothing_back() -> None:
    queue = queue_of()
    late = job("a")
    queue.admit(late)
    assert take(queue) is late
    queue.close()
    assert not queue.put_back(late, time.monotonic() + 1e6)
