"""Decoding is total: any bytes give a message or a WireError with the right code."""

from __future__ import annotations

import math
import struct
import tracemalloc
import zlib
from typing import Any

import msgpack
import numpy as np
import pytest

from potschemas import messages as m
from potschemas.examples import examples
from potschemas.messages import ALL_MESSAGES, DType, ErrorCode
from potschemas.wire import (
    DEFAULT_LIMITS,
    MAX_DEPTH,
    MAX_ITEMS,
    MAX_STRING_BYTES,
    WireError,
    check_encoding,
    decode,
    decode_array,
    encode,
    encode_array,
    encoding_of,
    pack_array,
    schema_of,
    unpack_array,
)

EXAMPLES = examples()
POINTS = {"dtype": "<f4", "shape": [1, 3], "data": bytes(12)}
CLOUD = {"seq": 1, "stamp_ns": 2, "points": POINTS}
INF = math.inf


def packed(tree: object) -> bytes:
    data = msgpack.packb(tree)
    assert isinstance(data, bytes)
    return data


def code_of(payload: bytes, kind: type[m.Message] = m.Cloud) -> ErrorCode:
    with pytest.raises(WireError) as caught:
        decode(payload, kind)
    return caught.value.code


# --- round trip -------------------------------------------------------------------------------------


def test_an_encoding_is_the_bytes_of_a_plain_map() -> None:
    message = m.ErrorReply(code=ErrorCode.EMPTY, message="no points")
    tree = {"code": "empty", "message": "no points", "retryable": False, "retry_after_s": None}
    assert encode(message) == packed(tree)
    assert decode(packed(tree), m.ErrorReply) == message


def test_fields_with_defaults_may_be_left_out() -> None:
    cloud = decode(packed(CLOUD), m.Cloud)
    assert cloud == m.Cloud(seq=1, stamp_ns=2, points=encode_array(np.zeros((1, 3), np.float32)))


def test_numpy_scalars_become_plain_numbers() -> None:
    reply = m.ControlReply(verb="clear", map_revision=np.int64(3), message="")  # type: ignore[arg-type]
    query = m.GridQuery(
        lower=list(np.zeros(3, np.float32)), upper=[1.0, 1.0, 1.0], resolution=np.float64(0.5)
    )
    assert decode(encode(reply), m.ControlReply).map_revision == 3
    assert decode(encode(query), m.GridQuery).lower == [0.0, 0.0, 0.0]
    with pytest.raises(TypeError, match="does not travel"):
        encode(m.ControlReply(verb="clear", map_revision=0, message=object()))  # type: ignore[arg-type]


def test_unknown_fields_are_ignored_at_every_level() -> None:
    newer = {**CLOUD, "from_the_future": {"a": [1, None]}, "points": {**POINTS, "unit": "m"}}
    assert decode(packed(newer), m.Cloud) == decode(packed(CLOUD), m.Cloud)


@pytest.mark.parametrize("deadline", [5, 5.0, struct.pack(">Bf", 0xCA, 5.0)])
def test_a_float_field_takes_any_number_format(deadline: float | bytes) -> None:
    value = deadline if isinstance(deadline, bytes) else packed(deadline)
    payload = b"\x81" + packed("deadline_ms") + value
    assert decode(payload, m.ParamsQuery).deadline_ms == 5.0


# --- bytes that are no message ----------------------------------------------------------------------


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_message_cut_short_anywhere_is_refused(name: str) -> None:
    message = EXAMPLES[name]
    payload = encode(message)
    codes = {code_of(payload[:n], type(message)) for n in range(len(payload))}
    assert codes == {ErrorCode.BAD_MESSAGE}


@pytest.mark.parametrize("name", EXAMPLES)
def test_anything_behind_a_message_is_refused(name: str) -> None:
    message = EXAMPLES[name]
    with pytest.raises(WireError, match="1 bytes after the message"):
        decode(encode(message) + b"\xc0", type(message))


