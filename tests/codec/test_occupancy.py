"""Answers about points on the wire."""

from __future__ import annotations

import numpy as np

from potschemas import messages, wire
from potschemas.messages import DType
from potserver.codec.base import encode
from potserver.codec.occupancy import encode_occupancy
from potserver.domain.types import Occupancy


def array(of: messages.Array) -> np.ndarray:
    return wire.decode_array(of, "array", dtypes=tuple(DType), shape=(None,) * len(of.shape))


def test_no_answer_is_rounded_up_to_certainty() -> None:
    n = 3
    occupancy = Occupancy(
        mean=np.array([1.0 - 1e-12, 0.25, 1e-12]),
        var=np.zeros(n),
        latent_mean=np.zeros(n, np.float32),
        latent_var=np.zeros(n, np.float32),
        observed=np.array([True, False, True]),
        borrowed=np.zeros(n, np.float32),
        map_revision=4,
    )
    message = encode(encode_occupancy(occupancy))
    assert message.encoding == "application/msgpack;pot.occupancy.v1"
    reply = wire.decode(message.payload, messages.Occupancy)
    mean = array(reply.mean)
    assert mean.dtype == np.float32
    assert mean.min() > 0
    assert mean.max() < 1
    assert array(reply.observed).tolist() == [True, False, True]
    assert reply.map_revision == 4
