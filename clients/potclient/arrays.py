"""numpy arrays from messages and from callers, checked."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potclient.errors import BadReplyError, UsageError
from potschemas import messages
from potschemas.messages import DType
from potschemas.wire import WireError, decode_array

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]


def arrays_of(
    message: messages.Message, what: str, shapes: Mapping[str, tuple[int, ...]], dtype: DType = DType.FLOAT32
) -> dict[str, Any]:
    """Arrays of a message, by the names of its fields.

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


def as_points(points: ArrayLike) -> Float64:
    """(N, 3) float64; a third column of zeros is added to (N, 2), and one point of shape (3,) or (2,) becomes one row.

    Raises:
        UsageError: another shape, or coordinates that are not finite.
    """
    try:
        array = np.asarray(points, np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"points: not an array of numbers ({error})") from error
    if array.ndim == 1 and array.shape[0] in (2, 3):
        array = array[None, :]
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise UsageError(f"points: shape {array.shape}, need (N, 3) or (N, 2)")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise UsageError(f"points: {bad} of {len(array)} have NaN or infinite coordinates")
    if array.shape[1] == 2:
        array = np.concatenate([array, np.zeros((len(array), 1))], axis=1)
    return array
