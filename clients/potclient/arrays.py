"""The types of arrays, and arrays from messages, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from potclient.errors import BadReplyError
from potschemas import messages
from potschemas.messages import DType
from potschemas.wire import WireError, decode_array

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]  # of either width
Bool = NDArray[np.bool_]


def arrays_of(
    message: messages.Message,
    what: str,
    shapes: Mapping[str, tuple[int | None, ...]],
    dtype: DType = DType.FLOAT32,
) -> dict[str, Any]:
    """Arrays of a message, by the names of its fields; None stands for any length.

    Raises:
        BadReplyError: one is absent, or of another dtype, shape or byte count.
    """
    arrays = {}
    for name, shape in shapes.items():
        array = getattr(message, name)
        if array is messages.ABSENT:
            raise BadReplyError(f"{what}: no {name} came; the server is older than this question")
        try:
            arrays[name] = decode_array(array, f"{what}.{name}", dtypes=(dtype,), shape=shape)
        except WireError as error:
            raise BadReplyError(str(error)) from error
    return arrays
