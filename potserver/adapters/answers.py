"""From a query to its replies, on the workers of the pool: the same for all questions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import zenoh

from potserver.adapters.query_pool import QueryJob, QueryPool
from potserver.adapters.questions.question import Asked, Question, Served
from potserver.adapters.replies import asker_of, check_query, failure, payload_of, reply, reply_error
from potserver.codec.base import decode, encode
from potserver.errors import DeadlineError, PotserverError, ShuttingDownError
from potserver.log import get_logger

log = get_logger("potserver.queries")

DEADLINE_S = 10.0  # that an asker waits who does not say: Zenoh's own time-out of a query
SHORT_BYTES = 65_536  # of a question that may be a short one: 2,700 points


class Answers:
    """Answers the questions about one map.

    Args:
        served: The map.
        pool: Whose workers answer.
    """

    def __init__(self, served: Served, pool: QueryPool) -> None:
        self._served, self._pool = served, pool

    def submit(self, query: zenoh.Query, question: Question[Any], key: str, name: str) -> None:
        """Queue a query for a worker.

        Args:
            query: As it came.
            question: Which kind it is.
            key: What it is answered on.
            name: What it is counted as, e.g. `queries.points`.
        Raises:
            TooLargeError, BadMessageError: by its size or its encoding.
            OverloadedError, ShuttingDownError: the pool does not take it.
        """
        arrived_s = time.monotonic()
        n_bytes = check_query(
            query, question.query, self._served.limits.max_query_bytes, f"{question.op} query"
        )
        self._pool.submit(
            QueryJob(
                steps=self._steps(query, question, key, name, arrived_s),
                refuse=lambda error: self.refuse(query, error, name),
                abandon=lambda: self._abandon(query, name),
                asker=asker_of(query),
                n_bytes=n_bytes,
                is_short=question.is_quick and n_bytes <= SHORT_BYTES,
            )
        )

    def refuse(self, query: zenoh.Query, error: PotserverError, name: str) -> None:
        """Count and send what is wrong, at once; ends the query."""
        self._served.health.count(f"{name}.{error.code}")
        self._served.audit.refused(name, asker_of(query), error)
        with query:
            reply_error(query, error)

    def _abandon(self, query: zenoh.Query, name: str) -> None:
        self._served.health.count(f"{name}.asker_gone")
        query.drop()

    def _steps(
        self, query: zenoh.Query, question: Question[Any], key: str, name: str, arrived_s: float
    ) -> Iterator[bool]:
        """Decode, answer, send, and end the query, as long as somebody waits for it; on worker threads."""
        try:
            for step in question.steps(*self._ask(query, question, arrived_s)):
                if question.reads_tiles:
                    self._served.check_readable()
                if step.reply is not None:
                    wire = encode(step.reply)
                    reply(query, key, wire)
                if step.rest_is_short is not None:
                    yield step.rest_is_short
            self._served.health.count(
                f"{name}.ok"
            )  # before the end, so that who has the answer sees it counted
            self._served.health.observe(question.op, (time.monotonic() - arrived_s) * 1e3)
            query.drop()
        except Exception as error:  # the asker gets a typed reply; the traceback of a bug stays here
            if self._pool.is_closing and not isinstance(
                error, PotserverError
            ):  # the pool has cut the query off
                return
            self.refuse(
                query, failure(error, self._served.check_readable, log, "query_failed", key=key), name
            )

    def _ask(self, query: zenoh.Query, question: Question[Any], arrived_s: float) -> tuple[Asked, Any]:
        max_bytes = question.max_bytes or self._served.limits.max_query_bytes
        message = decode(payload_of(query), question.query, max_bytes)
        deadline_ms: float | None = getattr(message, "deadline_ms", None)

        def check_may_go_on() -> None:
            check_deadline(arrived_s, DEADLINE_S * 1e3 if deadline_ms is None else deadline_ms)
            if self._pool.is_closing:
                raise ShuttingDownError("the server is closing")

        check_may_go_on()
        return Asked(self._served, self._served.mapper.state, asker_of(query), check_may_go_on), message


def check_deadline(arrived_s: float, deadline_ms: float) -> None:
    """Refuse to work for an asker that waits no longer.

    Args:
        arrived_s: When the query came, of `time.monotonic`.
        deadline_ms: How long its asker waits.
    Raises:
        DeadlineError: it does not.
    """
    if (waited_ms := (time.monotonic() - arrived_s) * 1e3) > deadline_ms:
        raise DeadlineError(f"{waited_ms:.1f} ms since the query came, its deadline was {deadline_ms:.1f} ms")
