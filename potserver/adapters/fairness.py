"""Who makes room in a full queue: the newest of whoever holds most of what is short."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, TypeVar


class Waiting(Protocol):
    """Something that takes a place and some bytes."""

    @property
    def lane(self) -> str: ...  # whose it is: what fairness is between
    @property
    def n_bytes(self) -> int: ...


WaitingT = TypeVar("WaitingT", bound=Waiting)


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
