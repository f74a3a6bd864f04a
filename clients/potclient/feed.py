"""The robot's way in: a slot for the newest cloud, a credit of unacknowledged ones, and a count for every fate.

Zenoh's put never fails and never tells: a cloud to a dead server, a denied key or a full queue is simply gone. And kernel
socket buffers hold some 8 MB of stale clouds, so that a map fed without limits lags behind by half a second. Hence receipts: at
most `credit` clouds are on their way, the newest one waits in a slot, and what it replaces is dropped here and counted. After
a cloud that the server had to drop the feed pauses, longer each time, up to a second.
"""

from __future__ import annotations

import dataclasses
import logging
import secrets
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator

import msgspec

from potclient.errors import ClosedError, QueryTimeoutError, UsageError
from potclient.results import FeedCounts, Receipt, TransportedParams
from potschemas import messages
from potschemas.messages import ReceiptStatus

log = logging.getLogger("potclient")

_MATCH_POLL_S = 0.02  # only while a cloud waits and no server listens
_BACKOFF_S = (0.05, 1.0)  # after a cloud that the server dropped: first, longest
_MAX_EXPIRED = 4096  # clouds whose receipt may still come late
_MAX_RECEIPTS = 4096  # receipts kept for the iterator


@dataclasses.dataclass(frozen=True, slots=True, kw_only=True)
class FeedOptions:
    """How a client publishes clouds."""

    credit: int = 2  # published clouds of a robot that may be without a receipt
    receipt_timeout_s: float = 10.0  # after this long without a receipt a cloud counts as unknown
    # Called with every receipt of a published cloud, on a thread of the client's: keep it short, the next credit waits for it.
    on_receipt: Callable[[Receipt], None] | None = None
    # Called with the parameters of published clouds; a slow callback misses some: their numbers jump.
    on_params: Callable[[TransportedParams], None] | None = None
    # Which kernels published clouds ask for: "fitted", "transported" or "none". None: fitted ones where there is `on_params`,
    # else they are computed if somebody listens.
    params: str | None = None

    def __post_init__(self) -> None:
        if self.receipt_timeout_s <= 0 or self.credit < 1:
            raise UsageError("receipt_timeout_s must be positive, credit at least 1")


def first_number() -> int:
    """Where a process starts to number, so that two with one robot id, or one and its restart, do not share numbers.

    Microseconds of the clock and up to 17 s at random: exact in a JSON number, and far below the wire's 2**63.
    """
    return time.time_ns() // 1000 + secrets.randbits(24)


class Numbering:
    """The numbers of one robot's clouds, which only ever grow, and their stamps.

    Args:
        first: The first number; None takes one that no other process has.
    """

    def __init__(self, first: int | None = None) -> None:
        self._lock = threading.Lock()
        self._seq = (first_number() if first is None else first) - 1

    def assign(self, seq: int | None, stamp_ns: int | None) -> tuple[int, int]:
        """The number and stamp to send, chosen where they are None: the next number, the clock."""
        with self._lock:
            chosen_seq = self._seq + 1 if seq is None else seq
            self._seq = max(self._seq, chosen_seq)
            return chosen_seq, time.time_ns() if stamp_ns is None else stamp_ns


class _Sent:
    __slots__ = ("deadline", "started")

    def __init__(self, started: float) -> None:
        self.started = started
        self.deadline: float | None = None  # none while the put is still running


