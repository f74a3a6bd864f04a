"""`ctl/<verb>` of one map. Each follows every cloud that was admitted before it; `ctl/atoms` and `ctl/learn` wait for none."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import zenoh

from potschemas import keys, messages
from potserver.adapters.answers import Answers
from potserver.adapters.intake import Barrier, IntakeQueue
from potserver.adapters.key_exprs import is_wild, last_chunk
from potserver.adapters.outbox import Outbox
from potserver.adapters.queryable import Queryable
from potserver.adapters.questions import atoms, learn
from potserver.adapters.questions.question import Question, Served
from potserver.adapters.replies import asker_of, check_query, failure, payload_of, reply, reply_error
from potserver.adapters.writer import MapWriter
from potserver.codec.base import decode, encode
from potserver.codec.clouds import decode_transform
from potserver.errors import BadMessageError, DeadlineError, PotserverError, UnsupportedError
from potserver.log import get_logger

log = get_logger("potserver.queries")

DRAIN = "drain"
_FIELDS = ("name", "robot", "T_map_saved")  # of a request, that some verbs take
Work = Callable[[], str]  # runs on the writer's thread; returns what was done, for people


@dataclasses.dataclass(frozen=True, slots=True)
class Verb:
    """What one verb takes and does."""

    work: Callable[[MapWriter, messages.ControlRequest], Work]
    needs: dict[str, str] = dataclasses.field(default_factory=dict)  # a field, and what a refusal calls it
    takes: tuple[str, ...] = ()  # fields that may be left out


def _save(writer: MapWriter, request: messages.ControlRequest) -> Work:
    name = None if request.name is messages.ABSENT else request.name
    return lambda: writer.save(name)


def _load(writer: MapWriter, request: messages.ControlRequest) -> Work:
    return lambda: writer.load(str(request.name))


def _merge(writer: MapWriter, request: messages.ControlRequest) -> Work:
    pose = np.eye(4)
    if request.T_map_saved is not messages.ABSENT:
        pose = decode_transform(request.T_map_saved, "T_map_saved")
    return lambda: writer.merge(str(request.name), pose)


def _forget(writer: MapWriter, request: messages.ControlRequest) -> Work:
    return lambda: writer.forget(str(request.robot))


def _clear(writer: MapWriter, _request: messages.ControlRequest) -> Work:
    return writer.clear


def _drain(_writer: MapWriter, _request: messages.ControlRequest) -> Work:
    return lambda: "all clouds are in the map; only a restart of the server takes clouds again"


_A_NAME = {"name": "the name of a saved map"}
VERBS = {
    "save": Verb(_save, takes=("name",)),
    "load": Verb(_load, needs=_A_NAME),
    "clear": Verb(_clear),
    DRAIN: Verb(_drain),
    "merge": Verb(_merge, needs=_A_NAME, takes=("T_map_saved",)),
    "forget": Verb(_forget, needs={"robot": "a robot; to forget everything, clear"}),
}


_OF_DICTIONARY: dict[str, Question[Any]] = {keys.CHANGE_ATOMS: atoms.CHANGE, keys.LEARN: learn.LEARN}
_ALL = (*VERBS, *_OF_DICTIONARY)


def work_of(verb: str, request: messages.ControlRequest, writer: MapWriter) -> Work:
    """What the writer's thread shall do.

    Raises:
        BadMessageError: a field is missing, or is none of the verb's. ShapeError, BadPoseError: of the transform.
    """
    needs, takes = VERBS[verb].needs, VERBS[verb].takes
    for field in _FIELDS:
        if getattr(request, field) is not messages.ABSENT and field not in needs and field not in takes:
            raise BadMessageError(f"{verb} takes no {field}")
    for field, what in needs.items():
        if getattr(request, field) is messages.ABSENT:
            raise BadMessageError(f"{verb} needs {what}")
    return VERBS[verb].work(writer, request)


class ControlQueryable(Queryable):
    """All `ctl/<verb>` of one map."""

    def __init__(
        self,
        session: zenoh.Session,
        map_keys: keys.MapKeys,
        *,
        served: Served,
        answers: Answers,
        intake: IntakeQueue,
        writer: MapWriter,
        withdraw: Callable[[], None],
        prompt: Outbox,
    ) -> None:
        """Declare it.

        Args:
            session, map_keys: Where.
            served: The map.
            answers: `ctl/atoms` and `ctl/learn`, which are about the dictionary and wait for no clouds.
            intake: Where the work waits for the clouds before it.
            writer: Whose thread does it.
            withdraw: Says that the map takes no more clouds.
            prompt: Sends the replies.
        """
        self._keys, self._served, self._answers = map_keys, served, answers
        self._intake, self._writer = intake, writer
        self._withdraw, self._prompt = withdraw, prompt
        super().__init__(session, map_keys.control("*"))

    def admit(self, query: zenoh.Query) -> None:
        """Queue the work of a verb behind the clouds before it."""
        verb = last_chunk(query.key_expr)
        if is_wild(query.key_expr):
            raise UnsupportedError(
                "control changes a map: name the map and the verb, wildcards are not taken"
            )
        if verb in _OF_DICTIONARY:
            self._answers.submit(query, _OF_DICTIONARY[verb], self._keys.control(verb), f"control.{verb}")
            return
        if verb not in VERBS:
            raise UnsupportedError(f"no verb {verb!r}; there are {', '.join(_ALL)}")
        check_query(query, messages.ControlRequest, self._served.limits.max_query_bytes, "control request")
        request = decode(payload_of(query), messages.ControlRequest)
        deadline_s = None if request.timeout_s is None else time.monotonic() + request.timeout_s
        work = work_of(verb, request, self._writer)

        def run() -> None:
            try:
                if deadline_s is not None and time.monotonic() > deadline_s:
                    raise DeadlineError(
                        f"{verb}: {request.timeout_s} s passed before the clouds ahead of it were mapped"
                    )
                message = work()
                self._served.audit.changed(f"control.{verb}", asker_of(query), result=message)
                self._done(query, verb, message)
            except Exception as error:
                check, key = self._served.check_readable, self._keys.control(verb)
                self.refuse(query, failure(error, check, log, "control_failed", key=key))

        self._intake.admit_barrier(
            Barrier(run, lambda error: self.refuse(query, error)), is_last=verb == DRAIN
        )
        if verb == DRAIN:
            self._withdraw()
            log.info("map_draining", map_id=self._keys.map_id)

    def _done(self, query: zenoh.Query, verb: str, message: str) -> None:
        answer = encode(
            messages.ControlReply(
                verb=verb, map_revision=self._served.mapper.state.map_revision, message=message
            )
        )
        self._served.health.count(f"control.{verb}.ok")

        def send() -> None:
            with query:
                reply(query, self._keys.control(verb), answer)

        self._prompt.post_now(send)

    def refuse(self, query: zenoh.Query, error: PotserverError) -> None:
        """Count what is wrong; the outbox sends it."""
        verb = last_chunk(query.key_expr)
        name = f"control.{verb if verb in _ALL else 'unknown'}"
        self._served.health.count(f"{name}.{error.code}")
        self._served.audit.refused(name, asker_of(query), error)

        def send() -> None:
            with query:
                reply_error(query, error)

        self._prompt.post_now(send)
