"""Declared queryables: how queries are taken, answered and refused, the same for all.

A queryable is complete on its key expression, so that Zenoh asks one server and not all. Its thread only admits; workers
or the map's writer answer. Replies take the quality of service of their query, so the asker sets the lane.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import zenoh

from potschemas import keys
from potserver.adapters.audit import Audit
from potserver.adapters.key_exprs import last_chunk
from potserver.adapters.query_pool import QueryJob, QueryPool
from potserver.adapters.questions.question import Asked, Question, Served
from potserver.adapters.replies import BUG, INTEGRATE, asker_of, check_query, payload_of, reply, reply_error
from potserver.codec.base import decode, encode
from potserver.errors import DeadlineError, PotserverError, ShuttingDownError, UnsupportedError
from potserver.log import get_logger

log = get_logger("potserver.queries")

_BACKLOG = 64  # queries between Zenoh and our admission; admission takes microseconds


class Queryable(ABC):
    """One declared key expression, and the thread's work that admits its queries.

    Args:
        session: Where it is declared.
        key_expr: What it answers.
        backlog: Queries between Zenoh and our admission.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, *, backlog: int = 4) -> None:
        self._queryable = session.declare_queryable(
            key_expr, zenoh.handlers.FifoChannel(backlog), complete=True
        )

    def run(self) -> None:
        """Admit queries until undeclared, on a thread of our own."""
        for query in self._queryable:
            try:
                self.admit(query)
            except PotserverError as error:
                self.refuse(query, error)
            except Exception:
                log.exception("query_admission_failed", key=str(query.key_expr))
                self.refuse(query, PotserverError(BUG))

    def undeclare(self) -> None:
        """Take no more; ends `run`."""
        self._queryable.undeclare()

    @abstractmethod
    def admit(self, query: zenoh.Query) -> None:
        """Begin to answer a query, without blocking; what this raises is sent by `refuse`."""

    @abstractmethod
    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        """End a query with an error; from any thread."""


class MapQueryable(Queryable):
    """All `q/<op>` of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        questions: Sequence[Question[Any]],
        integrate: Callable[[zenoh.Query], None],
        served: Served,
        pool: QueryPool,
    ) -> None:
        """Declare it.

        Args:
            session, map_keys: Where.
            questions: Which kinds of questions there are.
            integrate: Takes the clouds of `q/integrate`, which the map's writer answers.
            served: What the questions are about.
            pool: Whose workers answer.
        """
        self._keys, self._served, self._pool = map_keys, served, pool
        self._questions, self._integrate = {question.op: question for question in questions}, integrate
        self._ops = (INTEGRATE, *self._questions)
        self._audit = Audit(map_keys.map_id)
        super().__init__(session, map_keys.query("*"), backlog=_BACKLOG)

    def admit(self, query: zenoh.Query) -> None:
        """Queue a query for a worker; a cloud goes to the writer."""
        self._served.health.count("queries.received")
        op = last_chunk(query.key_expr)
        if op == INTEGRATE:
            self._integrate(query)
            return
        question = self._questions.get(op)
        if question is None:
            raise UnsupportedError(f"no operation {op!r}; ask for one of {', '.join(self._ops)}")
        n_bytes = check_query(query, question.query, self._served.limits.max_query_bytes, f"{op} query")
        self._pool.submit(
            QueryJob(
                answer=lambda arrived_s: self._answer(query, question, arrived_s),
                refuse=lambda error: self.refuse(query, error),
                n_bytes=n_bytes,
                is_short=question.is_short,
            )
        )

    def _answer(self, query: zenoh.Query, question: Question[Any], arrived_s: float) -> None:
        """On a worker thread."""
        key, health = self._keys.query(question.op), self._served.health
        try:
            # hostile numbers may overflow; the checks see the infinity, the log needs no warning
            with query, np.errstate(over="ignore"):  # `with query` ends the replies on every path
                try:
                    self._reply(query, question, key, arrived_s)
                    health.count(f"queries.{question.op}.ok")
                    health.observe(question.op, (time.monotonic() - arrived_s) * 1e3)
                except PotserverError as error:  # expected: the asker gets a typed reply
                    self._reply_error(query, error)
                except Exception:  # a bug: the traceback stays here
                    if self._pool.is_closing:  # the pool has cut the query off
                        return
                    log.exception("query_failed", key=key)
                    self._reply_error(query, PotserverError(BUG))
        except Exception:
            log.exception("query_reply_failed", key=key)

    def _reply(self, query: zenoh.Query, question: Question[Any], key: str, arrived_s: float) -> None:
        """Decode, answer, and send the replies, as long as somebody waits for them."""
        limits = self._served.limits
        message = decode(payload_of(query), question.query, question.max_bytes or limits.max_query_bytes)
        deadline_ms: float | None = getattr(message, "deadline_ms", None)

        def check_may_go_on() -> None:
            check_deadline(arrived_s, deadline_ms)
            if self._pool.is_closing:
                raise ShuttingDownError("the server is closing")

        check_deadline(arrived_s, deadline_ms)
        asked = Asked(self._served, self._served.mapper.state, check_may_go_on)
        for part in question.answer(asked, message):
            reply(query, key, encode(part))

    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        """Count and send what is wrong, at once."""
        with query:
            self._reply_error(query, error)

    def _reply_error(self, query: zenoh.Query, error: PotserverError) -> None:
        chunk = last_chunk(query.key_expr)
        op = chunk if chunk in self._ops else "unknown"
        self._served.health.count(f"queries.{op}.{error.code}")
        self._audit.refused(f"q/{op}", asker_of(query), error)
        reply_error(query, error)


def check_deadline(arrived_s: float, deadline_ms: float | None) -> None:
    """Refuse to work for an asker that waits no longer.

    Args:
        arrived_s: When the query came, of `time.monotonic`.
        deadline_ms: How long its asker waits; None = for ever.
    Raises:
        DeadlineError: it does not.
    """
    if deadline_ms is not None and (waited_ms := (time.monotonic() - arrived_s) * 1e3) > deadline_ms:
        raise DeadlineError(f"{waited_ms:.1f} ms since the query came, its deadline was {deadline_ms:.1f} ms")
