"""Bytes to messages and back: MessagePack, bounded before it is parsed, typed before it is used.

Whatever the bytes are, `decode` returns a message or raises `WireError`, and what it allocates is bounded by
the payload and by `WireLimits`. What it refuses, beyond what is not MessagePack at all:

* more than `WireLimits` allows: bytes, nesting, entries of one map or list, values in all; too long strings;
* ext types (timestamps too), map keys that are not strings, a key twice in one map, bytes after the message;
* integer fields beyond signed 64 bits, NaN and infinity except in `Measured` fields, a string for bytes.

Fields that the receiver does not know are ignored: an older receiver reads a newer sender's message.
"""

from __future__ import annotations

import math
import re
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple, TypeVar, cast

import msgpack
import msgspec
import numpy as np
from numpy.typing import NDArray

from potschemas.messages import MAX_AXES, MAX_AXIS_LENGTH, Array, DType, ErrorCode, Message, Packed

MessageT = TypeVar("MessageT", bound=Message)

MIME = "application/msgpack"
# maps and lists inside one another; the deepest message has 7 levels
MAX_DEPTH = 8
MAX_ITEMS = 100_000  # entries of one map or list; arrays are bytes, so real messages stay far below
MAX_VALUES = 100_000  # values and keys in all; a revision tick of 24,000 tiles fits
MAX_REQUEST_VALUES = (
    2_000  # in all that a server is sent: real requests have some dozens, a whole atom some hundreds
)
MAX_STRING_BYTES = 65_536
_DEFLATE_LEVEL = 1  # higher ones look for longer matches, of which numbers of maps have none
_MAX_ERROR_CHARS = 300  # a hostile sender must not fill our log through an error text
_UNSAID = ("", "zenoh/bytes", MIME)  # Zenoh's default, and ours without a schema


class WireError(ValueError):
    """The bytes are not a message of the expected schema; `code` tells the sender which kind of wrong."""

    def __init__(self, code: ErrorCode, message: str) -> None:
        super().__init__(message if len(message) <= _MAX_ERROR_CHARS else message[:_MAX_ERROR_CHARS] + "...")
        self.code = code


class WireLimits(NamedTuple):
    """Bounds that hold before anything is allocated."""

    max_bytes: int = 64 * 2**20
    max_depth: int = MAX_DEPTH
    max_items: int = MAX_ITEMS
    max_values: int = MAX_VALUES


DEFAULT_LIMITS = WireLimits()


def request_limits(max_bytes: int) -> WireLimits:
    """What a server takes: whatever the bytes are, looking at their structure takes well under a millisecond."""
    return WireLimits(max_bytes, max_items=MAX_REQUEST_VALUES, max_values=MAX_REQUEST_VALUES)


def encoding_of(message: type[Message] | Message) -> str:
    """The Zenoh encoding string of a message, e.g. `application/msgpack;pot.cloud.v1`."""
    return f"{MIME};{message.schema}"


def schema_of(encoding: str) -> str | None:
    """The schema that a Zenoh encoding string names, or None if it names none of ours."""
    mime, _, schema = encoding.partition(";")
    return schema.strip() or None if mime.strip() in _UNSAID else None


def check_encoding(encoding: str, kind: type[Message]) -> None:
    """Refuse a payload whose encoding says that it is something else than `kind`.

    `application/msgpack` and Zenoh's default `zenoh/bytes` without a schema say nothing, and pass: `decode`
    checks the bytes anyway.

    Raises:
        WireError: code `bad_message`: another schema, or a format that is not ours.
    """
    mime = encoding.partition(";")[0].strip()
    if mime not in _UNSAID or schema_of(encoding) not in (None, kind.schema):
        raise WireError(ErrorCode.BAD_MESSAGE, f"encoding {encoding[:100]!r}, need {encoding_of(kind)!r}")


def encode(message: Message) -> bytes:
    """Pack a message as a MessagePack map; numpy scalars become plain numbers. Values are not checked."""
    tree = msgspec.to_builtins(message, builtin_types=(bytes,), enc_hook=_plain_number)
    return cast(bytes, msgpack.packb(tree, use_bin_type=True))


def decode(payload: bytes, kind: type[MessageT], limits: WireLimits = DEFAULT_LIMITS) -> MessageT:
    """Unpack and check one message. Unknown fields are ignored.

    Raises:
        WireError: code `too_large` past `limits.max_bytes`; code `bad_array` where an array's dtype, shape or
            data is not of the wire's types; code `bad_message` for anything else that is not this message.
    """
    if len(payload) > limits.max_bytes:
        raise WireError(
            ErrorCode.TOO_LARGE, f"{kind.schema}: {len(payload)} bytes, the limit is {limits.max_bytes}"
        )
    problem = _structure_problem(payload, limits)
    if problem is not None:
        raise WireError(ErrorCode.BAD_MESSAGE, f"{kind.schema}: {problem}")
    try:
        tree: Any = msgpack.unpackb(
            payload,
            raw=False,
            strict_map_key=True,
            use_list=True,
            object_pairs_hook=_unique_string_keys,
            max_str_len=MAX_STRING_BYTES,
            max_bin_len=limits.max_bytes,
            max_array_len=limits.max_items,
            max_map_len=limits.max_items,
            max_ext_len=0,
        )
    except (msgpack.UnpackException, ValueError, RecursionError) as error:
        raise WireError(
            ErrorCode.BAD_MESSAGE, f"{kind.schema}: not MessagePack ({str(error) or type(error).__name__})"
        ) from error
    try:
        # bytes are named as built in, or msgspec would take a string for base64
        return msgspec.convert(tree, kind, strict=True, builtin_types=(bytes,))
    except (msgspec.ValidationError, OverflowError) as error:
        code = ErrorCode.BAD_ARRAY if _INSIDE_ARRAY.search(str(error)) else ErrorCode.BAD_MESSAGE
        raise WireError(code, f"{kind.schema}: {error}") from error


