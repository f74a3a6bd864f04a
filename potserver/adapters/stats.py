"""`srv/<server>/stats`: the server's counters, once a second and when asked."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Callable, Mapping

import zenoh

from potschemas import messages
from potserver.adapters.queryable import Queryable
from potserver.adapters.replies import check_query, payload_of, reply, reply_error
from potserver.codec.base import decode, encode
from potserver.domain.map_state import MapState
from potserver.errors import PotserverError
from potserver.health import Health, rss_bytes
from potserver.limits import Limits
from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.stats")

PERIOD_S = 1.0  # between two publications; the contract says so


class StatsPublisher:
    """Publishes the counters of a server, and answers who asks for them."""

    def __init__(
        self, session: zenoh.Session, key: str, stats_now: Callable[[], messages.Stats], limits: Limits
    ) -> None:
        self._stats_now = stats_now
        self._stop = threading.Event()
        # background: the first to go when a link is full
        self._publisher = session.declare_publisher(
            key, priority=zenoh.Priority.BACKGROUND, congestion_control=zenoh.CongestionControl.DROP
        )
        self._queryable = _StatsQueryable(session, key, stats_now, limits)
        self._threads = [
            spawn("stats-publisher", self._publish),
            spawn("stats-queryable", self._queryable.run),
        ]

    def close(self) -> None:
        """Publish and answer no more."""
        self._stop.set()
        self._queryable.undeclare()
        for thread in self._threads:
            thread.join(1.0)
        self._publisher.undeclare()

    def _publish(self) -> None:
        next_s = time.monotonic()
        while not self._stop.wait(max(0.0, next_s - time.monotonic())):
            next_s = max(next_s + PERIOD_S, time.monotonic())
            try:
                wire = encode(self._stats_now())
                self._publisher.put(wire.payload, encoding=wire.encoding)
            except Exception:
                log.exception("stats_failed")


class _StatsQueryable(Queryable):
    """Answers at once: the counters are there, and nobody else waits behind."""

    def __init__(
        self, session: zenoh.Session, key: str, stats_now: Callable[[], messages.Stats], limits: Limits
    ) -> None:
        self._key, self._stats_now, self._limits = key, stats_now, limits
        super().__init__(session, key)

    def admit(self, query: zenoh.Query) -> None:
        check_query(query, messages.StatsQuery, self._limits.max_query_bytes, "stats query")
        decode(payload_of(query), messages.StatsQuery)
        wire = encode(self._stats_now())
        with query:
            reply(query, self._key, wire)

    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        with query:
            reply_error(query, error)


def stats_now(
    health: Health,
    *,
    server_id: str,
    state: str,
    n_robots: int,
    queues: dict[str, int],
    maps: Mapping[str, MapState],
) -> messages.Stats:
    """The counters now.

    Args:
        health: Of the server.
        server_id: Its id.
        state: serving or draining.
        n_robots: With a token, of all maps.
        queues: What waits, by the queue's name.
        maps: One state of each.
    """
    return messages.Stats(
        server=server_id,
        stamp_ns=time.time_ns(),
        uptime_s=health.uptime_s,
        state=state,
        counters=health.counters() | {"robots.alive": n_robots},
        queues=queues,
        latencies={
            kind: messages.LatencySummary(**dataclasses.asdict(latency))
            for kind, latency in health.latencies().items()
        },
        rss_bytes=rss_bytes(),
        map_kernels={map_id: len(held.snapshot) for map_id, held in maps.items()},
        map_scores={map_id: _scores(held) for map_id, held in maps.items()},
    )


def _scores(held: MapState) -> messages.MapScores:
    """How well a map answers, with the moderation that it answers with."""
    scores, moderation = held.scores, held.snapshot.rule.mean_moderation
    return messages.MapScores(
        n_points=scores.n_points,
        nll=scores.mean_nll(moderation),
        brier=scores.mean_brier,
        ece=scores.ece,
        mean_moderation=moderation,
    )