@pytest.mark.parametrize("kind", ALL_MESSAGES)
def test_an_empty_payload_is_no_message(kind: type[m.Message]) -> None:
    assert code_of(b"", kind) is ErrorCode.BAD_MESSAGE


@pytest.mark.parametrize("root", [None, True, 1, -1, 1.5, "text", b"bytes", [], [CLOUD], {}])
def test_a_payload_must_be_the_right_map(root: object) -> None:
    assert code_of(packed(root)) is ErrorCode.BAD_MESSAGE


@pytest.mark.parametrize("opening", [b"\x91", b"\x81\xa1a", b"\xdc\x00\x01", b"\xdf\x00\x00\x00\x01\xa1a"])
@pytest.mark.parametrize("depth", [MAX_DEPTH + 1, 1000, 5000, 100_000])
def test_deep_nesting_is_refused_by_the_limit(opening: bytes, depth: int) -> None:
    with pytest.raises(WireError, match=f"deeper than {MAX_DEPTH}"):
        decode(opening * depth + b"\xc0", m.Cloud)


def test_an_unknown_field_may_nest_up_to_the_limit() -> None:
    inside: Any = None
    for _ in range(MAX_DEPTH - 1):  # the message itself is one level
        inside = [inside]
    assert decode(packed({"new": inside}), m.InfoQuery) == m.InfoQuery()
    assert code_of(packed({"new": [inside]}), m.InfoQuery) is ErrorCode.BAD_MESSAGE


HUGE = {
    "array32": b"\xdd\xff\xff\xff\xff",
    "array32 of 100,000": b"\xdd" + MAX_ITEMS.to_bytes(4, "big"),
    "array16": b"\xdc\xff\xff",
    "map32": b"\xdf\xff\xff\xff\xff",
    "map16": b"\xde\xff\xff",
    "bin32": b"\xc6\xff\xff\xff\xff",
    "str32": b"\xdb\xff\xff\xff\xff",
    "a field of array32": b"\x81\xa3seq\xdd\xee\x6b\x28\x00",
    "a field of bin32": b"\x81\xa3seq\xc6\xee\x6b\x28\x00",
    "claims inside claims": (b"\xdd" + MAX_ITEMS.to_bytes(4, "big")) * MAX_DEPTH,
    "header cut short": b"\xdd\xff\xff",
}


@pytest.mark.parametrize("payload", HUGE.values(), ids=HUGE)
def test_a_claimed_length_allocates_nothing(payload: bytes) -> None:
    assert (
        code_of(payload) is ErrorCode.BAD_MESSAGE
    )  # once outside, so that nothing is measured but the decoding
    tracemalloc.start()
    try:
        code_of(payload)
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 200_000


def test_a_list_beyond_the_limit_is_refused_even_when_its_bytes_are_there() -> None:
    def listed(n: int) -> bytes:
        return b"\x81\xa1a\xdd" + n.to_bytes(4, "big") + b"\xc0" * n

    tight = DEFAULT_LIMITS._replace(max_items=1000)
    assert decode(listed(1000), m.InfoQuery, tight) == m.InfoQuery()
    with pytest.raises(WireError, match="the limit is 1000"):
        decode(listed(1001), m.InfoQuery, tight)
    with pytest.raises(WireError, match=f"the limit is {MAX_ITEMS}"):
        decode(listed(MAX_ITEMS + 1), m.InfoQuery)


def test_the_values_of_all_lists_together_are_bounded() -> None:
    tight = DEFAULT_LIMITS._replace(
        max_values=9
    )  # root, key, list of three, three lists of one: 1 + 2 + 3 + 3
    payload = packed({"a": [[1], [1], [1]]})
    assert decode(payload, m.InfoQuery, tight) == m.InfoQuery()
    with pytest.raises(WireError, match="more than 8 values"):
        decode(payload, m.InfoQuery, tight._replace(max_values=8))
    with pytest.raises(WireError, match="more than 99 values"):  # lists opened first thing inside one another
        decode(b"\x81\xa1a" + b"\xdc\x00\x28" * 3 + b"\xc0" * 118, m.InfoQuery, tight._replace(max_values=99))
    tiles = m.Revision(
        map="m", map_revision=1, stamp_ns=1, n_kernels=1, tile_size_m=1.0, changed_tiles=[[-1, 0, 1]] * 24_000
    )
    assert decode(encode(tiles), m.Revision) == tiles


