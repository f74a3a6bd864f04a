"""Questions waiting for a worker and in work: part by part, in turns between askers, bounded by count and by bytes."""

from __future__ import annotations

import collections
import dataclasses
import math
import threading
import time
from collections.abc import Callable, Iterator

from potserver.adapters.fairness import Bounds, Rates, make_room
from potserver.errors import OverloadedError, PotserverError, ShuttingDownError
from potserver.log import get_logger
from potserver.threads import spawn

log = get_logger("potserver.queries")

RETRY_AFTER_S = 0.2  # what a refused asker is advised to wait: about as long as a few parts take


@dataclasses.dataclass(slots=True, eq=False, kw_only=True)
class QueryJob:
    """One query that passed admission."""

    steps: Iterator[bool]  # each a bounded piece of work that says whether the rest is short; must not raise
    refuse: Callable[[PotserverError], None]  # ends the query with an error
    abandon: Callable[[], None]  # ends it without: nobody is there to read one
    asker: str  # its Zenoh session; empty: not said
    n_bytes: int
    is_short: bool = False  # a millisecond of work: need not wait behind grids
    is_started: bool = False
    is_abandoned: bool = False

    @property
    def lane(self) -> str:
        """What fairness is between."""
        return self.asker


@dataclasses.dataclass(slots=True, eq=False)
class _Asker:
    """One session's questions."""

    used_s: float  # worker time so far, beyond that of whoever had least when this one came
    short: collections.deque[QueryJob] = dataclasses.field(default_factory=collections.deque)
    long: collections.deque[QueryJob] = dataclasses.field(default_factory=collections.deque)
    working: set[QueryJob] = dataclasses.field(default_factory=set)

    def queue_of(self, job: QueryJob) -> collections.deque[QueryJob]:
        return self.short if job.is_short else self.long

    def waiting(self) -> list[QueryJob]:
        return [*self.short, *self.long]


