"""What all messages share: typed errors, and checks before the bytes are touched."""

from __future__ import annotations

import inspect
from typing import Any

import pytest

from potschemas import messages, wire
from potschemas.messages import ErrorCode
from potserver import errors
from potserver.codec.base import check_encoding, check_size, decode, encode_error
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


def test_only_load_shutdown_and_a_full_disk_are_worth_another_try() -> None:
    retryable = {code for code, kind in error_classes().items() if kind.retryable}
    assert retryable == {"overloaded", "deadline", "shutting_down", "storage"}


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