def test_a_large_cloud_is_few_values() -> None:
    cloud = m.Cloud(
        seq=1,
        stamp_ns=1,
        points=encode_array(np.zeros((150_000, 3), np.float32)),
        T_map_sensor=encode_array(np.eye(4)),
        is_return=encode_array(np.ones(150_000, np.bool_)),
    )
    assert decode(encode(cloud), m.Cloud, DEFAULT_LIMITS._replace(max_values=50)) == cloud


def test_too_many_bytes_are_refused_unread() -> None:
    limits = DEFAULT_LIMITS._replace(max_bytes=100)
    with pytest.raises(WireError, match="101 bytes, the limit is 100") as caught:
        decode(b"\xc1" * 101, m.Cloud, limits)
    assert caught.value.code is ErrorCode.TOO_LARGE


@pytest.mark.parametrize(
    "value",
    [
        b"\xc1",  # never used
        b"\xd4\x01\x00",
        b"\xd5\x01\x00\x00",
        b"\xd6\xff\x00\x00\x00\x00",  # a timestamp
        b"\xd7\xff" + bytes(8),
        b"\xd8\x01" + bytes(16),
        b"\xc7\x01\x01\x00",
        b"\xc8\x00\x01\x01\x00",
        b"\xc9\x00\x00\x00\x01\x01\x00",
        msgpack.packb(msgpack.Timestamp(1, 1)),
    ],
)
def test_ext_types_are_refused_even_in_unknown_fields(value: bytes) -> None:
    with pytest.raises(WireError, match="ext types"):
        decode(b"\x81\xa1a" + value, m.InfoQuery)


@pytest.mark.parametrize(
    "key", [b"\x01", b"\xc0", b"\xc2", b"\xc4\x01a", b"\x90", b"\x80", b"\xca\x00\x00\x00\x00"]
)
def test_map_keys_must_be_strings(key: bytes) -> None:
    assert code_of(b"\x81" + key + b"\x01", m.InfoQuery) is ErrorCode.BAD_MESSAGE
    assert code_of(b"\x81\xa1a\x81" + key + b"\x01", m.InfoQuery) is ErrorCode.BAD_MESSAGE


def test_a_key_twice_is_refused() -> None:
    with pytest.raises(WireError, match="comes twice"):
        decode(b"\x82\xa3seq\x01\xa3seq\x02", m.Cloud)
    with pytest.raises(WireError, match="comes twice"):
        decode(b"\x81\xa1a\x82\xa1b\x01\xa1b\x01", m.InfoQuery)


@pytest.mark.parametrize("bad", [b"\xff", b"\xc3\x28", b"\xed\xa0\x80", b"\xc0\x80"])
def test_strings_must_be_utf8(bad: bytes) -> None:
    text = bytes([0xA0 | len(bad)]) + bad
    assert code_of(b"\x81\xa1a" + text, m.InfoQuery) is ErrorCode.BAD_MESSAGE
    assert code_of(b"\x81" + text + b"\x01", m.InfoQuery) is ErrorCode.BAD_MESSAGE


def test_a_string_beyond_the_limit_is_refused() -> None:
    assert decode(packed({"a": "x" * MAX_STRING_BYTES}), m.InfoQuery) == m.InfoQuery()
    assert code_of(packed({"a": "x" * (MAX_STRING_BYTES + 1)}), m.InfoQuery) is ErrorCode.BAD_MESSAGE


def test_an_error_text_stays_short_whatever_was_sent() -> None:
    reply = {"code": "x" * 60_000, "message": ""}
    with pytest.raises(WireError) as caught:
        decode(packed(reply), m.ErrorReply)
    assert len(str(caught.value)) < 320


