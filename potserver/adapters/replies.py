"""Queries as Zenoh hands them over: what is checked before their bytes are touched, and how they are answered."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import zenoh

from potschemas import messages
from potserver.codec.base import Wire, check_encoding, check_size, encode_error
from potserver.errors import MapDamagedError, PotserverError

BUG = "a bug of the server; the traceback is in its log"


def failure(
    error: Exception, check_readable: Callable[[], None], log: Any, event: str, **fields: object
) -> PotserverError:
    """What to tell of an exception in work: itself, or a bug, which is logged; or that the map was unreadable, where it was,
    because then nothing means what it says."""
    try:
        check_readable()
    except MapDamagedError as damage:
        return damage
    if isinstance(error, PotserverError):
        return error
    log.error(event, exc_info=error, **fields)
    return PotserverError(BUG)


def check_query(query: zenoh.Query, kind: type[messages.Message], max_bytes: int, what: str) -> int:
    """Refuse a query by its size and its encoding, before its bytes are touched; the size, bytes.

    Raises:
        TooLargeError, BadMessageError.
    """
    n_bytes = 0 if query.payload is None else len(query.payload)
    check_size(n_bytes, max_bytes, what)
    check_encoding(None if query.encoding is None else str(query.encoding), kind)
    return n_bytes


def asker_of(query: zenoh.Query) -> str:
    """The Zenoh session that asks, as far as the query says so; empty if it does not."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


def payload_of(query: zenoh.Query) -> bytes:
    """Its bytes; none are an empty payload."""
    return b"" if query.payload is None else query.payload.to_bytes()


def reply(query: zenoh.Query, key: str, wire: Wire) -> None:
    """Send one reply, on our own key: the query's may be wild."""
    query.reply(key, wire.payload, encoding=wire.encoding)


def reply_error(query: zenoh.Query, error: PotserverError) -> None:
    """Send what went wrong."""
    wire = encode_error(error)
    with contextlib.suppress(zenoh.ZError):  # the asker may be gone
        query.reply_err(wire.payload, encoding=wire.encoding)
