"""Queries waiting for a worker: bounded by count and by bytes."""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
from collections.abc import Callable

from potserver.adapters.threads import spawn
from potserver.errors import OverloadedError, PotserverError, ShuttingDownError


@dataclasses.dataclass(slots=True, eq=False, kw_only=True)
class QueryJob:
    """One query that passed admission."""

    answer: Callable[[float], None]  # called by a worker with the time of arrival; must not raise
    refuse: Callable[[PotserverError], None]
    n_bytes: int
    arrived_s: float = dataclasses.field(default_factory=time.monotonic)


class QueryPool:
    """Worker threads that answer the queries of all maps of a server.

    Args:
        threads: Workers.
        max_queued: Queries waiting; one more is refused at once.
        max_queued_bytes: Bytes of their payloads.
        retry_after_s: What a refused asker is advised to wait.
    """

    def __init__(self, *, threads: int, max_queued: int, max_queued_bytes: int, retry_after_s: float) -> None:
        self._max_queued, self._max_bytes, self._retry_after_s = max_queued, max_queued_bytes, retry_after_s
        self._changed = threading.Condition()
        self._jobs: collections.deque[QueryJob] = collections.deque()
        self._n_bytes = 0
        self._closed = False
        self._threads = [spawn(f"query-worker-{i}", self._work) for i in range(threads)]

    @property
    def depth(self) -> int:
        """Queries waiting, without those in work."""
        with self._changed:
            return len(self._jobs)

    @property
    def n_bytes(self) -> int:
        """Bytes waiting."""
        with self._changed:
            return self._n_bytes

    def submit(self, job: QueryJob) -> None:
        """Queue a query.

        Raises:
            OverloadedError: the queue is full.
            ShuttingDownError: the pool is closed.
        """
        with self._changed:
            if self._closed:
                raise ShuttingDownError("the server is closing")
            if len(self._jobs) >= self._max_queued or self._n_bytes + job.n_bytes > self._max_bytes:
                raise OverloadedError(
                    f"{len(self._jobs)} queries of {self._n_bytes} bytes wait already",
                    retry_after_s=self._retry_after_s,
                )
            self._jobs.append(job)
            self._n_bytes += job.n_bytes
            self._changed.notify()

    def close(self, timeout_s: float) -> None:
        """Refuse what waits, finish what is in work, end the workers."""
        with self._changed:
            self._closed = True
            left, self._jobs = list(self._jobs), collections.deque()
            self._n_bytes = 0
            self._changed.notify_all()
        for job in left:
            job.refuse(ShuttingDownError("the server is closing"))
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._jobs or self._closed)
                if self._closed:
                    return
                job = self._jobs.popleft()
                self._n_bytes -= job.n_bytes
            job.answer(job.arrived_s)
