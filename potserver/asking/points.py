"""Occupancy at any points."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

from numpy.typing import ArrayLike

from potserver.asking.plan import Plan, checked_points
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Float64, Occupancy
from potserver.errors import TooLargeError
from potserver.limits import Limits

PART_POINTS = 32_768  # of a part: some tens of milliseconds of work


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Points:
    """What is asked."""

    points: ArrayLike  # (N, 3) or (N, 2) m, map frame
    with_gradient: bool = False  # answer the gradients of the mean and of the latent mean too
    evidence_only: bool = False  # nothing is borrowed: what is not observed is unknown

    def plan(self, snapshot: KernelMap, limits: Limits, *, part_points: int = PART_POINTS) -> PointsPlan:
        """Check the question.

        Raises:
            ShapeError, BadPointsError, OutOfRangeError: of the points.
            TooLargeError: too many points.
        """
        points = checked_points(self.points, limits)
        if len(points) > limits.max_query_points:
            raise TooLargeError(f"{len(points)} points in one query, the limit is {limits.max_query_points}")
        return PointsPlan(snapshot, points, self.with_gradient, self.evidence_only, part_size=part_points)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class PointsPlan(Plan[Occupancy]):
    """Points that passed their checks."""

    snapshot: KernelMap
    points: Float64  # (N, 3) m, map frame
    with_gradient: bool
    evidence_only: bool
    part_size: int

    @property
    def n_items(self) -> int:
        """Points."""
        return len(self.points)

    def part(self, i: int) -> Occupancy:
        """The answers at a run of the points, in the order asked."""
        points = self.points[self.items(i)]
        ask = self.snapshot.occupancy_with_gradient if self.with_gradient else self.snapshot.occupancy
        return ask(points, evidence_only=self.evidence_only)

    def result(self, parts: Iterable[Occupancy]) -> Occupancy:
        """The answer, from all parts in order."""
        return Occupancy.concatenate(list(parts))
