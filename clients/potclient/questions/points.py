"""`q/points`: occupancy at points, in as many questions as the server's limits need."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.arguments import as_points
from potclient.errors import OverloadedError, TooManyError
from potclient.link import Link
from potclient.occupancy import Occupancy
from potclient.questions import info
from potschemas import messages
from potschemas.wire import encode_array

_CHUNK_POINTS = 100_000  # points a question at most, whatever the server would take
_SPLIT_ABOVE = 20_000  # up to here one question is sent without asking for the server's limits
_IN_FLIGHT = 4
_RETRIES = 8
_BYTES_AROUND = 1024  # of a message, beside its points


class _Wanted(NamedTuple):
    gradient: bool
    evidence_only: bool


class PointsQuestion:
    """Asks at points, and remembers the server's limits."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self.limits: messages.Limits | None = None  # None: not asked for yet

    def occupancy(
        self, points: ArrayLike, *, with_gradient: bool, evidence_only: bool, timeout_s: float | None
    ) -> Occupancy:
        """See `MapClient.occupancy`."""
        dtype = np.float32 if getattr(points, "dtype", None) == np.float32 else np.float64
        queries = np.ascontiguousarray(as_points(points), dtype)
        if len(queries) == 0:
            return Occupancy.empty(with_gradient=with_gradient)
        wanted = _Wanted(with_gradient, evidence_only)
        may_fit = len(queries) <= _SPLIT_ABOVE and self.limits is None
        step = len(queries) if may_fit else self._points_a_question(queries.itemsize * 3)
        chunks = [queries[i : i + step] for i in range(0, len(queries), step)]
        if len(chunks) == 1:
            reply = next(self._ask(queries, wanted, timeout_s))
            return Occupancy.from_message(reply, len(queries), with_gradient=with_gradient)
        return Occupancy.concatenate(list(self._of_chunks(chunks, wanted, timeout_s)))

    def _of_chunks(
        self, chunks: list[NDArray[Any]], wanted: _Wanted, timeout_s: float | None
    ) -> Iterator[Occupancy]:
        timeout_s = _IN_FLIGHT * (self._link.timeout_s if timeout_s is None else timeout_s)
        asked: deque[tuple[NDArray[Any], Iterator[messages.Occupancy]]] = deque()
        waiting = deque(chunks)
        while waiting or asked:
            while waiting and len(asked) < _IN_FLIGHT:
                chunk = waiting.popleft()
                asked.append((chunk, self._ask(chunk, wanted, timeout_s)))
            chunk, replies = asked.popleft()
            for attempt in range(_RETRIES + 1):
                try:
                    yield Occupancy.from_message(next(replies), len(chunk), with_gradient=wanted.gradient)
                    break
                except (OverloadedError, TooManyError) as error:
                    if attempt == _RETRIES:
                        raise
                    time.sleep(error.retry_after_s or 0.1)
                    replies = self._ask(chunk, wanted, timeout_s)

    def _ask(
        self, chunk: NDArray[Any], wanted: _Wanted, timeout_s: float | None
    ) -> Iterator[messages.Occupancy]:
        request = messages.PointsQuery(
            points=encode_array(chunk),
            deadline_ms=self._link.deadline_ms(timeout_s),
            with_gradient=True if wanted.gradient else messages.ABSENT,
            evidence_only=True if wanted.evidence_only else messages.ABSENT,
        )
        return self._link.stream(self._link.keys.query("points"), request, messages.Occupancy, timeout_s)

    def _points_a_question(self, bytes_a_point: int) -> int:
        if self.limits is None:
            self.limits = info.info(self._link).limits
        by_bytes = max(1, (self.limits.max_query_bytes - _BYTES_AROUND) // bytes_a_point)
        return max(1, min(self.limits.max_query_points, by_bytes, _CHUNK_POINTS))
