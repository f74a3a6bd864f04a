"""Queries waiting for a worker: bounded by count and by bytes."""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
from collections.abc import Callable

from potserver.errors import OverloadedError, PotserverError, ShuttingDownError
from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.queries")

RETRY_AFTER_S = 0.2  # what a refused asker is advised to wait: about as long as one part of a grid takes


@dataclasses.dataclass(slots=True, eq=False, kw_only=True)
class QueryJob:
    """One query that passed admission."""

    answer: Callable[[float], None]  # called by a worker with the time of arrival; must not raise
    refuse: Callable[[PotserverError], None]
    n_bytes: int
    is_short: bool = False  # microseconds of work: need not wait behind grids
    arrived_s: float = dataclasses.field(default_factory=time.monotonic)


class QueryPool:
    """Worker threads that answer the queries of all maps of a server, and one more for short work only.

    Args:
        threads: Workers that take everything.
        max_queued: Queries waiting; one more is refused at once.
        max_queued_bytes: Bytes of their payloads.
        retry_after_s: What a refused asker is advised to wait.
    """

    def __init__(
        self, *, threads: int, max_queued: int, max_queued_bytes: int, retry_after_s: float = RETRY_AFTER_S
    ) -> None:
        self._max_queued, self._max_bytes, self._retry_after_s = max_queued, max_queued_bytes, retry_after_s
        self._changed = threading.Condition()
        self._jobs: collections.deque[QueryJob] = collections.deque()
        self._short: collections.deque[QueryJob] = collections.deque()
        self._working: set[QueryJob] = set()
        self._n_bytes = 0
        self._closed = False
        self._threads = [
            *(spawn(f"query-worker-{i}", self._work_on_all) for i in range(threads)),
            spawn("query-worker-short", self._work_on_short),
        ]

    @property
    def depth(self) -> int:
        """Queries waiting, without those in work."""
        with self._changed:
            return len(self._jobs) + len(self._short)

    @property
    def n_bytes(self) -> int:
        """Bytes waiting."""
        with self._changed:
            return self._n_bytes

    @property
    def is_closing(self) -> bool:
        """Long answers should end now."""
        with self._changed:
            return self._closed

    def submit(self, job: QueryJob) -> None:
        """Queue a query.

        Raises:
            OverloadedError: the queue is full.
            ShuttingDownError: the pool is closed.
        """
        with self._changed:
            if self._closed:
                raise ShuttingDownError("the server is closing")
            n_queued = len(self._jobs) + len(self._short)
            if n_queued >= self._max_queued or self._n_bytes + job.n_bytes > self._max_bytes:
                raise OverloadedError(
                    f"{n_queued} queries of {self._n_bytes} bytes wait already",
                    retry_after_s=self._retry_after_s,
                )
            (self._short if job.is_short else self._jobs).append(job)
            self._n_bytes += job.n_bytes
            self._changed.notify_all()

    def close(self, timeout_s: float) -> bool:
        """Refuse what waits and what is still in work at the end of the time, end the workers; False if one did not."""
        with self._changed:
            self._closed = True
            left = [*self._short, *self._jobs]
            self._short.clear()
            self._jobs.clear()
            self._n_bytes = 0
            self._changed.notify_all()
        for job in left:
            job.refuse(ShuttingDownError("the server is closing"))
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        with self._changed:
            cut_off = list(self._working)
        for job in cut_off:
            try:
                job.refuse(ShuttingDownError("the server is closing"))
            except Exception:  # its worker is in the middle of a reply
                log.exception("query_not_cut_off")
        return not any(thread.is_alive() for thread in self._threads)

    def _work_on_all(self) -> None:
        self._work(self._short, self._jobs)

    def _work_on_short(self) -> None:
        self._work(self._short)

    def _work(self, *queues: collections.deque[QueryJob]) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or any(queues))
                if self._closed:
                    return
                job = next(queue for queue in queues if queue).popleft()
                self._n_bytes -= job.n_bytes
                self._working.add(job)
            try:
                job.answer(job.arrived_s)
            finally:
                with self._changed:
                    self._working.discard(job)