# --- maps that are not this message ------------------------------------------------------------------


@pytest.mark.parametrize(
    "change",
    [
        {"seq": -1},
        {"seq": 2**63},
        {"seq": 1.0},
        {"seq": True},
        {"seq": "1"},
        {"seq": None},
        {"stamp_ns": 2**64 - 1},
        {"points": None},
        {"points": [[0.0, 0.0, 0.0]]},
        {"points": b"abc"},
        {"points": {}},
        {"points": {"dtype": "<f4", "shape": [0, 3]}},
        {"robot": ""},
        {"robot": "R1"},
        {"robot": "r1\n"},
        {"robot": "r" * 64},
        {"robot": 1},
    ],
)
def test_a_field_of_a_wrong_type_or_range_is_refused(change: dict[str, Any]) -> None:
    assert code_of(packed({**CLOUD, **change})) is ErrorCode.BAD_MESSAGE


@pytest.mark.parametrize("field", CLOUD)
def test_a_missing_field_is_named(field: str) -> None:
    tree = {name: value for name, value in CLOUD.items() if name != field}
    with pytest.raises(WireError, match=f"missing required field `{field}`"):
        decode(packed(tree), m.Cloud)


@pytest.mark.parametrize(
    "change",
    [
        {"dtype": ">f4"},
        {"dtype": "f4"},
        {"dtype": "<f2"},
        {"dtype": "<u4"},
        {"dtype": "|O"},
        {"dtype": "O"},
        {"dtype": "<M8[ns]"},
        {"dtype": "|V8"},
        {"dtype": "float32"},
        {"dtype": ""},
        {"dtype": 4},
        {"shape": [-1, 3]},
        {"shape": [1.0, 3]},
        {"shape": [2**31]},
        {"shape": [2**63]},
        {"shape": [1, 1, 1, 1, 3]},
        {"shape": 3},
        {"shape": "3"},
        {"data": "AAAA"},  # base64 would be four bytes more of somebody's time
        {"data": [0] * 12},
        {"data": None},
    ],
)
def test_a_wrong_part_of_an_array_is_a_bad_array(change: dict[str, Any]) -> None:
    assert code_of(packed({**CLOUD, "points": {**POINTS, **change}})) is ErrorCode.BAD_ARRAY
    nested = {"part": 0, "n_parts": 1, "map_revision": 0, "kernels": tree_of("pot.kernels.v1")}
    assert decode(packed(nested), m.ParamsPart).n_parts == 1
    nested["kernels"]["weight_var"] = {**POINTS, **change}
    assert code_of(packed(nested), m.ParamsPart) is ErrorCode.BAD_ARRAY


def test_a_grids_own_shape_is_not_an_array() -> None:
    tree = {**tree_of("pot.grid_part.v1"), "shape": [1, 2]}
    assert code_of(packed(tree), m.GridPart) is ErrorCode.BAD_MESSAGE


@pytest.mark.parametrize("bad", [math.nan, INF, -INF])
@pytest.mark.parametrize(
    ("name", "path"),
    [
        ("pot.kernels.v1", ["observed_activation"]),
        ("pot.kernels.v1", ["prior_var"]),
        ("pot.kernels.v1", ["residual_var"]),
        ("pot.kernels.v1", ["origin", 1]),
        ("pot.receipt.v1", ["wait_ms"]),
        ("pot.receipt.v1", ["sectors", 0, "azimuth_min_rad"]),
        ("pot.revision.v1", ["tile_size_m"]),
        ("pot.points_query.v1", ["deadline_ms"]),
        ("pot.grid_query.v1", ["lower", 0]),
        ("pot.grid_query.v1", ["upper", 2]),
        ("pot.grid_query.v1", ["resolution"]),
        ("pot.grid_part.v1", ["resolution"]),
        ("pot.params_query.v1", ["lower", 0]),
        ("pot.atom.v1", ["info", "radius_m"]),
        ("pot.info.v1", ["lower", 0]),
        ("pot.info.v1", ["limits", "max_range_m"]),
        ("pot.stats.v1", ["uptime_s"]),
        ("pot.control.v1", ["timeout_s"]),
        ("pot.error.v1.retry", ["retry_after_s"]),
    ],
)
def test_nan_and_infinity_are_refused(name: str, path: list[str | int], bad: float) -> None:
    tree = node = tree_of(name)
    for step in path[:-1]:
        node = node[step]
    assert isinstance(node[path[-1]], float)
    node[path[-1]] = bad
    assert code_of(packed(tree), type(EXAMPLES[name])) is ErrorCode.BAD_MESSAGE


