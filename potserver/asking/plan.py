"""What all questions share: plans that answer part by part, and the checks of points, corners and numbers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from potserver.domain.kernel_map import as_points
from potserver.domain.types import Float64
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError
from potserver.limits import Limits
from potserver.numerics.arrays import Int64

PartT = TypeVar("PartT", covariant=True)

_SHORT_SHARE = 16  # parts take some tens of milliseconds


class Plan(ABC, Generic[PartT]):
    """A question that passed its checks. All parts come from one snapshot; each is computed when it is asked for."""

    __slots__ = ()

    part_size: int  # items of a part, at most

    @property
    @abstractmethod
    def n_items(self) -> int:
        """Points, cells, rays or kernels of the whole answer."""

    @property
    def n_parts(self) -> int:
        """At least one, which may be empty; the last one may be smaller."""
        return max(1, -(-self.n_items // self.part_size))

    @property
    def is_short(self) -> bool:
        """About a millisecond of work, a small share of a part: it need not wait behind others."""
        return self.n_items * _SHORT_SHARE <= self.part_size

    def items(self, i: int) -> slice:
        """The items of part i."""
        return slice(i * self.part_size, min((i + 1) * self.part_size, self.n_items))

    @abstractmethod
    def part(self, i: int) -> PartT:
        """The answer about the items of part i, which is 0 to n_parts - 1."""

    def parts(self) -> Iterator[PartT]:
        """All parts in order."""
        return (self.part(i) for i in range(self.n_parts))


def pieces(sizes: Int64, run: slice) -> Iterator[tuple[int, slice]]:
    """Lists of these sizes, one behind the other: which of their items lie in a run."""
    ends = np.cumsum(sizes)
    first = np.searchsorted(ends, run.start, side="right")
    for number in range(int(first), len(sizes)):
        begun = int(ends[number] - sizes[number])
        if begun >= run.stop:
            return
        cut = slice(max(run.start - begun, 0), min(run.stop - begun, int(sizes[number])))
        if cut.stop > cut.start:
            yield number, cut


def checked_points(points: ArrayLike, limits: Limits) -> Float64:
    """(N, 3) float64 from (N, 3) or (N, 2) m, map frame.

    Raises:
        ShapeError: another shape. BadPointsError: NaN or infinite. OutOfRangeError: beyond `max_coordinate_m`.
    """
    array = as_points(points)
    check_extent(array, limits)
    return array


def checked_corner(corner: ArrayLike, limits: Limits) -> Float64:
    """(3,) float64 m, map frame: a corner of a box.

    Raises:
        ShapeError: another shape. BadPointsError: NaN or infinite. OutOfRangeError: beyond `max_coordinate_m`.
    """
    array = np.asarray(corner, np.float64)
    if array.shape != (3,):
        raise ShapeError(f"a corner of a box has shape {array.shape}, need (3,)")
    if not np.isfinite(array).all():
        raise BadPointsError("a corner of the box is NaN or infinite")
    check_extent(array, limits)
    return array


def checked_box(
    lower: ArrayLike | None, upper: ArrayLike | None, limits: Limits
) -> tuple[Float64 | None, Float64 | None]:
    """Both corners of a box; None = no bound on that side.

    Raises:
        As `checked_corner`.
    """
    return (
        None if lower is None else checked_corner(lower, limits),
        None if upper is None else checked_corner(upper, limits),
    )


def check_extent(array: Float64, limits: Limits) -> None:
    """Refuse finite coordinates, m, that no map may hold.

    Raises:
        OutOfRangeError: one is beyond `max_coordinate_m`.
    """
    farthest = float(np.abs(array).max(initial=0.0))
    if farthest > limits.max_coordinate_m:
        raise OutOfRangeError(
            f"a coordinate of {farthest:.3g} m, the limit is {limits.max_coordinate_m:.3g} m"
        )


def check_positive(name: str, value: float) -> None:
    """Refuse what is no positive finite number.

    Raises:
        BadPointsError: it is not.
    """
    if not (math.isfinite(value) and value > 0):
        raise BadPointsError(f"{name} is {value}, need a positive number")