class QueryPool:
    """Worker threads that answer the queries of all maps of a server, and one more for short work only.

    The next step is always one of the asker who has had least of the workers' time; a question with more to do goes back to
    the front of its asker's queue. So a short question waits for one part of a long one at most, and whoever asks for much
    gets the same share as the others. When the queue is full, the newest question of the asker with most makes room.

    Args:
        threads: Workers that take everything.
        max_queued: Queries waiting; one more is refused at once.
        max_queued_bytes: Bytes of their payloads.
        max_rate_hz: Queries a second of one asker; one that comes earlier is refused.
        retry_after_s: What a refused asker is advised to wait.
    """

    def __init__(
        self,
        *,
        threads: int,
        max_queued: int,
        max_queued_bytes: int,
        max_rate_hz: float = math.inf,
        retry_after_s: float = RETRY_AFTER_S,
    ) -> None:
        self._bounds, self._retry_after_s = Bounds(max_queued, max_queued_bytes), retry_after_s
        self._rates = Rates(max_rate_hz)
        self._changed = threading.Condition()
        self._askers: dict[str, _Asker] = {}
        self._closed = False
        self._threads = [
            *(spawn(f"query-worker-{i}", lambda: self._work(only_short=False)) for i in range(threads)),
            spawn("query-worker-short", lambda: self._work(only_short=True)),
        ]

    @property
    def depth(self) -> int:
        """Queries waiting, without those in work."""
        with self._changed:
            return self._counts().total()

    @property
    def n_bytes(self) -> int:
        """Bytes waiting."""
        with self._changed:
            return self._sizes().total()

    @property
    def is_closing(self) -> bool:
        """Long answers should end now."""
        with self._changed:
            return self._closed

    def submit(self, job: QueryJob) -> None:
        """Queue a query; others that lose their place to it are refused.

        Raises:
            OverloadedError: the queue is full. TooManyError: its asker asks too often.
            ShuttingDownError: the pool is closed.
        """
        with self._changed:
            if self._closed:
                raise ShuttingDownError("the server is closing")
            self._rates.check(job.asker)
            counts, sizes = self._counts(), self._sizes()
            error = OverloadedError(
                f"{counts.total()} queries of {sizes.total()} bytes wait already, {counts[job.asker]} of them this client's",
                retry_after_s=self._retry_after_s,
            )
            victims = make_room(job, self._bounds, counts, sizes, self._newest_first)
            if victims is None:
                raise error
            for victim in victims:
                self._askers[victim.asker].queue_of(victim).remove(victim)
                self._forget_idle(victim.asker)
            least_s = min((asker.used_s for asker in self._askers.values()), default=0.0)
            asker = self._askers.setdefault(job.asker, _Asker(least_s))
            asker.queue_of(job).append(job)
            self._changed.notify_all()
        for victim in victims:
            victim.refuse(error)

    def give_up(self, asker: str) -> int:
        """An asker is gone: its questions are not worked on any further. How many there were."""
        with self._changed:
            known = self._askers.get(asker)
            if known is None:
                return 0
            waiting = known.waiting()
            known.short.clear()
            known.long.clear()
            for job in known.working:  # their workers see it after the step they are in
                job.is_abandoned = True
            n = len(waiting) + len(known.working)
            self._forget_idle(asker)
        for job in waiting:
            job.abandon()
        return n

    def close(self, timeout_s: float) -> bool:
        """Refuse what waits and what is still in work at the end of the time, end the workers; False if one did not."""
        with self._changed:
            self._closed = True
            left = [job for asker in self._askers.values() for job in asker.waiting()]
            for asker in self._askers.values():
                asker.short.clear()
                asker.long.clear()
            self._changed.notify_all()
        for job in left:
            job.refuse(ShuttingDownError("the server is closing"))
        deadline = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline - time.monotonic()))
        with self._changed:
            cut_off = [job for asker in self._askers.values() for job in asker.working]
        for job in cut_off:
            try:
                job.refuse(ShuttingDownError("the server is closing"))
            except Exception:  # its worker is in the middle of a reply
                log.exception("query_not_cut_off")
        return not any(thread.is_alive() for thread in self._threads)

    def _work(self, *, only_short: bool) -> None:
        while (job := self._take(only_short)) is not None:
            started_s = time.perf_counter()
            rest_is_short = _step(job)
            end = self._put_back(job, rest_is_short, time.perf_counter() - started_s)
            if end is not None:
                end()

    def _take(self, only_short: bool) -> QueryJob | None:
        """Wait for the next step; None when the pool is closed."""
        with self._changed:
            while not self._closed:
                ready = [a for a in self._askers.values() if a.short or (a.long and not only_short)]
                if ready:
                    asker = min(ready, key=lambda a: a.used_s)
                    job = (asker.short or asker.long).popleft()
                    job.is_started = True
                    asker.working.add(job)
                    return job
                self._changed.wait()
            return None

    def _put_back(
        self, job: QueryJob, rest_is_short: bool | None, used_s: float
    ) -> Callable[[], None] | None:
        """Book a step; what is left to do with the job outside the lock, if it ends here unanswered."""
        with self._changed:
            asker = self._askers[job.asker]
            asker.used_s += used_s
            asker.working.discard(job)
            end: Callable[[], None] | None = None
            if rest_is_short is None:
                pass  # answered
            elif job.is_abandoned:
                end = job.abandon
            elif self._closed:
                end = lambda: job.refuse(ShuttingDownError("the server is closing"))  # noqa: E731
            else:
                job.is_short = rest_is_short
                asker.queue_of(job).appendleft(job)
                self._changed.notify_all()
            self._forget_idle(job.asker)
            return end

    def _forget_idle(self, asker: str) -> None:
        known = self._askers[asker]
        if not (known.short or known.long or known.working):
            del self._askers[asker]

    def _counts(self) -> collections.Counter[str]:
        return collections.Counter({name: len(a.waiting()) for name, a in self._askers.items()})

    def _sizes(self) -> collections.Counter[str]:
        return collections.Counter(
            {name: sum(job.n_bytes for job in a.waiting()) for name, a in self._askers.items()}
        )

    def _newest_first(self, asker: str) -> Iterator[QueryJob]:
        known = self._askers[asker]
        return (job for queue in (known.long, known.short) for job in reversed(queue) if not job.is_started)


def _step(job: QueryJob) -> bool | None:
    """Do one step; None if there are no more."""
    try:
        return next(job.steps, None)
    except Exception:  # the query was ended while it was being answered
        log.exception("query_reply_failed")
        return None
