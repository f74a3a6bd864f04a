"""Sending off the mapper's thread: a slow receiver may stall this queue, never the map."""

from __future__ import annotations

import collections
import enum
import threading
import time
from collections.abc import Callable

from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.outbox")

Task = Callable[[], None]


class End(enum.Enum):
    """How a task ended."""

    SENT = "sent"
    FAILED = "failed"
    ABANDONED = "abandoned"  # the outbox was closed first


Ended = Callable[[End], None]


class Outbox:
    """A bounded queue of things to send, and the thread that sends them.

    A put to a receiver that stopped reading blocks for up to five seconds, then Zenoh closes its transport;
    that wait happens here.

    Args:
        name: Of the thread.
        max_pending: `post` waits, and `offer` declines, once this many tasks wait.
        max_pending_bytes: Likewise for the bytes that tasks declare.
    """

    def __init__(self, name: str, *, max_pending: int, max_pending_bytes: int) -> None:
        self._name = name
        self._max_pending, self._max_bytes = max_pending, max_pending_bytes
        self._changed = threading.Condition()
        self._tasks: collections.deque[tuple[Task, int, Ended | None]] = collections.deque()
        self._n_bytes = 0
        self._busy = self._closed = False
        self._thread = spawn(name, self._run)

    @property
    def depth(self) -> int:
        """Tasks waiting."""
        with self._changed:
            return len(self._tasks)

    @property
    def n_bytes(self) -> int:
        """What the tasks waiting and the one in work declared."""
        with self._changed:
            return self._n_bytes

    def post(self, task: Task, n_bytes: int = 0, *, ended: Ended | None = None) -> None:
        """Queue what must be sent; waits while the queue is full, which slows down whoever causes it."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or not self._is_full())
            self._append(task, n_bytes, ended)

    def post_now(self, task: Task, n_bytes: int = 0, *, ended: Ended | None = None) -> None:
        """Queue what must be sent, even beyond the bound: for callers whose rate is bounded, like the mapper."""
        with self._changed:
            self._append(task, n_bytes, ended)

    def offer(self, task: Task, n_bytes: int = 0) -> bool:
        """Queue what may be dropped; False if the queue is full, for the caller to count."""
        with self._changed:
            if self._closed or self._is_full():
                return False
            self._append(task, n_bytes)
            return True

    def close(self, timeout_s: float) -> bool:
        """Send what waits, then end the thread; False if that took too long."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            emptied = self._changed.wait_for(lambda: not (self._tasks or self._busy), timeout_s)
            self._closed = True
            for _, _, ended in self._tasks:  # nobody will send them
                _tell(ended, End.ABANDONED)
            self._tasks.clear()
            self._changed.notify_all()
        self._thread.join(max(0.0, deadline - time.monotonic()))
        return emptied

    def _is_full(self) -> bool:
        return len(self._tasks) >= self._max_pending or self._n_bytes >= self._max_bytes

    def _append(self, task: Task, n_bytes: int, ended: Ended | None = None) -> None:
        if self._closed:
            _tell(ended, End.ABANDONED)
            return
        self._tasks.append((task, n_bytes, ended))
        self._n_bytes += n_bytes
        self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._tasks or self._closed)
                if self._closed:
                    return
                task, n_bytes, ended = self._tasks.popleft()
                self._busy = True
            try:
                task()
                _tell(ended, End.SENT)
            except Exception:
                log.exception("send_failed", outbox=self._name)
                _tell(ended, End.FAILED)
            finally:
                with self._changed:
                    self._busy = False
                    self._n_bytes -= n_bytes
                    self._changed.notify_all()


def _tell(ended: Ended | None, end: End) -> None:
    if ended is not None:
        ended(end)