def test_what_was_not_measured_may_be_nan_or_infinite() -> None:
    receipt = EXAMPLES["pot.receipt.v1"]
    left_out = decode(encode(receipt), m.Receipt).sectors[1]
    assert left_out.atom_id is None
    assert math.isinf(left_out.w2_m2)
    assert math.isnan(left_out.marginal_error)


@pytest.mark.parametrize("field", ["resolution", "deadline_ms"])
@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0])
def test_edges_and_deadlines_are_positive(field: str, bad: float) -> None:
    assert code_of(packed({**tree_of("pot.grid_query.v1"), field: bad}), m.GridQuery) is ErrorCode.BAD_MESSAGE


def test_codes_that_are_not_in_the_contract_are_refused() -> None:
    assert code_of(packed({"code": "teapot", "message": ""}), m.ErrorReply) is ErrorCode.BAD_MESSAGE


def tree_of(name: str) -> Any:
    return msgpack.unpackb(encode(EXAMPLES[name]))


# --- arrays -----------------------------------------------------------------------------------------


def wire_array(dtype: DType, shape: list[int], data: bytes) -> m.Array:
    return m.Array(dtype=dtype, shape=shape, data=data)


@pytest.mark.parametrize("order", ["<", ">", "="])
@pytest.mark.parametrize("layout", ["C", "F"])
def test_any_memory_layout_travels_as_little_endian_c_order(order: str, layout: Any) -> None:
    native = np.arange(6, dtype=np.float32).reshape(2, 3)
    array = encode_array(np.asarray(native, dtype=np.dtype("f4").newbyteorder(order), order=layout))  # type: ignore[call-overload]
    assert array == wire_array(DType.FLOAT32, [2, 3], struct.pack("<6f", *range(6)))


def test_a_strided_view_travels_as_what_it_shows() -> None:
    array = encode_array(np.arange(10, dtype=np.int64)[::-2])
    assert array == wire_array(DType.INT64, [5], struct.pack("<5q", 9, 7, 5, 3, 1))


@pytest.mark.parametrize("dtype", ["f2", "i4", "u4", "u8", "c8", "O", "U3", "S3", "M8[ns]", "f4,f4"])
def test_other_element_types_do_not_travel(dtype: str) -> None:
    with pytest.raises(WireError, match="does not travel") as caught:
        encode_array(np.zeros(2, dtype))
    assert caught.value.code is ErrorCode.BAD_ARRAY


def test_more_axes_than_the_wire_has_do_not_travel() -> None:
    assert encode_array(np.zeros((1, 1, 1, 1), np.float32)).shape == [1, 1, 1, 1]
    with pytest.raises(WireError, match="at most 4 axes"):
        encode_array(np.zeros((1, 1, 1, 1, 1), np.float32))
    with pytest.raises(WireError, match="does not travel"):
        encode_array(np.zeros((0, 2**31), np.float32))


def test_a_decoded_array_is_a_read_only_view() -> None:
    array = encode_array(np.ones((2, 3), np.float32))
    view = decode_array(array, "points", dtypes=(DType.FLOAT32,), shape=(None, (2, 3)))
    assert view.shape == (2, 3)
    assert not view.flags.writeable
    assert not view.flags.owndata


