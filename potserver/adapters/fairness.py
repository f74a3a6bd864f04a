"""Who makes room in a full queue: the newest of whoever holds most of what is short. And who asks too often."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, TypeVar

from potserver.errors import TooManyError


class Waiting(Protocol):
    """Something that takes a place and some bytes."""

    @property
    def lane(self) -> str: ...  # whose it is: what fairness is between
    @property
    def n_bytes(self) -> int: ...


_BURST_S = 1.0
_MOST_LANES = 4096  # that are remembered though they came long ago

WaitingT = TypeVar("WaitingT", bound=Waiting)


class Rates:
    """How often each lane comes: on average over a second not more than it may. One caller at a time.

    Args:
        most_hz: Of one lane.
        clock: Seconds.
    """

    def __init__(self, most_hz: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._most_hz, self._clock = most_hz, clock
        self._due_s: dict[str, float] = {}  # when a lane would come next if it kept an even pace

    def check(self, lane: str) -> None:
        """Count one more.

        Raises:
            TooManyError: it comes too early, and is not counted.
        """
        now_s = self._clock()
        due_s = max(self._due_s.get(lane, now_s), now_s) + 1.0 / self._most_hz
        early_s = due_s - now_s - max(_BURST_S, 1.0 / self._most_hz)  # one is always taken
        if early_s > 0.0:
            raise TooManyError(
                f"more than {self._most_hz:g} questions a second from this client (queries.max_rate_hz)",
                retry_after_s=early_s,
            )
        self._due_s[lane] = due_s
        if len(self._due_s) > _MOST_LANES:
            self._due_s = {lane: due_s for lane, due_s in self._due_s.items() if due_s > now_s}


class Bounds(NamedTuple):
    """Of a queue."""

    max_queued: int
    max_bytes: int


def make_room(
    newcomer: WaitingT,
    bounds: Bounds,
    counts: Counter[str],
    sizes: Counter[str],
    newest_first: Callable[[str], Iterator[WaitingT]],
) -> list[WaitingT] | None:
    """Whose places the newcomer may have; None if it should not, or would still not fit.

    Args:
        newcomer: Wants to wait.
        bounds: Of the queue.
        counts, sizes: Places and bytes that each lane holds.
        newest_first: What of a lane may lose its place.
    Returns:
        The newest of the lanes that hold most, places or bytes, as far as the newcomer's lane will then hold at most as much.
    """
    counts, sizes = counts.copy(), sizes.copy()
    newest: dict[str, Iterator[WaitingT]] = {}
    victims: list[WaitingT] = []
    while True:
        lacks_bytes = sizes.total() + newcomer.n_bytes > bounds.max_bytes
        if not lacks_bytes and counts.total() + 1 <= bounds.max_queued:
            return victims
        held, wanted = (sizes, newcomer.n_bytes) if lacks_bytes else (counts, 1)
        if not held.total():
            return None
        lane = held.most_common(1)[0][0]
        victim = next(newest.setdefault(lane, newest_first(lane)), None)
        if victim is None:
            return None
        counts[lane] -= 1
        sizes[lane] -= victim.n_bytes
        if lane == newcomer.lane or held[lane] < held[newcomer.lane] + wanted:
            return None
        victims.append(victim)
