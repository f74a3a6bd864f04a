"""Clouds waiting for the mapper: bounded by count and bytes, fair between robots, in order within a robot."""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import zenoh

from potserver.adapters.fairness import Bounds, make_room
from potserver.errors import OverloadedError, PotserverError, ShuttingDownError

RETRY_AFTER_S = 0.5  # what a refused sender is advised to wait: about as long as a scan takes to map
_MAX_BARRIERS = 16


@dataclasses.dataclass(slots=True, eq=False, kw_only=True)
class CloudJob:
    """One cloud, not decoded yet."""

    robot_id: str  # from the key; it may not be a legal id
    payload: zenoh.ZBytes
    query: zenoh.Query | None = None  # `in/<robot>/integrate`: the receipt is its reply
    arrived_s: float = dataclasses.field(default_factory=time.monotonic)
    n_bytes: int = dataclasses.field(init=False)

    def __post_init__(self) -> None:
        self.n_bytes = len(self.payload)

    @property
    def lane(self) -> str:
        """What fairness is between."""
        return self.robot_id

    def wait_ms(self) -> float:
        """Time since the cloud arrived."""
        return (time.monotonic() - self.arrived_s) * 1e3


class Barrier(NamedTuple):
    """Work for the writer thread that comes after every cloud admitted before it."""

    run: Callable[[], None]
    refuse: Callable[[PotserverError], None]


class Refusal(NamedTuple):
    """A cloud that will not be mapped, and why."""

    job: CloudJob
    error: PotserverError


@dataclasses.dataclass(slots=True, eq=False)
class _Epoch:
    """Clouds between two barriers; the lane at the front is next."""

    lanes: collections.OrderedDict[str, collections.deque[CloudJob]] = dataclasses.field(
        default_factory=collections.OrderedDict
    )
    barrier: Barrier | None = None  # once all lanes are empty


