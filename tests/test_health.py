"""Counters and latency windows."""

from __future__ import annotations

import threading

from potserver.health import Health, Latency, rss_bytes


def test_counters_start_at_zero_and_add_up() -> None:
    health = Health()
    health.count("b")
    health.count("a", 3)
    health.count("b")
    assert health.counter("none") == 0
    assert list(health.counters().items()) == [("a", 3), ("b", 2)]


def test_counting_from_many_threads_loses_nothing() -> None:
    health = Health(window=10)

    def work() -> None:
        for i in range(1000):
            health.count("n")
            health.observe("kind", i)

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert health.counter("n") == 8000
    assert health.latencies()["kind"].count == 10


def test_percentiles_are_nearest_rank() -> None:
    health = Health()
    for ms in range(100, 0, -1):
        health.observe("integrate", float(ms))
    assert health.latencies()["integrate"] == Latency(100, 50.0, 95.0, 99.0, 100.0)
    health.observe("points", 7.5)
    assert health.latencies()["points"] == Latency(1, 7.5, 7.5, 7.5, 7.5)


def test_only_the_last_window_counts() -> None:
    health = Health(window=4)
    for ms in (1000.0, 1.0, 2.0, 3.0, 4.0):
        health.observe("grid", ms)
    assert health.latencies()["grid"] == Latency(4, 2.0, 4.0, 4.0, 4.0)


def test_nothing_seen_is_nothing_said() -> None:
    health = Health()
    assert health.latencies() == {}
    assert health.counters() == {}
    assert health.uptime_s >= 0


def test_rss_is_that_of_this_process() -> None:
    assert 2**20 < rss_bytes() < 2**40
