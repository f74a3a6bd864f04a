"""Atoms as a client makes and reads them; and errors as replies carry them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from potclient.atoms import Atom
from potclient.errors import UsageError, error_from_reply
from potclient.kernels import KernelSet
from potschemas import messages
from potschemas.examples import examples
from potschemas.messages import ErrorCode
from potschemas.wire import decode, encode


def test_arrays_that_are_no_atom(tmp_path: Path) -> None:
    kernels = KernelSet.from_message(examples()[messages.Kernels.schema])
    sector = {"dims": 3, "radius_m": 1.0, "azimuth_width_rad": 1.0}
    for hits in (np.zeros((3, 2)), "no numbers", np.zeros(3)):
        with pytest.raises(UsageError, match="hit_points"):
            Atom.create("a", hits, np.zeros((1, 3)), kernels, **sector)
    with pytest.raises(UsageError, match="dimensions"):
        Atom.create("a", np.zeros((1, 3)), np.zeros((1, 3)), kernels, **sector | {"dims": 4})
    with pytest.raises(UsageError, match="No such file"):
        Atom.load(tmp_path / "none.atom")
    (tmp_path / "x.atom").write_bytes(b"PK nonsense")
    with pytest.raises(UsageError, match="potserver atoms export"):
        Atom.load(tmp_path / "x.atom")


def test_the_reason_of_a_refusal_is_kept() -> None:
    reply = messages.ErrorReply(code=ErrorCode.ATOM_REFUSED, message="a twin", reason="duplicate")
    assert error_from_reply(decode(encode(reply), messages.ErrorReply)).reason == "duplicate"
