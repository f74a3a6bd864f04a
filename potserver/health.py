"""How the server is doing: counters, latencies of the last window, memory. Knows nothing of the network."""

from __future__ import annotations

import collections
import dataclasses
import math
import os
import threading
import time
from pathlib import Path


@dataclasses.dataclass(frozen=True, slots=True)
class Latency:
    """Percentiles of the last window of one kind of work."""

    count: int  # observations in the window
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float


class Health:
    """Counters since the start and latency windows, shared by all threads of a server.

    Counter names are dotted paths with a bounded set of values (`clouds.rejected.bad_pose`): never put an id
    in one.

    Args:
        window: Observations that a latency percentile looks back on.
    """

    def __init__(self, *, window: int = 1024) -> None:
        self.started_ns = time.time_ns()
        self._started_s = time.monotonic()
        self._window = window
        self._lock = threading.Lock()
        self._counters: collections.Counter[str] = collections.Counter()
        self._observations: dict[str, collections.deque[float]] = {}

    @property
    def uptime_s(self) -> float:
        """Seconds since this object was made."""
        return time.monotonic() - self._started_s

    def count(self, name: str, n: int = 1) -> None:
        """Add `n` to a counter."""
        with self._lock:
            self._counters[name] += n

    def counter(self, name: str) -> int:
        """One counter; zero if it never counted."""
        with self._lock:
            return self._counters[name]

    def counters(self) -> dict[str, int]:
        """All counters, sorted by name."""
        with self._lock:
            return dict(sorted(self._counters.items()))

    def observe(self, kind: str, elapsed_ms: float) -> None:
        """Note how long one piece of work took."""
        with self._lock:
            window = self._observations.get(kind)
            if window is None:
                window = self._observations[kind] = collections.deque(maxlen=self._window)
            window.append(elapsed_ms)

    def latencies(self) -> dict[str, Latency]:
        """Percentiles (nearest rank) of every kind of work seen so far."""
        with self._lock:
            windows = {kind: list(window) for kind, window in self._observations.items()}
        return {kind: _summary(sorted(values)) for kind, values in sorted(windows.items())}


def _summary(ordered: list[float]) -> Latency:
    def rank(share: float) -> float:
        return ordered[max(0, math.ceil(share * len(ordered)) - 1)]

    return Latency(len(ordered), rank(0.50), rank(0.95), rank(0.99), ordered[-1])


def rss_bytes() -> int:
    """Resident memory of this process; its peak where the system does not tell the present value."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        import resource
        import sys

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return pages * os.sysconf("SC_PAGE_SIZE")
