"""What all messages share: decoding with typed errors, checks before the bytes are touched, and encoding."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from potschemas import messages, wire
from potschemas.messages import DType, ErrorCode
from potserver.errors import PotserverError, TooLargeError, error_classes

MessageT = TypeVar("MessageT", bound=messages.Message)
Shape = tuple[int | tuple[int, ...] | None, ...]  # an axis: its length, the accepted lengths, or any

MAX_SMALL_BYTES = 4096  # of messages without arrays
FLOATS = (DType.FLOAT32, DType.FLOAT64)
_ERRORS = error_classes()


class Wire(NamedTuple):
    """A message ready to send."""

    payload: bytes
    encoding: str


def check_size(n_bytes: int, limit: int, what: str) -> None:
    """Refuse a payload by its length alone.

    Raises:
        TooLargeError: it is longer than the limit.
    """
    if n_bytes > limit:
        raise TooLargeError(f"{what} of {n_bytes} bytes, the limit is {limit}")


def check_encoding(encoding: str | None, kind: type[messages.Message]) -> None:
    """Refuse a payload that says it is something else; what says nothing passes, see `potschemas.wire.check_encoding`.

    Raises:
        BadMessageError: the encoding names another schema, or another format.
    """
    with typed_errors():
        wire.check_encoding(encoding or "", kind)


def decode(payload: bytes, kind: type[MessageT], max_bytes: int = MAX_SMALL_BYTES) -> MessageT:
    """One request; an empty payload stands for a message whose fields all have defaults.

    Raises:
        BadMessageError, ShapeError, TooLargeError: see `potschemas.wire.decode`.
    """
    with typed_errors():
        return wire.decode(payload or b"\x80", kind, wire.request_limits(max_bytes))


def decode_array(array: messages.Array, name: str, dtypes: tuple[DType, ...], shape: Shape) -> NDArray[Any]:
    """A read-only view of a received array.

    Raises:
        ShapeError: its dtype, shape or byte count is wrong.
    """
    with typed_errors():
        return wire.decode_array(array, name, dtypes=dtypes, shape=shape)


@contextlib.contextmanager
def typed_errors() -> Iterator[None]:
    """Turn errors of the wire into ours of the same code."""
    try:
        yield
    except wire.WireError as error:
        raise _ERRORS[error.code.value](str(error)) from error


def encode(message: messages.Message) -> Wire:
    """A message with the encoding that names its schema."""
    return Wire(wire.encode(message), wire.encoding_of(message))


def encode_error(error: PotserverError) -> Wire:
    """The payload of `reply_err`."""
    return encode(
        messages.ErrorReply(
            code=ErrorCode(error.code),
            message=str(error),
            retryable=error.retryable,
            retry_after_s=error.retry_after_s,
            reason=messages.ABSENT if error.reason is None else error.reason,
        )
    )


def float32(array: NDArray[np.floating[Any]]) -> messages.Array:
    """Real numbers for the wire."""
    return wire.encode_array(np.asarray(array, np.float32))


def float32_fields(record: Any) -> dict[str, Any]:
    """The fields of a dataclass by name, its arrays as float32: for a message that has the same fields."""
    values = {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}
    return {name: float32(v) if isinstance(v, np.ndarray) else v for name, v in values.items()}
