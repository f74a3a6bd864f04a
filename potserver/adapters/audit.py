"""Audit lines: who changed a map or was refused, what it was, and when. Their logger is `potserver.audit`.

Who is the Zenoh id that the asker names, or the robot of its key. Neither is proven by itself: access control and TLS of
Zenoh do that.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from typing import Any

from potserver.errors import PotserverError
from potserver.log import get_logger

log = get_logger("potserver.audit")

_QUIET_S = 1.0  # between two lines of the same refusal; those between are counted in the next one
_UNNAMED = "unnamed"


class Audit:
    """The audit lines of one map; from any thread."""

    def __init__(self, map_id: str) -> None:
        self._map_id = map_id
        self._lock = threading.Lock()
        self._spoken_s: dict[tuple[str, str], float] = {}  # what and why: both are few
        self._unspoken: Counter[tuple[str, str]] = Counter()

    def changed(self, what: str, who: str, **fields: Any) -> None:
        """Somebody changed the map."""
        log.info("change_made", map_id=self._map_id, what=what, who=who or _UNNAMED, **fields)

    def refused(self, what: str, who: str, error: PotserverError, **fields: Any) -> None:
        """Somebody was refused: a line a second for each kind and reason, which counts those that it stands for."""
        key, now_s = (what, error.code), time.monotonic()
        with self._lock:
            self._unspoken[key] += 1
            if now_s - self._spoken_s.get(key, -_QUIET_S) < _QUIET_S:
                return
            self._spoken_s[key] = now_s
            n = self._unspoken.pop(key)
        log.info(
            "refused",
            map_id=self._map_id,
            what=what,
            who=who or _UNNAMED,
            reason=error.code,
            detail=str(error)[:300],
            n=n,
            **fields,
        )
