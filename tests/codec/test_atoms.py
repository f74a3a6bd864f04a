"""Atoms on the wire and in files: what comes back is what was sent, and nothing unsound comes in."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from potschemas import messages, wire
from potschemas.answers import AnswerRule
from potserver import errors
from potserver.codec.atoms import decode_atom, encode_atom, read_atom_file
from potserver.domain.types import Atom
from potserver.errors import PotserverError
from tests.tiled_maps import free_kernels

RULE = AnswerRule(observed_activation=0.05, prior_var=50.0, residual_var=20.0, mean_moderation=0.25)


def atom(**changes: Any) -> Atom:
    fields: dict[str, Any] = {
        "atom_id": "wall.1",
        "dims": 3,
        "hit_points": np.ones((5, 3), np.float32),
        "free_points": np.zeros((2, 3), np.float32),
        "kernels": free_kernels(6),
        "radius_m": 20.0,
        "azimuth_width_rad": 1.0,
        "provenance": {"source": "tests"},
    }
    return Atom(**fields | changes)


def atom_message(of: Atom, **changes: Any) -> messages.Atom:
    return msgspec.structs.replace(encode_atom(of, {"wall.1": 3}, RULE), **changes)


def test_an_atom_comes_back_as_it_was() -> None:
    sent = atom()
    received = decode_atom(atom_message(sent), max_points=50)
    for name in ("atom_id", "dims", "radius_m", "azimuth_width_rad", "provenance"):
        assert getattr(received, name) == getattr(sent, name)
    for name in ("hit_points", "free_points"):
        np.testing.assert_array_equal(getattr(received, name), getattr(sent, name))
    np.testing.assert_allclose(received.kernels.hinge_mean, sent.kernels.hinge_mean, atol=2e-6, rtol=0)
    for name in ("hinge_var", "gamma_shape", "gamma_rate", "weight_mean", "weight_var"):
        np.testing.assert_array_equal(getattr(received.kernels, name), getattr(sent.kernels, name))
    again = read_atom_file(wire.encode(encode_atom(sent, {}, RULE)))
    np.testing.assert_array_equal(again.kernels.hinge_mean, received.kernels.hinge_mean)


def _with_kernels(**arrays: Any) -> messages.Atom:
    whole = atom_message(atom())
    return msgspec.structs.replace(whole, kernels=msgspec.structs.replace(whole.kernels, **arrays))


@pytest.mark.parametrize(
    ("message", "error"),
    [
        (atom_message(atom(), hit_points=wire.encode_array(np.ones((4, 3), np.float32))), errors.ShapeError),
        (atom_message(atom(), hit_points=wire.encode_array(np.ones((5, 2), np.float32))), errors.ShapeError),
        (
            atom_message(atom(), hit_points=wire.encode_array(np.full((5, 3), np.nan, np.float32))),
            errors.BadPointsError,
        ),
        (atom_message(atom(), hit_points=wire.encode_array(np.full((5, 3), 1e300))), errors.BadPointsError),
        (atom_message(atom(free_points=np.zeros((51, 3), np.float32))), errors.TooLargeError),
        (_with_kernels(gamma_rate=wire.encode_array(np.zeros(6, np.float32))), errors.ShapeError),
        (_with_kernels(weight_var=wire.encode_array(np.ones(5, np.float32))), errors.ShapeError),
    ],
)
def test_an_unsound_atom_is_a_typed_error(message: messages.Atom, error: type[PotserverError]) -> None:
    with pytest.raises(error):
        decode_atom(message, max_points=50)


def outcome(payload: bytes) -> str:
    """The code of the error, or `ok`; anything but a typed error is raised."""
    try:
        read_atom_file(payload)
    except PotserverError as error:
        return error.code
    return "ok"


@given(st.data())
def test_a_changed_byte_of_an_atom_is_an_atom_or_a_typed_error(data: st.DataObject) -> None:
    payload = bytearray(wire.encode(atom_message(atom())))
    payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    assert outcome(bytes(payload)) != "internal"


@given(st.binary(max_size=300))
def test_random_bytes_are_only_ever_typed_errors(payload: bytes) -> None:
    assert outcome(payload) != "internal"
