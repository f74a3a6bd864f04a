"""What all messages share: typed errors, and checks before the bytes are touched."""

from __future__ import annotations

import inspect
from typing import Any

import msgpack
import pytest

from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potschemas.messages import ErrorCode
from potserver import errors
from potserver.codec.atoms import encode_atom
from potserver.codec.base import check_encoding, check_size, decode, encode_error
from potserver.codec.clouds import UNKNOWN_SEQ, decode_cloud_head
from potserver.domain.dictionary import AtomDictionary
from potserver.domain.types import Atom
from potserver.errors import PotserverError, error_classes


def test_every_code_has_one_class_and_every_class_a_code() -> None:
    assert set(error_classes()) == {code.value for code in ErrorCode}
    for code, kind in error_classes().items():
        assert kind.code == code
    for _, kind in inspect.getmembers(errors, inspect.isclass):
        if issubclass(kind, PotserverError):
            ErrorCode(kind.code)


@pytest.mark.parametrize("code", ErrorCode)
def test_errors_travel_by_code(code: ErrorCode) -> None:
    error = error_classes()[code.value]("because", retry_after_s=0.5)
    reply = wire.decode(encode_error(error).payload, messages.ErrorReply)
    assert reply == messages.ErrorReply(
        code=code, message="because", retryable=error.retryable, retry_after_s=0.5
    )


def test_only_load_shutdown_and_the_disk_are_worth_another_try() -> None:
    retryable = {code for code, kind in error_classes().items() if kind.retryable}
    assert retryable == {"overloaded", "too_many", "deadline", "shutting_down", "storage", "map_damaged"}


@pytest.mark.parametrize("code", [ErrorCode.TOO_LARGE, ErrorCode.BAD_MESSAGE, ErrorCode.BAD_ARRAY])
def test_wire_errors_become_typed_ones(code: ErrorCode, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise wire.WireError(code, "text")

    monkeypatch.setattr(wire, "decode", fail)
    with pytest.raises(error_classes()[code.value], match="text"):
        decode(b"", messages.InfoQuery)


def test_a_reason_travels_and_none_leaves_the_bytes_as_they_were() -> None:
    refused = encode_error(errors.AtomRefusedError("because", reason="duplicate"))
    assert wire.decode(refused.payload, messages.ErrorReply).reason == "duplicate"
    plain = encode_error(errors.EmptyError("because"))
    assert b"reason" not in plain.payload
    assert wire.decode(plain.payload, messages.ErrorReply).reason is messages.ABSENT


def test_sizes_and_encodings() -> None:
    check_size(10, 10, "cloud")
    with pytest.raises(errors.TooLargeError, match="cloud of 11 bytes"):
        check_size(11, 10, "cloud")
    for encoding in (None, "", "zenoh/bytes", "application/msgpack", "application/msgpack;pot.cloud.v1"):
        check_encoding(encoding, messages.Cloud)
    with pytest.raises(errors.BadMessageError, match=r"pot\.pose\.v1"):
        check_encoding("application/msgpack;pot.pose.v1", messages.Cloud)
    with pytest.raises(errors.BadMessageError, match="application/json"):
        check_encoding("application/json", messages.Cloud)


def test_an_empty_payload_is_a_message_of_defaults() -> None:
    for kind in (
        messages.InfoQuery,
        messages.StatsQuery,
        messages.AtomsQuery,
        messages.ParamsQuery,
        messages.ControlRequest,
    ):
        assert decode(b"", kind) == kind()
    with pytest.raises(errors.BadMessageError):
        decode(b"", messages.GridQuery)


@pytest.mark.parametrize(
    "filler", [[0] * 1990, [{}] * 1990, {f"k{i}": [] for i in range(995)}], ids=["numbers", "maps", "keys"]
)
def test_a_request_of_many_values_is_refused_before_it_is_walked(filler: Any) -> None:
    """Walking 100,000 values would hold the interpreter for 30 ms, and one client can send many such messages a second."""
    fits = msgpack.packb({"filler": filler})
    assert decode(fits, messages.InfoQuery, 10**6) == messages.InfoQuery()
    assert decode_cloud_head(fits).seq == UNKNOWN_SEQ
    more = msgpack.packb({"filler": filler, "more": [0] * 10})
    with pytest.raises(errors.BadMessageError, match="more than 2000 values"):
        decode(more, messages.InfoQuery, 10**6)
    with pytest.raises(errors.BadMessageError, match="entries, the limit is 2000"):
        decode(msgpack.packb([0] * 2001), messages.InfoQuery, 10**6)


@pytest.mark.parametrize("atom", AtomDictionary.builtin().atoms[::20], ids=lambda atom: atom.atom_id)
def test_the_largest_requests_are_far_below(atom: Atom) -> None:
    whole = encode_atom(atom, {}, AnswerRule())
    query = messages.AtomsQuery(action=messages.AtomsAction.ADD, atom=whole)
    payload = wire.encode(query)
    assert decode(payload, messages.AtomsQuery, len(payload)) == query