@pytest.mark.parametrize(
    ("array", "shape", "text"),
    [
        (wire_array(DType.FLOAT64, [1, 3], bytes(24)), (None, 3), "dtype <f8, need <f4 or \\|b1"),
        (wire_array(DType.FLOAT32, [3], bytes(12)), (None, 3), r"shape \(3,\), need \(any, 3\)"),
        (wire_array(DType.FLOAT32, [1, 4], bytes(16)), (None, 3), r"shape \(1, 4\)"),
        (wire_array(DType.FLOAT32, [1, 4], bytes(16)), (None, (2, 3)), r"need \(any, \(2, 3\)\)"),
        (wire_array(DType.FLOAT32, [2, 3], bytes(24)), (1, 3), r"need \(1, 3\)"),
        (wire_array(DType.FLOAT32, [], bytes(4)), (None,), r"shape \(\)"),
        (wire_array(DType.FLOAT32, [1, 3], bytes(11)), (None, 3), "11 bytes"),
        (wire_array(DType.FLOAT32, [1, 3], bytes(13)), (None, 3), "13 bytes"),
        (wire_array(DType.FLOAT32, [1, 3], b""), (None, 3), "0 bytes"),
        (wire_array(DType.FLOAT32, [0, 3], bytes(12)), (None, 3), "12 bytes"),
        (wire_array(DType.FLOAT32, [2**31 - 1] * 4, b""), (None,) * 4, "0 bytes"),
        (
            wire_array(DType.FLOAT32, [2**31, 2**31, 4, 1], b""),
            (None,) * 4,
            "0 bytes",
        ),  # 2^64 elements: 0 in 64 bits
        (wire_array(DType.FLOAT32, [0, 2**31 - 1, 2**31 - 1, 2**31 - 1], b""), (None,) * 4, "too big"),
        (wire_array(DType.BOOL, [2], b"\x01\x02"), (None,), "the byte 0 or 1"),
        (wire_array(DType.BOOL, [1], b"\xff"), (None,), "the byte 0 or 1"),
    ],
)
def test_an_array_that_is_not_as_asked_is_refused(array: m.Array, shape: Any, text: str) -> None:
    with pytest.raises(WireError, match=f"^points: .*{text}") as caught:
        decode_array(array, "points", dtypes=(DType.FLOAT32, DType.BOOL), shape=shape)
    assert caught.value.code is ErrorCode.BAD_ARRAY


# --- encodings --------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL_MESSAGES)
def test_an_encoding_names_its_schema(kind: type[m.Message]) -> None:
    encoding = encoding_of(kind)
    assert encoding == f"application/msgpack;{kind.schema}"
    assert schema_of(encoding) == kind.schema
    check_encoding(encoding, kind)


def test_a_message_has_the_encoding_of_its_class() -> None:
    assert encoding_of(EXAMPLES["pot.cloud.v1"]) == encoding_of(m.Cloud)


@pytest.mark.parametrize(
    ("encoding", "schema"),
    [
        ("application/msgpack;pot.cloud.v1", "pot.cloud.v1"),
        ("application/msgpack; pot.cloud.v1 ", "pot.cloud.v1"),
        ("zenoh/bytes;pot.cloud.v1", "pot.cloud.v1"),
        ("application/msgpack", None),
        ("application/msgpack;", None),
        ("zenoh/bytes", None),
        ("", None),
        ("application/json;pot.cloud.v1", None),
        ("text/plain;utf-8", None),
    ],
)
def test_the_schema_is_read_from_an_encoding(encoding: str, schema: str | None) -> None:
    assert schema_of(encoding) == schema


@pytest.mark.parametrize("encoding", ["", "zenoh/bytes", "application/msgpack", "application/msgpack;"])
def test_an_encoding_that_says_nothing_passes(encoding: str) -> None:
    check_encoding(encoding, m.Cloud)


