"""What every kind of question says of itself, and what its answer may look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from potschemas import messages
from potserver.adapters.audit import Audit
from potserver.asking.plan import Plan
from potserver.asking.tile_codes import TileMemory
from potserver.atoms.store import AtomStore
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.health import Health
from potserver.limits import Limits
from potserver.mapping.service import MappingService

QueryT = TypeVar("QueryT", bound=messages.Message)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Served:
    """One map of a server, as far as questions see it."""

    server_id: str
    map_id: str
    maps: tuple[str, ...]  # of the server
    mapper: MappingService
    atoms: AtomStore
    health: Health
    audit: Audit
    limits: Limits
    durable: bool  # accepted clouds survive a crash
    check_readable: Callable[[], None] = lambda: (
        None
    )  # raises MapDamagedError: what was computed may be wrong
    tiles: TileMemory = dataclasses.field(default_factory=TileMemory)  # as they were sent to mirrors


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """One question in work. Whatever its answer says of the map is of `state`, which was read once."""

    served: Served
    state: MapState
    asker: str  # who asks, as far as the query says so
    check_may_go_on: Callable[[], None]  # raises when the asker or the server waits no longer

    @property
    def snapshot(self) -> KernelMap:
        """What answers are computed from."""
        return self.state.snapshot

    @property
    def limits(self) -> Limits:
        """What the question is checked against."""
        return self.served.limits


class Step(NamedTuple):
    """One bounded piece of the work on an answer; others may have their turn after it."""

    reply: messages.Message | None  # to be sent now
    rest_is_short: bool | None  # None: that was all


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Question(Generic[QueryT]):
    """One kind of question, `q/<op>`: its plan, and the messages that are made of the plan's parts."""

    op: str
    query: type[QueryT]  # the message that asks; its `deadline_ms`, if it has one, is kept
    plan: Callable[[Asked, QueryT], Plan[Any]]  # decodes and checks the question
    each: Callable[[Any, int, Any], messages.Message] | None = None  # (plan, number, part): a reply a part
    whole: Callable[[Any, list[Any]], messages.Message] | None = None  # (plan, parts): one reply of all parts
    is_quick: bool = True  # to plan: the worker of short questions may look whether this is one
    reads_tiles: bool = True  # which may lie on pages that the disk cannot read back
    max_bytes: int | None = None  # of the query; None = `Limits.max_query_bytes`
    warm_up: Callable[[KernelMap], object] | None = None  # compiles what the answer uses, on a small map

    def steps(self, asked: Asked, query: QueryT) -> Iterator[Step]:
        """Answer, step by step: the plan, and each of its parts.

        Raises:
            PotserverError: the question is refused, or nobody waits for it any longer.
        """
        # hostile numbers may overflow; the checks see the infinity, the log needs no warning
        with np.errstate(over="ignore"):
            plan = self.plan(asked, query)
            is_short = plan.is_short
        yield Step(None, is_short)
        parts = []
        for number in range(plan.n_parts):
            asked.check_may_go_on()
            with np.errstate(over="ignore"):
                part = plan.part(number)
                reply = None if self.each is None else self.each(plan, number, part)
            if self.whole is not None:
                parts.append(part)
            is_last = number + 1 == plan.n_parts and self.whole is None
            yield Step(reply, None if is_last else is_short)
        if self.whole is not None:
            with np.errstate(over="ignore"):
                reply = self.whole(plan, parts)
            yield Step(reply, None)


class Single(Plan[messages.Message]):
    """An answer in one piece: one message.

    Args:
        make: The work.
        is_short: Whether it takes about a millisecond.
    """

    __slots__ = ("_is_short", "_make")
    part_size = 1
    n_items = 1

    def __init__(self, make: Callable[[], messages.Message], *, is_short: bool) -> None:
        self._make, self._is_short = make, is_short

    @property
    def is_short(self) -> bool:
        """As it was said."""
        return self._is_short

    def part(self, i: int) -> messages.Message:
        """The answer."""
        return self._make()


def the_part(_plan: Plan[Any], _number: int, part: messages.Message) -> messages.Message:
    """The reply of a `Single` plan."""
    return part
