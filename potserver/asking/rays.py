"""Where rays first return."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from potserver.asking.plan import Plan, check_positive, checked_points
from potserver.domain.kernel_map import KernelMap, as_points
from potserver.domain.types import Float64, Unknown
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.rays import FirstReturns

QUANTILES = (0.05, 0.5, 0.95)  # of the range, where a question names none
PART_SAMPLES = 200_000  # steps of a part, about: some tens of milliseconds of work
_MAX_QUANTILES = 16


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """What is asked; `numerics.rays` has the model."""

    origins: ArrayLike  # (N, 3) or (N, 2) m, map frame
    directions: ArrayLike  # (N, 3) or (N, 2), map frame, of any length but 0
    max_range_m: float  # of all rays
    quantiles: ArrayLike = QUANTILES  # (Q,) ascending, in (0, 1), of the range to answer
    unknown: Unknown = Unknown.PRIOR  # what rays take unobserved space for
    width_m: float | None = None  # over which an occupancy probability is one trial; None = the kernels' own
    step_m: float | None = None  # longest step of the summation; None = `KernelMap.fine_step_m`
    evidence_only: bool = False  # nothing is borrowed: what is not observed is unknown

    def plan(self, snapshot: KernelMap, limits: Limits, *, part_samples: int = PART_SAMPLES) -> RaysPlan:
        """Check the question.

        Raises:
            ShapeError, BadPointsError, OutOfRangeError: of the rays or the options.
            TooLargeError: too many rays, or steps of them.
        """
        origins, directions = checked_points(self.origins, limits), as_points(self.directions)
        if len(origins) != len(directions):
            raise ShapeError(
                f"{len(origins)} origins and {len(directions)} directions: need one direction a ray"
            )
        if len(origins) > limits.max_query_rays:
            raise TooLargeError(f"{len(origins)} rays in one query, the limit is {limits.max_query_rays}")
        for name in ("max_range_m", "width_m", "step_m"):
            if (value := getattr(self, name)) is not None:
                check_positive(name, value)
        if self.max_range_m > limits.max_coordinate_m:
            raise OutOfRangeError(
                f"rays of {self.max_range_m:.3g} m, the limit is {limits.max_coordinate_m:.3g} m"
            )
        quantiles, directions = _checked_quantiles(self.quantiles), _unit_vectors(directions)
        step_m = snapshot.fine_step_m if self.step_m is None else self.step_m
        steps_a_ray = max(math.ceil(min(self.max_range_m / step_m, 1e15)), 1)
        if len(origins) * steps_a_ray > limits.max_query_samples:
            raise TooLargeError(
                f"{len(origins)} rays of {steps_a_ray:.3g} steps of {step_m:.3g} m, the limit is"
                f" {limits.max_query_samples} steps in all; ask for fewer or shorter rays, or set a longer step_m"
            )
        return RaysPlan(
            snapshot=snapshot,
            origins=origins,
            directions=directions,
            max_range_m=float(self.max_range_m),
            step_m=float(step_m),
            quantiles=quantiles,
            unknown=self.unknown,
            width_m=self.width_m,
            evidence_only=self.evidence_only,
            part_size=max(1, part_samples // steps_a_ray),
        )


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RayReturns:
    """Where N rays end: the distribution of min(first return, maximum range). Ranges from the rays' origins, m."""

    hit_probability: Float64  # (N,) of a return before the maximum range
    mean_m: Float64  # (N,)
    std_m: Float64  # (N,)
    quantile_m: Float64  # (N, Q); the maximum range, where a return before it is too unlikely
    unknown_range_m: Float64  # (N,) where the ray first enters unobserved space; NaN: nowhere before it ends
    unknown_share: Float64  # (N,) of the ray's expected length, in unobserved space
    borrowed_share: Float64  # (N,) of it: the share of the answers there that is expected, and not evidence
    step_m: float  # of the summation, at most
    map_revision: int


@dataclasses.dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class RaysPlan(Plan[FirstReturns]):
    """Rays that passed their checks."""

    snapshot: KernelMap
    origins: Float64  # (N, 3) m, map frame
    directions: Float64  # (N, 3) of unit length
    max_range_m: float
    step_m: float
    quantiles: Float64  # (Q,) ascending
    unknown: Unknown
    width_m: float | None
    evidence_only: bool
    part_size: int

    @property
    def n_items(self) -> int:
        """Rays."""
        return len(self.origins)

    def part(self, i: int) -> FirstReturns:
        """The answers of a run of rays."""
        run = self.items(i)
        origins = self.origins[run]
        return self.snapshot.first_returns(
            origins,
            self.directions[run],
            np.full(len(origins), self.max_range_m),
            step_m=self.step_m,
            quantiles=self.quantiles,
            unknown=self.unknown,
            width_m=self.width_m,
            evidence_only=self.evidence_only,
        )

    def result(self, parts: Iterable[FirstReturns]) -> RayReturns:
        """The answer, from all parts in order."""
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        return RayReturns(
            **dict(zip(FirstReturns._fields, columns, strict=True)),
            step_m=self.step_m,
            map_revision=self.snapshot.map_revision,
        )


def _checked_quantiles(quantiles: ArrayLike) -> Float64:
    levels = np.asarray(quantiles, np.float64)
    if (
        levels.ndim != 1
        or not ((levels > 0) & (levels < 1)).all()
        or (np.diff(levels) <= 0).any()
        or len(levels) > _MAX_QUANTILES
    ):
        raise BadPointsError(
            f"quantiles: need at most {_MAX_QUANTILES} ascending numbers between 0 and 1, not {levels.tolist()}"
        )
    return levels


def _unit_vectors(directions: Float64) -> Float64:
    largest = np.abs(directions).max(axis=1, initial=0.0)
    if not (largest > 0).all():
        raise BadPointsError(f"{int((largest == 0).sum())} of {len(directions)} directions have no length")
    scaled = directions / largest[:, None]  # first, so that the squares neither overflow nor vanish
    return scaled / np.linalg.norm(scaled, axis=1, keepdims=True)