def encode_array(array: NDArray[Any]) -> Array:
    """An array for the wire: little-endian, C order.

    Raises:
        WireError: code `bad_array`: the dtype is not one that the wire carries, or there are too many axes.
    """
    dtype, little = _little_endian(array)
    return Array(dtype=dtype, shape=list(array.shape), data=little.tobytes())


def decode_array(
    array: Array,
    name: str,
    *,
    dtypes: tuple[DType, ...],
    shape: tuple[int | tuple[int, ...] | None, ...],
) -> NDArray[Any]:
    """A read-only numpy view of a wire array, checked. Its values are not: NaN and infinity pass.

    Args:
        array: As received.
        name: What to call it in the error.
        dtypes: Element types that are accepted.
        shape: One entry an axis: a length, a tuple of accepted lengths, or None for any.
    Raises:
        WireError: code `bad_array`: dtype, number of axes, an axis length, or the byte count is wrong.
    """
    n_bytes = _check_form(array, name, dtypes, shape)
    if n_bytes != len(array.data):
        raise WireError(
            ErrorCode.BAD_ARRAY,
            f"{name}: {len(array.data)} bytes for shape {tuple(array.shape)} of {array.dtype.value}",
        )
    return _view(array.data, array, name)


def pack_array(array: NDArray[Any], *, repeats: bool = False) -> Packed:
    """An array for the wire, deflated by planes of bytes.

    Args:
        array: Of a type that travels.
        repeats: Look for longer repeats, as leans have; in differences there are none, and looking takes time.
    Raises:
        WireError: see `encode_array`.
    """
    dtype, little = _little_endian(array)
    planes = little.reshape(-1).view(np.uint8).reshape(-1, little.itemsize).T
    deflater = zlib.compressobj(9) if repeats else zlib.compressobj(_DEFLATE_LEVEL, strategy=zlib.Z_RLE)
    deflated = deflater.compress(planes.tobytes()) + deflater.flush()
    return Packed(dtype=dtype, shape=list(array.shape), deflated=deflated)


def unpack_array(
    packed: Packed,
    name: str,
    *,
    dtypes: tuple[DType, ...],
    shape: tuple[int | tuple[int, ...] | None, ...],
    max_elements: int,
) -> NDArray[Any]:
    """The read-only array of a packed one, checked as `decode_array` does; nothing longer than `max_elements` is inflated.

    Raises:
        WireError: code `too_large`: more elements; code `bad_array`: see `decode_array`, or not such a zlib stream.
    """
    n_bytes = _check_form(packed, name, dtypes, shape)
    if math.prod(packed.shape) > max_elements:
        raise WireError(
            ErrorCode.TOO_LARGE, f"{name}: shape {tuple(packed.shape)}, the limit is {max_elements} elements"
        )
    inflater = zlib.decompressobj()
    try:
        planes = inflater.decompress(packed.deflated, n_bytes + 1)  # 0 would mean without a limit
    except zlib.error as error:
        raise WireError(ErrorCode.BAD_ARRAY, f"{name}: not a zlib stream ({error})") from error
    if len(planes) != n_bytes or not inflater.eof or inflater.unused_data:
        raise WireError(
            ErrorCode.BAD_ARRAY,
            f"{name}: the zlib stream does not end after the {n_bytes} bytes of shape {tuple(packed.shape)}",
        )
    itemsize = np.dtype(packed.dtype.value).itemsize
    return _view(np.frombuffer(planes, np.uint8).reshape(itemsize, -1).T.tobytes(), packed, name)


def _little_endian(array: NDArray[Any]) -> tuple[DType, NDArray[Any]]:
    try:
        dtype = DType(array.dtype.newbyteorder("<").str)
    except ValueError as error:
        raise WireError(
            ErrorCode.BAD_ARRAY, f"dtype {array.dtype} does not travel; use one of {[d.value for d in DType]}"
        ) from error
    if array.ndim > MAX_AXES or max(array.shape, default=0) > MAX_AXIS_LENGTH:
        raise WireError(ErrorCode.BAD_ARRAY, f"shape {array.shape} does not travel: at most {MAX_AXES} axes")
    return dtype, np.ascontiguousarray(array, dtype=dtype.value)


