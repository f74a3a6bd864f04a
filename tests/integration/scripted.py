"""A server that answers as a test says: for what a real server does not do, such as lies, silence and lost receipts."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable
from typing import Any

import zenoh

from potschemas.keys import CONTROL_VERBS, MapKeys
from potschemas.messages import Cloud, ErrorCode, ErrorReply, Message, Receipt
from potschemas.wire import decode, encode, encoding_of

HOLD = object()  # the question is kept, and never answered
# Replies in order: messages, bytes as they are, error codes as error replies; none at all = the question is dropped.
Answer = Any


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


class ScriptedServer:
    """A Zenoh node with the keys of map `default`, where nothing is answered but what `on` and `on_clouds` say."""

    def __init__(self, *, ready: bool = True) -> None:
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.keys = MapKeys("pot/v1", "default")
        self._token: zenoh.LivelinessToken | None = None
        self.n_left = 0  # how often the token went
        self.asked: list[tuple[str, bytes]] = []  # operation or verb, and the question, as they came
        self._held: list[zenoh.Query] = []
        self._declared: list[Any] = []
        self._threads: list[threading.Thread] = []
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", json.dumps([self.endpoint]))
        self.session = zenoh.open(config)
        if ready:
            self.declare_ready()

    def declare_ready(self) -> None:
        """Say that the map is served and warm."""
        key = self.keys.server_token("scripted")
        self._token = self.session.liveliness().declare_token(key)

    def leave(self) -> None:
        """Say that the map is served no more; clouds and questions are taken all the same."""
        self.n_left += 1
        assert self._token is not None
        self._token.undeclare()

    def on(self, op: str, *answers: Answer) -> None:
        """Answer `q/<op>`, `ctl/<op>` for a verb or an operation named so, or `in/*/integrate`.

        Args:
            op: Which questions.
            answers: One for each question that comes; the last one for all others too. Each is a list of replies, one reply,
                HOLD, or a function that makes one of these from the bytes of the question.
        """
        if op in CONTROL_VERBS or op.startswith("ctl/"):
            key = self.keys.control(op.removeprefix("ctl/"))
        else:
            key = self.keys.integrate("*") if op == "integrate" else self.keys.query(op)
        queryable = self.session.declare_queryable(key, zenoh.handlers.FifoChannel(32), complete=True)

        def run() -> None:
            for n, query in enumerate(queryable):
                question = query.payload.to_bytes() if query.payload is not None else b""
                self.asked.append((op, question))
                answer = answers[min(n, len(answers) - 1)]
                self._reply(query, answer(question) if callable(answer) else answer)

        self._start(queryable, run)

    def on_clouds(self, receipt_of: Callable[[str, Cloud], Receipt | None]) -> None:
        """Take published clouds; `receipt_of(robot, cloud)` is sent back, None is not."""
        subscriber = self.session.declare_subscriber(self.keys.cloud("*"), zenoh.handlers.FifoChannel(32))

        def run() -> None:
            for sample in subscriber:
                robot = str(sample.key_expr).rsplit("/", 2)[1]
                receipt = receipt_of(robot, decode(sample.payload.to_bytes(), Cloud))
                if receipt is not None:
                    self.session.put(self.keys.receipt(robot), encode(receipt), encoding=encoding_of(receipt))

        self._start(subscriber, run)

    def count(self, op: str) -> int:
        """How many questions of a kind came."""
        return sum(asked == op for asked, _ in self.asked)

    def close(self) -> None:
        """Leave; threads end."""
        for query in self._held:
            query.drop()
        for declared in self._declared:
            declared.undeclare()
        for thread in self._threads:
            thread.join(10)
        self.session.close()

    def __enter__(self) -> ScriptedServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, declared: Any, run: Callable[[], None]) -> None:
        self._declared.append(declared)
        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _reply(self, query: zenoh.Query, answer: Answer) -> None:
        key = query.key_expr
        if answer is HOLD:
            self._held.append(query)
            return
        with query:
            for reply in answer if isinstance(answer, list) else [answer]:
                if isinstance(reply, bytes):
                    query.reply(key, reply)
                elif isinstance(reply, Message) and not isinstance(reply, ErrorReply):
                    query.reply(key, encode(reply), encoding=encoding_of(reply))
                else:
                    error = error_reply(reply) if isinstance(reply, ErrorCode) else reply
                    query.reply_err(encode(error), encoding=encoding_of(error))


def error_reply(code: ErrorCode) -> ErrorReply:
    """What a server says with this code."""
    is_overload = code is ErrorCode.OVERLOADED
    return ErrorReply(
        code=code,
        message="scripted",
        retryable=is_overload,
        retry_after_s=0.01 if is_overload else None,
    )


def receipt_of(robot: str, cloud: Cloud, **changes: Any) -> Receipt:
    """The receipt of an accepted cloud, or of another one by `changes`."""
    fields: dict[str, Any] = {"map": "default", "robot": robot, "seq": cloud.seq, "status": "accepted"}
    return Receipt(**fields | changes)