class Feed:
    """One robot's clouds, from `offer` to a receipt.

    Args:
        put: Gives a cloud to the network; may block; runs on the feed's own thread.
        is_matched: Whether somebody takes this robot's clouds now; while nobody does, the newest cloud waits in the slot.
        credit: How many clouds may be without a receipt.
        receipt_timeout_s: After this long without a receipt a cloud counts as unknown and its credit returns.
        explain: The likely cause of clouds coming to nothing, for people.
        clock: Monotonic seconds.
    """

    def __init__(
        self,
        robot: str,
        put: Callable[[messages.Cloud], None],
        *,
        numbering: Numbering,
        is_matched: Callable[[], bool],
        credit: int,
        receipt_timeout_s: float,
        explain: Callable[[], str] = lambda: "no server takes clouds of this robot",
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.robot = robot
        self._put, self._is_matched, self._explain, self._clock = put, is_matched, explain, clock
        self._numbering = numbering
        self._credit, self._receipt_timeout_s = credit, receipt_timeout_s
        self._changed = threading.Condition()
        self._slot: messages.Cloud | None = None
        self._slot_is_kept = False  # a caller waits for this one: a newer cloud must not replace it
        self._in_flight: OrderedDict[int, _Sent] = OrderedDict()
        self._expired: OrderedDict[int, _Sent] = OrderedDict()
        self._receipts: deque[Receipt] = deque(maxlen=_MAX_RECEIPTS)
        self._offered = self._sent = self._dropped_by_client = self._unknown = 0
        self._outcomes = dict.fromkeys(ReceiptStatus, 0)
        self.stray_receipts = 0  # for clouds that this feed did not send: another process uses the robot's id
        self._backoff_s = 0.0
        self._not_before = float("-inf")
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"potclient-feed-{robot}", daemon=True)
        self._thread.start()

    # --- the robot's side ----------------------------------------------------------------------------------------------------

    def offer(
        self,
        cloud: messages.Cloud,
        *,
        seq: int | None = None,
        stamp_ns: int | None = None,
        wait: bool = False,
        timeout_s: float | None = None,
    ) -> int:
        """Put a cloud in the slot; without `wait` this never blocks, and a cloud that still waits there is dropped.

        Returns:
            The cloud's number.
        Raises:
            UsageError: the number is in use by a cloud without a receipt.
            QueryTimeoutError: `wait`, and no credit came in time; the cloud is not on its way (counted as dropped here if it
                reached the slot).
            ClosedError: the client is closed.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        with self._changed:
            if wait:
                self._wait_for(lambda: self._slot is None, until, "no credit for another cloud")
            if self._closing:
                raise ClosedError("the client is closed")
            if seq is not None and (
                seq in self._in_flight or (self._slot is not None and self._slot.seq == seq)
            ):
                raise UsageError(f"cloud {seq} of {self.robot} has no receipt yet; numbers must differ")
            seq, stamp_ns = self._numbering.assign(seq, stamp_ns)
            cloud = msgspec.structs.replace(cloud, seq=seq, stamp_ns=stamp_ns)
            self._offered += 1
            if self._slot is not None:
                self._dropped_by_client += 1
                if self._slot_is_kept:
                    return seq
            self._slot, self._slot_is_kept = cloud, wait
            self._changed.notify_all()
            if wait:
                try:
                    self._wait_for(lambda: self._slot is not cloud, until, "no credit for this cloud")
                except (QueryTimeoutError, KeyboardInterrupt):
                    if self._slot is cloud:
                        self._slot = None
                        self._dropped_by_client += 1
                        self._changed.notify_all()
                    raise
                if self._is_closing() and seq not in self._in_flight and seq not in self._expired:
                    raise ClosedError("the client was closed before this cloud was sent")
            return seq

    def flush(self, timeout_s: float | None = None, *, late: bool = False) -> bool:
        """Wait until every cloud has its outcome, with `late` another one than unknown; false if the time ran out."""
        with self._changed:
            return self._changed.wait_for(
                lambda: self._is_idle() and (self._closing or not late or not self._expired), timeout_s
            )

    def receipts(self, timeout_s: float | None = None) -> Iterator[Receipt]:
        """Receipts as they come; ends when every cloud has its outcome.

        Raises:
            QueryTimeoutError: none came for `timeout_s` while clouds are on their way.
        """
        while True:
            with self._changed:
                if not self._changed.wait_for(lambda: self._receipts or self._is_idle(), timeout_s):
                    raise QueryTimeoutError(f"no receipt of {self.robot} for {timeout_s:g} s")
                if not self._receipts:
                    return
                receipt = self._receipts.popleft()
            yield receipt

    @property
    def counts(self) -> FeedCounts:
        """Where all clouds are, at one instant."""
        with self._changed:
            return FeedCounts(
                offered=self._offered,
                waiting=int(self._slot is not None),
                in_flight=len(self._in_flight),
                sent=self._sent,
                dropped_by_client=self._dropped_by_client,
                accepted=self._outcomes[ReceiptStatus.ACCEPTED],
                dropped=self._outcomes[ReceiptStatus.DROPPED],
                rejected=self._outcomes[ReceiptStatus.REJECTED],
                unknown=self._unknown,
            )

    def close(self, timeout_s: float = 6.0) -> None:
        """Stop sending. What waits counts as dropped here, what is on its way as unknown."""
        with self._changed:
            if not self._closing:
                self._closing = True
                if self._slot is not None:
                    self._slot = None
                    self._dropped_by_client += 1
                self._changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)
        with self._changed:
            self._unknown += len(self._in_flight)
            self._expired.update(self._in_flight)
            self._in_flight.clear()
            self._changed.notify_all()

    # --- the network's side --------------------------------------------------------------------------------------------------

    def settle(self, message: messages.Receipt) -> Receipt | None:
        """Book a receipt; None if the cloud is not ours. A late one takes its cloud back from `unknown`."""
        with self._changed:
            sent = self._in_flight.pop(message.seq, None)
            if sent is None:
                sent = self._expired.pop(message.seq, None)
                if sent is None:
                    self.stray_receipts += 1
                    return None
                self._unknown -= 1
            now = self._clock()
            receipt = Receipt(message, round_trip_s=now - sent.started)
            if message.status is ReceiptStatus.DROPPED:
                # an overloaded server answers at once: do not flood it
                first_s, longest_s = _BACKOFF_S
                self._backoff_s = min(max(first_s, 2.0 * self._backoff_s), longest_s)
                self._not_before = now + self._backoff_s
            else:
                self._backoff_s = 0.0
            self._outcomes[message.status] += 1
            self._receipts.append(receipt)
            self._changed.notify_all()
            return receipt

    def wake(self) -> None:
        """Look at the clock and at the matching status again, now."""
        with self._changed:
            self._changed.notify_all()

    # --- the feed's own thread -----------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (cloud := self._next()) is not None:
            try:
                self._put(cloud)
            except Exception:
                # the session is closed, or the cloud cannot be encoded: it certainly was not sent
                with self._changed:
                    if self._in_flight.pop(cloud.seq, None) is not None:
                        self._sent -= 1
                        self._dropped_by_client += 1
                    self._changed.notify_all()
                continue
            with self._changed:
                sent = self._in_flight.get(cloud.seq)
                if sent is not None:  # its receipt has not come yet
                    sent.deadline = self._clock() + self._receipt_timeout_s

    def _next(self) -> messages.Cloud | None:
        """The next cloud to send, taken from the slot when there is credit and a taker; None at the end."""
        with self._changed:
            while not self._closing:
                now = self._clock()
                self._expire(now)
                has_credit = len(self._in_flight) < self._credit and now >= self._not_before
                if self._slot is not None and has_credit and self._is_matched():
                    cloud, self._slot = self._slot, None
                    self._in_flight[cloud.seq] = _Sent(now)
                    self._sent += 1
                    self._changed.notify_all()
                    return cloud
                deadlines = [s.deadline - now for s in self._in_flight.values() if s.deadline is not None]
                if self._slot is not None and has_credit:
                    deadlines.append(_MATCH_POLL_S)
                elif self._slot is not None and now < self._not_before:
                    deadlines.append(self._not_before - now)
                self._changed.wait(min(deadlines) if deadlines else None)
            return None

    def _expire(self, now: float) -> None:
        late = [seq for seq, s in self._in_flight.items() if s.deadline is not None and s.deadline <= now]
        for seq in late:
            self._expired[seq] = self._in_flight.pop(seq)
            self._unknown += 1
            self._changed.notify_all()
            if self._unknown == 1 and not any(self._outcomes.values()):  # once, and only if none ever came
                log.warning("no receipt for cloud %d of %s: %s", seq, self.robot, self._explain())
        while len(self._expired) > _MAX_EXPIRED:
            self._expired.popitem(last=False)

    def _is_closing(self) -> bool:
        return self._closing

    def _is_idle(self) -> bool:
        return self._closing or (self._slot is None and not self._in_flight)

    def _wait_for(self, condition: Callable[[], bool], until: float | None, what: str) -> None:
        remaining = None if until is None else until - time.monotonic()
        if not self._changed.wait_for(lambda: condition() or self._closing, remaining):
            raise QueryTimeoutError(f"{what} of {self.robot}: {self._explain()}")
