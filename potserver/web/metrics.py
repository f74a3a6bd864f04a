"""A server's counters in the text format of Prometheus."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector

from potschemas import messages

CONTENT_TYPE = CONTENT_TYPE_LATEST
_QUANTILES = {"0.5": "p50_ms", "0.95": "p95_ms", "0.99": "p99_ms"}
_SCORES = ("nll", "brier", "ece")


class StatsCollector(Collector):
    """Turns `pot.stats.v1` into metrics, at each scrape.

    A counter `clouds.rejected.bad_pose` is `potserver_clouds_total{kind="rejected",detail="bad_pose"}`.
    """

    def __init__(self, stats: Callable[[], messages.Stats]) -> None:
        self._stats = stats

    def collect(self) -> Iterator[Any]:
        stats = self._stats()
        yield from _counters(stats.counters)
        serving = GaugeMetricFamily("potserver_serving", "1 while clouds and questions are taken")
        serving.add_metric([], stats.state == "serving")
        uptime = GaugeMetricFamily("potserver_uptime_seconds", "since the start")
        uptime.add_metric([], stats.uptime_s)
        memory = GaugeMetricFamily("potserver_resident_bytes", "resident memory of the process")
        memory.add_metric([], stats.rss_bytes)
        yield from (serving, uptime, memory)
        yield _gauge("potserver_queue", "what waits, in items or bytes", "queue", stats.queues)
        yield _gauge("potserver_map_kernels", "kernels of a map", "map", stats.map_kernels)
        yield _latencies(stats.latencies)
        yield _scores(stats.map_scores or {})


def exposition(stats: Callable[[], messages.Stats]) -> Callable[[], bytes]:
    """A function that gives all metrics now, as Prometheus reads them."""
    registry = CollectorRegistry()
    collector = StatsCollector(stats)
    registry.register(collector)
    return lambda: generate_latest(registry)


def _counters(counters: dict[str, int]) -> Iterator[CounterMetricFamily]:
    families: dict[str, CounterMetricFamily] = {}
    for name, value in counters.items():
        head, _, rest = name.partition(".")
        kind, _, detail = rest.partition(".")
        if head not in families:
            text = f"counters {head}.KIND.DETAIL of pot.stats.v1"
            families[head] = CounterMetricFamily(f"potserver_{head}", text, labels=["kind", "detail"])
        families[head].add_metric([kind, detail], value)
    yield from families.values()


def _gauge(name: str, text: str, label: str, values: dict[str, int]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(name, text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family


def _latencies(latencies: dict[str, messages.LatencySummary]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(
        "potserver_latency_ms",
        "percentiles of the last window of each kind of work",
        labels=["work", "quantile"],
    )
    for work, summary in latencies.items():
        for quantile, field in _QUANTILES.items():
            family.add_metric([work, quantile], getattr(summary, field))
    return family


def _scores(scores: dict[str, messages.MapScores]) -> GaugeMetricFamily:
    family = GaugeMetricFamily(
        "potserver_map_score", "a map's own scores on beams that it never learned", labels=["map", "score"]
    )
    for map_id, of_map in scores.items():
        for score in _SCORES:
            value = getattr(of_map, score)
            if math.isfinite(value):
                family.add_metric([map_id, score], value)
    return family
