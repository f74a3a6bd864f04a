"""The connection of a `MapClient`: a Zenoh session, questions and their replies, subscriptions, and who serves.

Everything that Zenoh hands back is read from bounded channels, on daemon threads of our own: the threads of Zenoh callbacks
keep a process alive that forgot to close its session.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import logging
import math
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import zenoh

from potclient.errors import (
    BadReplyError,
    ClosedError,
    LostReplyError,
    NoServerError,
    PotclientError,
    QueryTimeoutError,
    UsageError,
    error_from_reply,
)
from potclient.session import SessionOptions, open_session
from potclient.zenoh_config import DEFAULT_ENDPOINT
from potschemas import messages
from potschemas.keys import MapKeys, server_of
from potschemas.messages import Message
from potschemas.redaction import redacted
from potschemas.wire import WireError, decode, encode, encoding_of

log = logging.getLogger("potclient")

MessageT = TypeVar("MessageT", bound=Message)

_JOIN_S = 3.0  # for callbacks that still run when a link is closed
_DIAGNOSIS_TIMEOUT_S = 0.5  # how long a silent question waits for the tokens of servers
# megabytes take lanes of their own, so that they do not delay short questions and answers on the same link
_BULK_BYTES = 65_536  # of a question
_BULK_LANES = {
    "integrate": zenoh.Priority.DATA_LOW,
    "grid": zenoh.Priority.DATA,
    "params": zenoh.Priority.DATA,
    "tiles": zenoh.Priority.DATA,
}


class Subscription:
    """Samples of one key, delivered on a thread of its own until closed. Also a context manager."""

    def __init__(
        self,
        subscriber: Any,
        deliver: Callable[[zenoh.Sample], None],
        name: str,
        on_close: Callable[[Subscription], None],
    ) -> None:
        self._subscriber, self._deliver, self._on_close = subscriber, deliver, on_close
        self._thread = threading.Thread(target=self._run, name=f"potclient-{name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for sample in self._subscriber:  # ends when it is undeclared or the session closes
            try:
                self._deliver(sample)
            except BadReplyError as error:  # somebody else's message, or another version's
                log.warning("%s: %s", sample.key_expr, error)
            except Exception:  # the user's callback: the stream goes on
                log.exception("callback for %s failed", sample.key_expr)

    def close(self) -> None:
        """Stop; the callback may still be running once more when this returns."""
        undeclare(self._subscriber)
        self._on_close(self)

    def runs_on(self, thread: threading.Thread) -> bool:
        """Whether this is the thread that delivers."""
        return thread is self._thread

    def join(self, timeout_s: float) -> None:
        """Wait until the thread has ended."""
        self._thread.join(timeout_s)

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Link:
    """One Zenoh session, for one map. Any thread may call any method.

    Args:
        keys: Of the map.
        options: Of the session.
        timeout_s: How long an answer may take, unless a question says otherwise.
        session: An open one to use instead; it is left open at the end.
    Raises:
        UsageError: an option is not legal.
        NoServerError: nobody listens at the endpoint. AccessError: somebody does, and does not let us in.
    """

    def __init__(
        self, keys: MapKeys, options: SessionOptions, timeout_s: float, session: zenoh.Session | None = None
    ) -> None:
        self.keys, self.timeout_s = keys, timeout_s
        self.where = redacted(", ".join(options.connect)) or DEFAULT_ENDPOINT
        self.is_closed = False
        self._lock = threading.RLock()
        self._alive: set[tuple[str, str]] = set()  # (server, map) of every liveliness token under the root
        self._servers_changed = threading.Condition()
        self._queriers: dict[
            tuple[str, bool], zenoh.Querier
        ] = {}  # by key, and whether it is for large questions
        self._numbers = itertools.count()  # of questions
        self._calls_changed = threading.Condition()
        self.n_calls = 0  # threads that are inside Zenoh for us
        self._declared: list[Any] = []
        self._subscriptions: list[Subscription] = []
        self._readers: weakref.WeakSet[Subscription] = weakref.WeakSet()  # all whose threads may still run
        self._owns_session = session is None
        self._session = open_session(options) if session is None else session
        try:
            tokens = self._session.liveliness().declare_subscriber(
                f"@{keys.root}/srv/*/*", zenoh.handlers.FifoChannel(64), history=True
            )
            self._add(Subscription(tokens, self._note_server, "servers", self._forget))
        except BaseException:
            self.close()
            raise

    def close(self, caller: threading.Thread | None = None) -> None:
        """Undeclare everything and close the session. May take seconds; a second call does nothing.

        Args:
            caller: The thread that waits for this, by default this one. Where it is a subscription's own, in a callback, its
                end is not waited for.
        """
        caller = caller or threading.current_thread()
        self.end_waits()
        with self._lock:  # what is being declared is undeclared too
            subscriptions = list(self._subscriptions)
            declared, self._declared = self._declared, []
        for subscription in subscriptions:
            subscription.close()
        for entity in declared:
            undeclare(entity)
        if self._owns_session:
            with contextlib.suppress(zenoh.ZError):
                self._session.close()
        # A thread that comes back from Zenoh while the interpreter shuts down aborts the process.
        until = time.monotonic() + _JOIN_S
        with self._calls_changed:
            self._calls_changed.wait_for(lambda: not self.n_calls, _JOIN_S)
        for reader in list(self._readers):
            if not reader.runs_on(caller):
                reader.join(max(0.0, until - time.monotonic()))

    def end_waits(self) -> None:
        """Refuse all calls from now on, and end those that wait for a server."""
        with self._servers_changed:
            self.is_closed = True
            self._servers_changed.notify_all()

    def check_open(self) -> None:
        """Raises ClosedError once the link is closed."""
        if self.is_closed:
            raise ClosedError("the client is closed")

    # --- who serves ----------------------------------------------------------------------------------------------------------

    @property
    def servers(self) -> tuple[str, ...]:
        """Ids of the servers that serve this map and are warm, as far as has been heard."""
        with self._servers_changed:
            return tuple(sorted(server for server, map_id in self._alive if map_id == self.keys.map_id))

    def wait_ready(self, timeout_s: float | None) -> str:
        """See `MapClient.wait_ready`."""
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        with self._servers_changed:
            self._servers_changed.wait_for(lambda: self.is_closed or self.servers, timeout_s)
            self.check_open()
            if servers := self.servers:
                return servers[0]
        raise NoServerError(
            f"no server at {self.where} is ready to serve map {self.keys.map_id!r} after {timeout_s:g} s"
            + self._other_maps_hint()
        )

    def wait_for_match(self, op: str, timeout_s: float | None) -> None:
        """See `MapClient.wait_for_match`."""
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        querier = self._querier(self.keys.query(op))
        until = time.monotonic() + timeout_s
        while not self._call(is_matching, querier):
            if time.monotonic() >= until:
                raise NoServerError(f"nobody at {self.where} answers {op!r} for map {self.keys.map_id!r}")
            time.sleep(0.005)
            self.check_open()

    def _note_server(self, sample: zenoh.Sample) -> None:
        served = server_of(str(sample.key_expr))
        with self._servers_changed:
            if sample.kind == zenoh.SampleKind.PUT:
                self._alive.add(served)
            else:
                self._alive.discard(served)
            self._servers_changed.notify_all()

    def _other_maps_hint(self) -> str:
        with self._servers_changed:
            maps = sorted({map_id for _, map_id in self._alive} - {self.keys.map_id})
        if maps:
            return f"; maps served here: {', '.join(maps)}"
        return (
            f"; no server has announced itself under the root {self.keys.root!r}: one that has just started is warming up"
            " (`--wait SECONDS` or `wait_ready` waits for it), or start one with `potserver serve`"
        )

    # --- questions -----------------------------------------------------------------------------------------------------------

    def ask(self, key: str, request: Message, kind: type[MessageT], timeout_s: float | None) -> MessageT:
        """The only reply to a question.

        Args:
            key: What is asked: `keys.query("points")`, ...
            request: Its message.
            kind: Of the reply.
            timeout_s: For the reply; None = the link's.
        Raises:
            MapServerError: its subclass for the error that was replied.
            NoServerError, QueryTimeoutError, LostReplyError: no reply came.
            BadReplyError: the reply is not of that kind.
            UsageError, ClosedError: nothing was asked.
        """
        return next(self.stream(key, request, kind, timeout_s))

    def stream(
        self, key: str, request: Message, kind: type[MessageT], timeout_s: float | None
    ) -> Iterator[MessageT]:
        """Ask now; the iterator gives the replies as they come, at least one. Arguments and errors as for `ask`."""
        samples = self.samples(key, request, timeout_s)
        return (decoded(sample.payload, kind) for sample in samples)

    def samples(self, key: str, request: Message, timeout_s: float | None) -> Iterator[zenoh.Sample]:
        """Ask now; the iterator gives the replies as they come, undecoded. Errors as for `ask`."""
        timeout_s = self.timeout_s if timeout_s is None else timeout_s
        if not (math.isfinite(timeout_s) and timeout_s > 0):
            raise UsageError(f"timeout_s {timeout_s}: need a positive number of seconds")
        was_ready = bool(self.servers)
        payload = encode(request)
        is_bulk = len(payload) > _BULK_BYTES
        querier = self._querier(key, is_bulk=is_bulk)
        sent: dict[str, Any] = {
            "payload": payload,
            "encoding": encoding_of(request),
            # the server gives each session its share, and ends the questions of one that is gone
            "source_info": zenoh.SourceInfo(querier.id, next(self._numbers)),
        }
        if timeout_s == self.timeout_s:
            replies = self._call(querier.get, **sent)
        else:  # the time-out of a declared querier is fixed
            qos = _query_qos(key, is_bulk=is_bulk)
            replies = self._call(self._session.get, key, timeout=timeout_s, **sent, **qos)
        for_silence = functools.partial(self._silence, key, len(payload), was_ready)
        return self._checked(iter(replies), key, timeout_s, for_silence)

    def deadline_ms(self, timeout_s: float | None) -> float:
        """The deadline that a message carries, so that the server starts no work that nobody waits for."""
        return (self.timeout_s if timeout_s is None else timeout_s) * 1e3

    def _checked(
        self, replies: Any, key: str, timeout_s: float, for_silence: Callable[[], PotclientError]
    ) -> Iterator[zenoh.Sample]:
        n = 0
        while (reply := self._next(replies)) is not None:
            if reply.ok is not None:
                n += 1
                yield reply.ok
                continue
            payload = reply.err.payload.to_bytes()
            if payload == b"Timeout":
                got = f" ({n} parts had come)" if n else ""
                raise QueryTimeoutError(f"{key}: no answer from {self.where} within {timeout_s:g} s{got}")
            try:
                error: PotclientError = error_from_reply(decode(payload, messages.ErrorReply))
            except WireError:
                error = BadReplyError(f"{key}: an error reply that is none of ours: {payload[:80]!r}")
            raise error
        if n == 0:
            raise for_silence()

    def _next(self, replies: Any) -> Any:
        """The next reply; None at the end."""
        with self._inside():
            return next(replies, None)

    def _silence(self, key: str, n_bytes: int, was_ready: bool) -> PotclientError:
        """Why a question got no answer at all. Zenoh reports all of these alike: as an empty list of replies.

        Args:
            key: Of the question.
            n_bytes: Of the question.
            was_ready: Whether a server's token had been heard of when it was asked.
        """
        if self.is_closed:
            return ClosedError("the client was closed")
        if not self._call(self._session.info.transports):
            return NoServerError(
                f"{key}: the connection to {self.where} is lost; Zenoh reconnects by itself, try again"
            )
        querier = self._querier(key)
        with self._servers_changed:
            # the tokens of a session that was opened just now may still be on their way
            is_alive = bool(self._servers_changed.wait_for(lambda: self.servers, _DIAGNOSIS_TIMEOUT_S))
        if not self._call(is_matching, querier):
            if is_alive:
                return LostReplyError(
                    f"{key}: a server for map {self.keys.map_id!r} is up but does not offer this question:"
                    " its version differs, or its access control hides it"
                )
            return NoServerError(
                f"{key}: no server at {self.where} serves map {self.keys.map_id!r}{self._other_maps_hint()}"
            )
        if not is_alive:
            return NoServerError(
                f"{key}: a server is there but not ready (warming up, or just gone); `wait_ready` waits for it"
            )
        if not was_ready:
            return NoServerError(
                f"{key}: no answer, and the server has announced itself only since: it was warming up, ask again. If that does"
                " not help, its access control or size filter holds the question back"
            )
        return LostReplyError(
            f"{key}: a server is up but the question of {n_bytes} bytes got no answer: denied by access control, above its size"
            " filter, or the server failed while answering"
        )

    def why_no_receipt(self, robot: str, *, is_matched: bool) -> str:
        """The likely cause of a robot's clouds coming to nothing, in words; Zenoh tells a sender of none.

        Args:
            robot: Whose clouds.
            is_matched: Whether somebody takes them.
        """
        if self.is_closed:
            return "the client was closed"
        if not self._session.info.transports():
            return f"the connection to {self.where} is lost"
        if not self.servers:
            return f"no server at {self.where} serves map {self.keys.map_id!r}{self._other_maps_hint()}"
        if not is_matched:
            return f"a server is up and takes no clouds from this client: its access control lets others be {robot!r}"
        return (
            f"a server is up and gave no receipt: its access control may not let this client send as {robot!r} or hear its"
            " receipts, the cloud may be above its size filter, or it is far behind"
        )

    def _querier(self, key: str, *, is_bulk: bool = False) -> zenoh.Querier:
        with self._lock:
            self.check_open()
            querier = self._queriers.get((key, is_bulk))
            if querier is None:
                qos = _query_qos(key, is_bulk=is_bulk)
                querier = self._session.declare_querier(key, timeout=self.timeout_s, **qos)
                self._queriers[key, is_bulk] = querier
                self._declared.append(querier)
            return querier

    def _call(self, function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
        try:
            with self._inside():
                self.check_open()
                return function(*args, **kwargs)
        except zenoh.ZError as error:
            self.check_open()
            raise LostReplyError(f"Zenoh: {error}") from error

    @contextlib.contextmanager
    def _inside(self) -> Iterator[None]:
        """Be counted: `close` waits for whoever is inside Zenoh."""
        with self._calls_changed:
            self.n_calls += 1
        try:
            yield
        finally:
            with self._calls_changed:
                self.n_calls -= 1
                self._calls_changed.notify_all()

    # --- streams -------------------------------------------------------------------------------------------------------------

    def subscribe(
        self, key: str, kind: type[MessageT], callback: Callable[[MessageT], None], name: str, channel: Any
    ) -> Subscription:
        """Call back with the messages of a key, on a thread of their own.

        Args:
            key: May hold wildcards.
            kind: Of the messages; one that is not of it is logged and left out.
            callback: What it raises is logged.
            name: Of the thread.
            channel: A Zenoh handler: what waits while the callback runs.
        Raises:
            ClosedError: the link is closed.
        """
        return self.subscribe_samples(
            key, lambda sample: callback(decoded(sample.payload, kind)), name, channel
        )

    def subscribe_samples(
        self, key: str, deliver: Callable[[zenoh.Sample], None], name: str, channel: Any
    ) -> Subscription:
        """As `subscribe`, for who needs the keys of the samples too."""
        with self._lock:
            self.check_open()
            subscription = Subscription(
                self._session.declare_subscriber(key, channel), deliver, name, self._forget
            )
            return self._add(subscription)

    def publisher(self, key: str, kind: type[Message], **qos: Any) -> zenoh.Publisher:
        """A publisher of messages of one kind, undeclared with the link.

        Raises:
            ClosedError: the link is closed.
        """
        with self._lock:
            self.check_open()
            publisher = self._session.declare_publisher(key, encoding=encoding_of(kind), **qos)
            self._declared.append(publisher)
            return publisher

    def put(self, publisher: zenoh.Publisher, message: Message) -> None:
        """Publish a message.

        Raises:
            ClosedError, LostReplyError: it was not sent.
        """
        self._call(publisher.put, encode(message))

    def announce_robot(self, robot: str) -> None:
        """Declare the liveliness token of a robot that feeds this map; it goes with the link."""
        with self._lock:
            self._declared.append(self._session.liveliness().declare_token(self.keys.robot_token(robot)))

    def _add(self, subscription: Subscription) -> Subscription:
        self._subscriptions.append(subscription)
        self._readers.add(subscription)
        return subscription

    def _forget(self, subscription: Subscription) -> None:
        with self._lock, contextlib.suppress(ValueError):  # closed twice
            self._subscriptions.remove(subscription)


def undeclare(entity: Any) -> None:
    """End a declaration; one that another thread uses right now ("Already borrowed") goes with the session."""
    with contextlib.suppress(zenoh.ZError, RuntimeError):
        entity.undeclare()


def is_matching(entity: zenoh.Publisher | zenoh.Querier) -> bool:
    """Whether somebody takes what is published, or answers what is asked."""
    status: Any = entity.matching_status  # an object that is always true; the stub says bool
    return bool(status.matching)


def decoded(payload: zenoh.ZBytes, kind: type[MessageT]) -> MessageT:
    """The message in a payload.

    Raises:
        BadReplyError: it is not of this kind.
    """
    try:
        return decode(payload.to_bytes(), kind)
    except WireError as error:
        raise BadReplyError(f"{error}; do the versions of client and server differ?") from error


def _query_qos(key: str, *, is_bulk: bool) -> dict[str, Any]:
    """The lane of a question; its replies take the same one. No consolidation: parts of one reply share a key."""
    usual = zenoh.Priority.DATA if is_bulk else zenoh.Priority.INTERACTIVE_HIGH
    priority = _BULK_LANES.get(key.rsplit("/", 1)[-1], usual)
    return {
        "consolidation": zenoh.ConsolidationMode.NONE,
        "congestion_control": zenoh.CongestionControl.BLOCK,
        "priority": priority,
        "express": priority == zenoh.Priority.INTERACTIVE_HIGH,
    }