class IntakeQueue:
    """Many producers that never wait, one consumer: the map's writer.

    When it is full, the newest clouds of the robot that holds most of what is short, places or bytes, make room
    for a robot that will then hold at most as much. If that is not possible or not enough, the newcomer is refused
    and nobody loses a place. Either way somebody is told at once.

    Args:
        max_queued: Clouds.
        max_queued_bytes: Bytes of all of them.
        retry_after_s: What a refused sender is advised to wait.
    """

    def __init__(
        self, *, max_queued: int, max_queued_bytes: int, retry_after_s: float = RETRY_AFTER_S
    ) -> None:
        self._bounds, self._retry_after_s = Bounds(max_queued, max_queued_bytes), retry_after_s
        self._changed = threading.Condition()
        self._epochs: collections.deque[_Epoch] = collections.deque([_Epoch()])
        self._counts: collections.Counter[str] = collections.Counter()  # clouds of each lane
        self._sizes: collections.Counter[str] = collections.Counter()  # bytes of each lane
        self._n_bytes = 0
        self._not_before: dict[str, float] = {}  # lanes whose first cloud waits for its pose, and how long
        self._busy = False
        self._admitting, self._closed = True, False

    @property
    def depth(self) -> int:
        """Clouds waiting, without the one in work."""
        with self._changed:
            return self._counts.total()

    @property
    def n_bytes(self) -> int:
        """Bytes waiting."""
        with self._changed:
            return self._n_bytes

    @property
    def n_barriers(self) -> int:
        """Barriers waiting."""
        with self._changed:
            return len(self._epochs) - 1

    @property
    def is_admitting(self) -> bool:
        """False once the map drains."""
        with self._changed:
            return self._admitting

    def admit(self, job: CloudJob) -> list[Refusal]:
        """Queue a cloud.

        Returns:
            The clouds that lost their place, perhaps this one; the caller must send their receipts.
        """
        with self._changed:
            if not self._admitting:
                return [Refusal(job, ShuttingDownError("the server takes no more clouds"))]
            victims = make_room(job, self._bounds, self._counts, self._sizes, self._newest_first)
            error = self._overloaded()
            if victims is None:
                return [Refusal(job, error)]
            for victim in victims:
                self._forget(victim)
            self._epochs[-1].lanes.setdefault(job.lane, collections.deque()).append(job)
            self._add_counts(job)
            self._changed.notify_all()
            return [Refusal(victim, error) for victim in victims]

    def admit_barrier(self, barrier: Barrier, *, is_last: bool = False) -> None:
        """Queue work that follows all clouds queued so far.

        Args:
            barrier: The work.
            is_last: Take no clouds after it.
        Raises:
            OverloadedError: too many barriers wait already.
            ShuttingDownError: the queue is closed.
        """
        with self._changed:
            if self._closed:
                raise ShuttingDownError("the server is closing")
            if len(self._epochs) > _MAX_BARRIERS:
                raise OverloadedError(
                    f"{_MAX_BARRIERS} control requests wait already", retry_after_s=self._retry_after_s
                )
            if is_last:
                self._admitting = False
            self._epochs[-1].barrier = barrier
            self._epochs.append(_Epoch())
            self._changed.notify_all()

    def take(self) -> CloudJob | Barrier | None:
        """Wait for work, robot by robot; None when the queue is closed. Call `done` after each."""
        with self._changed:
            while not self._closed:
                epoch = self._epochs[0]
                now_s = time.monotonic()
                lane = next((n for n in epoch.lanes if self._not_before.get(n, now_s) <= now_s), None)
                if lane is not None:
                    self._not_before.pop(lane, None)
                    jobs = epoch.lanes.pop(lane)
                    job = jobs.popleft()
                    if jobs:
                        epoch.lanes[lane] = jobs  # to the back: the next robot is next
                    self._drop_counts(job)
                    self._busy = True
                    return job
                if epoch.barrier is not None and not epoch.lanes:
                    self._epochs.popleft()
                    self._busy = True
                    return epoch.barrier
                soonest_s = min((self._not_before[n] for n in epoch.lanes), default=None)
                self._changed.wait(None if soonest_s is None else soonest_s - now_s)
            return None

    def put_back(self, job: CloudJob, until_s: float) -> bool:
        """A cloud that `take` gave cannot be mapped yet; its robot waits, and the others go on.

        Args:
            job: The cloud; it stays the first of its robot.
            until_s: When it is given again at the latest, of `time.monotonic`; sooner if `wake` is called.
        Returns:
            False if the queue is closed; the caller must refuse the cloud.
        """
        with self._changed:
            if self._closed:
                return False
            self._epochs[0].lanes.setdefault(job.lane, collections.deque()).appendleft(job)
            self._not_before[job.lane] = until_s
            self._add_counts(job)
            return True

    def wake(self, lane: str) -> None:
        """What the first cloud of a robot waits for is there."""
        with self._changed:
            if self._not_before.pop(lane, None) is not None:
                self._changed.notify_all()

    def done(self) -> None:
        """The work that `take` gave is finished."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()

    def stop_admitting(self) -> None:
        """Refuse all further clouds; those queued are still worked off."""
        with self._changed:
            self._admitting = False

    def wait_idle(self, timeout_s: float) -> bool:
        """Wait until nothing is queued or in work; False if that took too long."""
        with self._changed:
            return self._changed.wait_for(
                lambda: not (self._busy or self._counts.total() or len(self._epochs) > 1), timeout_s
            )

    def close(self) -> tuple[list[CloudJob], list[Barrier]]:
        """End `take`, and hand back what is left; the caller must refuse each."""
        with self._changed:
            self._admitting, self._closed = False, True
            clouds = [job for epoch in self._epochs for jobs in epoch.lanes.values() for job in jobs]
            barriers = [epoch.barrier for epoch in self._epochs if epoch.barrier is not None]
            self._epochs = collections.deque([_Epoch()])
            self._counts.clear()
            self._sizes.clear()
            self._n_bytes = 0
            self._changed.notify_all()
            return clouds, barriers

    def _overloaded(self) -> OverloadedError:
        return OverloadedError(
            f"the queue holds {self._counts.total()} clouds of {self._n_bytes} bytes;"
            f" the limits are {self._bounds.max_queued} and {self._bounds.max_bytes}",
            retry_after_s=self._retry_after_s,
        )

    def _newest_first(self, lane: str) -> Iterator[CloudJob]:
        for epoch in reversed(self._epochs):
            yield from reversed(epoch.lanes.get(lane, ()))

    def _forget(self, job: CloudJob) -> None:
        for epoch in self._epochs:
            jobs = epoch.lanes.get(job.lane)
            if jobs and job in jobs:
                jobs.remove(job)
                if not jobs:
                    del epoch.lanes[job.lane]
                break
        self._drop_counts(job)

    def _add_counts(self, job: CloudJob) -> None:
        self._counts[job.lane] += 1
        self._sizes[job.lane] += job.n_bytes
        self._n_bytes += job.n_bytes

    def _drop_counts(self, job: CloudJob) -> None:
        self._counts[job.lane] -= 1
        if not self._counts[job.lane]:
            del self._counts[job.lane]
        self._sizes[job.lane] -= job.n_bytes
        if not self._sizes[job.lane]:
            del self._sizes[job.lane]
        self._n_bytes -= job.n_bytes
