"""Declared queryables: how queries are taken, answered and refused, the same for all.

A queryable is complete on its key expression, so that Zenoh asks one server and not all. Its thread only admits; workers
or the map's writer answer. Replies take the quality of service of their query, so the asker sets the lane.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import zenoh

from potschemas import keys
from potserver.adapters.answers import Answers
from potserver.adapters.key_exprs import last_chunk
from potserver.adapters.questions.question import Question
from potserver.adapters.replies import BUG
from potserver.errors import PotserverError, UnsupportedError
from potserver.health import Health
from potserver.log import get_logger

log = get_logger("potserver.queries")

_BACKLOG = 64  # queries between Zenoh and our admission; admission takes microseconds
_MOVED = {"integrate": "send the cloud to in/<robot>/integrate, so that its key says who sends"}


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
    """All `q/<op>` of one map: what only reads it."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        questions: Sequence[Question[Any]],
        answers: Answers,
        health: Health,
    ) -> None:
        """Declare it.

        Args:
            session, map_keys: Where.
            questions: Which kinds of questions there are.
            answers: Them.
            health: Gets counts.
        """
        self._keys, self._answers, self._health = map_keys, answers, health
        self._questions = {question.op: question for question in questions}
        super().__init__(session, map_keys.query("*"), backlog=_BACKLOG)

    def admit(self, query: zenoh.Query) -> None:
        """Queue a query for a worker."""
        self._health.count("queries.received")
        op = last_chunk(query.key_expr)
        if op in _MOVED:
            raise UnsupportedError(f"q/{op} has moved: {_MOVED[op]}")
        if op not in self._questions:
            raise UnsupportedError(f"no operation {op!r}; ask for one of {', '.join(self._questions)}")
        self._answers.submit(query, self._questions[op], self._keys.query(op), f"queries.{op}")

    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        """Count and send what is wrong, at once."""
        op = last_chunk(query.key_expr)
        self._answers.refuse(query, error, f"queries.{op if op in self._questions else 'unknown'}")