@pytest.mark.parametrize(
    "encoding",
    [
        "application/msgpack;pot.pose.v1",
        "application/msgpack;pot.cloud.v2",
        "application/msgpack;pot.cloud.v1;x",
        "zenoh/bytes;pot.pose.v1",
        "application/json",
        "application/json;pot.cloud.v1",
        "application/cdr",
        "zenoh/string",
        "application/msgpack;" + "x" * 10_000,
    ],
)
def test_an_encoding_that_says_something_else_is_refused(encoding: str) -> None:
    with pytest.raises(WireError, match=r"need 'application/msgpack;pot\.cloud\.v1'") as caught:
        check_encoding(encoding, m.Cloud)
    assert caught.value.code is ErrorCode.BAD_MESSAGE


# --- packed arrays ----------------------------------------------------------------------------------


def unpacked(deflated: bytes, shape: list[int], *, dtype: DType = DType.FLOAT32, limit: int = 1000) -> Any:
    array = m.Packed(dtype=dtype, shape=shape, deflated=deflated)
    return unpack_array(
        array, "numbers", dtypes=(DType.FLOAT32, DType.BOOL), shape=(None,) * len(shape), max_elements=limit
    )


def test_a_packed_array_holds_its_bytes_by_planes() -> None:
    numbers = np.array([[1.5, -2.0], [0.25, 3.0]], np.float32)
    packed_array = pack_array(numbers)
    planes = np.frombuffer(zlib.decompress(packed_array.deflated), np.uint8).reshape(4, 4)
    assert [bytes(planes[:, i]) for i in range(4)] == [struct.pack("<f", v) for v in (1.5, -2.0, 0.25, 3.0)]
    np.testing.assert_array_equal(unpacked(packed_array.deflated, [2, 2]), numbers)
    assert pack_array(numbers.astype(">f4")) == packed_array


STREAM = pack_array(np.arange(8, dtype=np.float32)).deflated


@pytest.mark.parametrize(
    ("deflated", "shape", "message"),
    [
        (STREAM[:-1], [8], "does not end"),
        (STREAM[: len(STREAM) // 2], [8], "does not end"),
        (STREAM + b"\x00", [8], "does not end"),
        (STREAM + STREAM, [8], "does not end"),
        (STREAM, [7], "does not end"),
        (STREAM, [9], "does not end"),
        (STREAM, [0], "does not end"),
        (STREAM[:-1] + b"\x00", [8], "not a zlib stream"),  # its checksum
        (zlib.compress(bytes(32))[2:-4], [8], "not a zlib stream"),  # deflated, without the frame
        (b"", [8], "does not end"),
        (b"", [0], "does not end"),
        (bytes(32), [8], "not a zlib stream"),
    ],
)
def test_a_stream_of_another_length_or_none_is_refused(
    deflated: bytes, shape: list[int], message: str
) -> None:
    with pytest.raises(WireError, match=message) as caught:
        unpacked(deflated, shape)
    assert caught.value.code is ErrorCode.BAD_ARRAY


def test_a_packed_array_of_another_form_is_refused() -> None:
    with pytest.raises(WireError, match="dtype"):
        unpacked(pack_array(np.arange(3)).deflated, [3], dtype=DType.INT64)
    with pytest.raises(WireError, match="0 or 1"):
        unpacked(pack_array(np.array([0, 2], np.uint8)).deflated, [2], dtype=DType.BOOL)
    with pytest.raises(WireError, match="shape"):
        unpack_array(
            pack_array(np.zeros(3)), "numbers", dtypes=(DType.FLOAT64,), shape=(3, 1), max_elements=9
        )


@pytest.mark.parametrize("shape", [[1001], [2**31 - 1], [2**31 - 1] * 4])
def test_no_more_is_inflated_than_the_limit(shape: list[int]) -> None:
    with pytest.raises(WireError, match="limit is 1000") as caught:
        unpacked(STREAM, shape)
    assert caught.value.code is ErrorCode.TOO_LARGE


def test_a_bomb_is_not_inflated() -> None:
    bomb = zlib.compress(bytes(2**28), 9)
    tracemalloc.start()
    try:
        with pytest.raises(WireError, match="does not end"):
            unpacked(bomb, [8])
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 2**20
