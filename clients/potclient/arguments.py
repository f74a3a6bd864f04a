"""Checks of what callers pass in; what fails them is a `UsageError`, and nothing is sent."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from potclient.arrays import Float64
from potclient.errors import UsageError
from potschemas.keys import MapKeys, check_id, check_map_id, check_root
from potschemas.messages import Unknown


def legal_id(value: str, what: str) -> str:
    """An id of a robot, server, verb or saved map."""
    try:
        return check_id(value, what)
    except ValueError as error:
        raise UsageError(str(error)) from error


def map_keys(root: str, map_id: str) -> MapKeys:
    """The keys of one map, by the rules that a server's settings follow."""
    try:
        return MapKeys(check_root(root), check_map_id(map_id))
    except ValueError as error:
        raise UsageError(str(error)) from error


def numbers(value: ArrayLike, name: str, dtype: DTypeLike = np.float64) -> NDArray[Any]:
    """An array of numbers, of any shape."""
    try:
        return np.asarray(value, dtype)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{name}: not an array of numbers ({error})") from error


def as_points(points: ArrayLike) -> Float64:
    """(N, 3) float64; a third column of zeros is added to (N, 2), and one point of shape (3,) or (2,) becomes one row.

    Raises:
        UsageError: another shape, or coordinates that are not finite.
    """
    array = numbers(points, "points")
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


def pose(value: ArrayLike, name: str = "T_map_sensor") -> Float64:
    """(4, 4) float64. Whether it is rigid is left to the server."""
    array = numbers(value, name)
    if array.shape != (4, 4):
        raise UsageError(f"{name}: shape {array.shape}, need (4, 4)")
    return array


def corner(value: ArrayLike, name: str) -> Float64:
    """(3,) float64, m, map frame."""
    array = numbers(value, name)
    if array.shape != (3,) or not np.isfinite(array).all():
        raise UsageError(f"{name}: need three finite numbers (x y z, m, map frame), not {value!r}")
    return array


def positive(value: float, name: str) -> float:
    """A length, m."""
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{name} is {value}, need a positive number of metres")
    return float(value)


def positive_or_none(value: float | None, name: str) -> float | None:
    """A length, m, that the server chooses where it is None."""
    return None if value is None else positive(value, name)


def unknown_kind(value: Unknown | str) -> Unknown:
    """What unobserved space is taken for."""
    try:
        return Unknown(value)
    except ValueError as error:
        names = ", ".join(kind.value for kind in Unknown)
        raise UsageError(f"unknown space as {value!r}: need one of {names}") from error
