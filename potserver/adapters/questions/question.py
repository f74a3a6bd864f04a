"""What every kind of question says of itself, and what its answer may look at."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

from potschemas import messages
from potserver.asking.plan import Plan
from potserver.atoms.store import AtomStore
from potserver.domain.kernel_map import KernelMap
from potserver.domain.map_state import MapState
from potserver.health import Health
from potserver.limits import Limits
from potserver.mapping.service import MappingService

PartT = TypeVar("PartT")
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
    limits: Limits
    durable: bool  # accepted clouds survive a crash


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """One question in work. Whatever its answer says of the map is of `state`, which was read once."""

    served: Served
    state: MapState
    check_may_go_on: Callable[[], None]  # raises when the asker or the server waits no longer

    @property
    def snapshot(self) -> KernelMap:
        """What answers are computed from."""
        return self.state.snapshot

    @property
    def limits(self) -> Limits:
        """What the question is checked against."""
        return self.served.limits

    def parts(self, plan: Plan[PartT]) -> Iterator[PartT]:
        """The parts of a plan, as long as the answer may go on.

        Raises:
            DeadlineError: the asker waits no longer. ShuttingDownError: nor does the server.
        """
        for i in range(plan.n_parts):
            self.check_may_go_on()
            yield plan.part(i)


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Question(Generic[QueryT]):
    """One kind of question, `q/<op>`."""

    op: str
    query: type[QueryT]  # the message that asks; its `deadline_ms`, if it has one, is kept
    answer: Callable[[Asked, QueryT], Iterator[messages.Message]]  # yields the replies
    is_short: bool = False  # microseconds of work: answered past long questions that wait
    max_bytes: int | None = None  # of the query; None = `Limits.max_query_bytes`
    warm_up: Callable[[KernelMap], object] | None = None  # compiles what the answer uses, on a small map
