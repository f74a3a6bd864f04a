"""What is sent is what arrives, for every message and array; and no bytes whatever break the decoder."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from msgspec import inspect as mi
from numpy.typing import NDArray

from potschemas.examples import examples
from potschemas.messages import ALL_MESSAGES, MAX_AXES, DType, Message
from potschemas.wire import WireError, decode, decode_array, encode, encode_array

EXAMPLES = list(examples().values())
KINDS = st.sampled_from(ALL_MESSAGES)


def values(kind: mi.Type) -> st.SearchStrategy[Any]:
    """Anything that a field of this type may hold."""
    if isinstance(kind, mi.StructType):
        fields = {field.name: values(field.type) for field in kind.fields}
        return st.fixed_dictionaries(fields).map(lambda given_fields: kind.cls(**given_fields))
    if isinstance(kind, mi.UnionType):
        return st.one_of([values(option) for option in kind.types])
    if isinstance(kind, mi.ListType):
        longest = 3 if kind.max_length is None else kind.max_length
        return st.lists(values(kind.item_type), min_size=kind.min_length or 0, max_size=longest)
    if isinstance(kind, mi.DictType):
        return st.dictionaries(values(kind.key_type), values(kind.value_type), max_size=3)
    if isinstance(kind, mi.IntType):
        assert kind.ge is not None
        assert kind.le is not None, "an integer without bounds does not fit every language"
        return st.integers(kind.ge, kind.le)
    if isinstance(kind, mi.FloatType):
        low = kind.ge if kind.ge is not None else kind.gt
        high = kind.le if kind.le is not None else kind.lt
        outside = {"exclude_min": kind.gt is not None, "exclude_max": kind.lt is not None}
        return st.floats(low, high, width=64, **outside)
    if isinstance(kind, mi.StrType):
        return st.from_regex(kind.pattern, fullmatch=True) if kind.pattern else st.text(max_size=20)
    if isinstance(kind, mi.EnumType):
        return st.sampled_from(list(kind.cls))
    if isinstance(kind, mi.Metadata):
        return values(kind.type)
    simple = {mi.BoolType: st.booleans(), mi.BytesType: st.binary(max_size=40), mi.NoneType: st.none()}
    return simple[type(kind)]


MESSAGES = {kind: values(mi.type_info(kind)) for kind in ALL_MESSAGES}


@given(data=st.data(), kind=KINDS)
def test_every_message_comes_back_as_it_went(data: st.DataObject, kind: type[Message]) -> None:
    message = data.draw(MESSAGES[kind])
    payload = encode(message)
    back = decode(payload, kind)
    assert repr(back) == repr(message)  # by text, because NaN is not equal to itself
    assert encode(back) == payload


@given(
    array=npst.arrays(
        st.sampled_from([np.dtype(d.value) for d in DType]),
        npst.array_shapes(min_dims=0, max_dims=MAX_AXES, min_side=0, max_side=4),
    )
)
def test_every_array_comes_back_as_it_went(array: NDArray[Any]) -> None:
    wire = encode_array(array)
    shape = tuple(wire.shape)
    back = decode_array(wire, "array", dtypes=tuple(DType), shape=shape)
    assert back.dtype == array.dtype
    np.testing.assert_array_equal(back, array)
    assert encode_array(back) == wire


@given(
    array=npst.arrays(np.float32, npst.array_shapes(min_dims=2, max_dims=3, max_side=5)),
    step=st.sampled_from([-2, -1, 1, 2]),
    big=st.booleans(),
)
def test_the_bytes_do_not_depend_on_the_memory_layout(array: NDArray[Any], step: int, big: bool) -> None:
    view = array.T[::step]
    other = view.astype(">f4") if big else view
    assert encode_array(other) == encode_array(np.ascontiguousarray(view))


@given(
    dtype=st.sampled_from(list(DType)),
    shape=st.lists(st.integers(0, 2**31 - 1) | st.integers(0, 4), max_size=4),
    data=st.binary(max_size=64),
)
def test_an_array_is_a_view_of_all_its_bytes_or_an_error(dtype: DType, shape: list[int], data: bytes) -> None:
    array = msgspec.convert({"dtype": dtype, "shape": shape, "data": data}, type(encode_array(np.zeros(1))))
    try:
        view = decode_array(array, "array", dtypes=tuple(DType), shape=(None,) * len(shape))
    except WireError:
        return
    assert view.shape == tuple(shape)
    assert view.tobytes() == data


@given(payload=st.binary(max_size=200), kind=KINDS)
def test_random_bytes_are_a_message_or_an_error(payload: bytes, kind: type[Message]) -> None:
    _decodes_or_refuses(payload, kind)


SPLICES = st.sampled_from(
    [
        *(b"", b"\xc0", b"\xc1", b"\x90", b"\x80", b"\xff"),
        *(b"\xdd\xff\xff\xff\xff", b"\xdf\x00\x00\x00\x01", b"\xc6\x7f\xff\xff\xff"),
        *(b"\xcf" + b"\xff" * 8, b"\xcb\x7f\xf8" + bytes(6), b"\xd7\xff" + bytes(8)),
    ]
)


@given(
    message=st.sampled_from(EXAMPLES),
    place=st.floats(0, 1, exclude_max=True),
    removed=st.integers(0, 4),
    splice=SPLICES | st.binary(max_size=4),
)
def test_a_damaged_message_is_a_message_or_an_error(
    message: Message, place: float, removed: int, splice: bytes
) -> None:
    payload = encode(message)
    at = int(place * len(payload))
    _decodes_or_refuses(payload[:at] + splice + payload[at + removed :], type(message))


@pytest.mark.parametrize("message", EXAMPLES)
def test_every_flipped_byte_is_a_message_or_an_error(message: Message) -> None:
    payload = encode(message)
    for at in range(min(len(payload), 400)):
        for flip in (0x01, 0x40, 0x80, 0xFF):
            _decodes_or_refuses(payload[:at] + bytes([payload[at] ^ flip]) + payload[at + 1 :], type(message))


def _decodes_or_refuses(payload: bytes, kind: type[Message]) -> None:
    try:
        message = decode(payload, kind)
    except WireError:
        return
    assert isinstance(message, kind)
    assert encode(decode(encode(message), kind)) == encode(message)
