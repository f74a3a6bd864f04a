"""What did not get through, and why: a counter a reason, and a line in the log for the first of each and every tenfold."""

from __future__ import annotations

import collections
import threading

from potserver.health import Health
from potserver.log import get_logger

log = get_logger("potserver.ros")

_MAX_KINDS = 10_000  # of robots and reasons that are told apart in the log


class Drops:
    """Counts what was dropped of one kind of message. Any thread may call.

    Args:
        health: Takes the counters `ros.<kind>.dropped.<reason>`.
        kind: `clouds`, `poses` or `maps`.
    """

    def __init__(self, health: Health, kind: str) -> None:
        self._health, self._kind = health, kind
        self._lock = threading.Lock()
        self._seen: collections.Counter[tuple[str, str]] = collections.Counter()

    def count(self, reason: str, who: str, detail: str) -> None:
        """One was dropped.

        Args:
            reason: One word of a bounded set.
            who: Robot or topic.
            detail: For people.
        """
        self._health.count(f"ros.{self._kind}.dropped.{reason}")
        with self._lock:
            if len(self._seen) >= _MAX_KINDS:
                self._seen.clear()
            self._seen[who, reason] += 1
            n = self._seen[who, reason]
        if n == 10 ** (len(str(n)) - 1):
            log.warning("ros_message_dropped", kind=self._kind, who=who, reason=reason, detail=detail, n=n)