def _check_form(
    array: Array | Packed,
    name: str,
    dtypes: tuple[DType, ...],
    shape: tuple[int | tuple[int, ...] | None, ...],
) -> int:
    """How many bytes the elements take, if dtype and shape are accepted."""
    if array.dtype not in dtypes:
        need = " or ".join(d.value for d in dtypes)
        raise WireError(ErrorCode.BAD_ARRAY, f"{name}: dtype {array.dtype.value}, need {need}")
    accepted = [(axis,) if isinstance(axis, int) else axis for axis in shape]
    if len(array.shape) != len(shape) or any(
        lengths is not None and n not in lengths for n, lengths in zip(array.shape, accepted, strict=True)
    ):
        wanted = ", ".join("any" if axis is None else str(axis) for axis in shape)
        raise WireError(ErrorCode.BAD_ARRAY, f"{name}: shape {tuple(array.shape)}, need ({wanted})")
    return math.prod(array.shape) * np.dtype(array.dtype.value).itemsize  # Python's integers do not overflow


def _view(data: bytes, array: Array | Packed, name: str) -> NDArray[Any]:
    if array.dtype is DType.BOOL and np.any(np.frombuffer(data, np.uint8) > 1):
        raise WireError(ErrorCode.BAD_ARRAY, f"{name}: a bool must be the byte 0 or 1")
    try:
        return np.frombuffer(data, array.dtype.value).reshape(array.shape)
    except ValueError as error:  # no elements, and axes whose product numpy cannot hold
        raise WireError(ErrorCode.BAD_ARRAY, f"{name}: shape {tuple(array.shape)}: {error}") from error


# msgspec names the place at the end of its text; only Array and Packed have such fields below the top level
_INSIDE_ARRAY = re.compile(r"`\$\.[^`]+\.(?:dtype|shape(?:\[\d+\])?|data|deflated)`\Z")


def _plain_number(value: object) -> bool | int | float:
    if isinstance(value, np.bool_ | np.integer | np.floating):
        return cast("bool | int | float", value.item())
    raise TypeError(f"{type(value).__name__} does not travel")


def _unique_string_keys(pairs: Iterable[tuple[object, Any]]) -> dict[object, Any]:
    listed = list(pairs)
    tree = dict(listed)
    for key in tree:
        if not isinstance(key, str):
            raise ValueError("a map key is not a string")
    if len(tree) != len(listed):
        raise ValueError("a key comes twice in one map")
    return tree


_FIXED = {0xCA: 4, 0xCB: 8, 0xCC: 1, 0xCD: 2, 0xCE: 4, 0xCF: 8, 0xD0: 1, 0xD1: 2, 0xD2: 4, 0xD3: 8}
_SIZED = {0xC4: 1, 0xC5: 2, 0xC6: 4, 0xD9: 1, 0xDA: 2, 0xDB: 4}
_CONTAINER = {0xDC: (2, 1), 0xDD: (4, 1), 0xDE: (2, 2), 0xDF: (4, 2)}


def _structure_problem(payload: bytes, limits: WireLimits) -> str | None:
    """Walk the MessagePack headers without building anything; what is wrong with them, or None.

    msgpack itself bounds depth at 1024 only, and sets aside as many list slots as a header claims. The walk
    runs out of bytes first. An array's data are one value however long: a real cloud takes some thirty steps.
    """
    position, end = 0, len(payload)
    pending = [1]  # values that each open map or list still has to come
    n_values = 1  # all that the headers so far claim
    while pending:
        if pending[-1] == 0:
            pending.pop()
            continue
        if position >= end:
            return f"truncated after {end} bytes"
        pending[-1] -= 1
        head = payload[position]
        position += 1
        children = 0
        if head <= 0x7F or head >= 0xE0:  # a small integer
            continue
        if head <= 0x8F:
            children = 2 * (head & 0x0F)
        elif head <= 0x9F:
            children = head & 0x0F
        elif head <= 0xBF:
            position += head & 0x1F
        elif head in (0xC0, 0xC2, 0xC3):  # nil, false, true
            continue
        elif head in _FIXED:
            position += _FIXED[head]
        elif head in _SIZED:
            width = _SIZED[head]
            position += width + int.from_bytes(payload[position : position + width], "big")
        elif head in _CONTAINER:
            width, per_item = _CONTAINER[head]
            n_items = int.from_bytes(payload[position : position + width], "big")
            position += width
            if n_items > limits.max_items:
                return f"a map or list of {n_items} entries, the limit is {limits.max_items}"
            children = per_item * n_items
        else:
            return f"byte {head:#04x} at {position - 1}: ext types are not part of the wire"
        n_values += children
        if n_values > limits.max_values:
            return f"more than {limits.max_values} values"
        if children:
            pending.append(children)
            if len(pending) - 1 > limits.max_depth:
                return f"nested deeper than {limits.max_depth}"
    if position != end:
        return (
            f"truncated after {end} bytes" if position > end else f"{end - position} bytes after the message"
        )
    return None
