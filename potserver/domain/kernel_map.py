"""KernelMap: an immutable set of kernels that answers queries."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from potschemas import answers
from potschemas.answers import AnswerRule, LatentGradients, LatentSums
from potschemas.lean import LeanAt, lean_at
from potserver.domain.map_part import MapPart
from potserver.domain.types import Float32, Float64, KernelSet, Occupancy, Unknown
from potserver.errors import BadPointsError, ShapeError
from potserver.numerics import gradients, kernel_index, rays
from potserver.numerics.brick_grid import Cells, grid_sums
from potserver.numerics.brick_map import BrickMap
from potserver.numerics.brick_sums import brick_gradients, brick_sums, brick_widths
from potserver.numerics.lean import Lean
from potserver.numerics.threads import default_threads, parallel_map, spans

T = TypeVar("T")

_ANSWERED_AT_ONCE = 8192  # points: what their formulas pass through stays in the processor's cache


class KernelMap:
    """K kernels and what makes asking them fast. Never changes; any number of threads may query it at once."""

    def __init__(
        self,
        kernels: KernelSet | Sequence[MapPart],
        *,
        rule: AnswerRule = AnswerRule(),
        map_revision: int = 0,
        threads: int | None = None,
        lean: Lean | None = None,
    ) -> None:
        """Index the kernels. Answers use the mean of every hinge and every gamma; their dispersions are only kept.

        Args:
            kernels: In the map frame; gamma enters by its mean. Or parts that were made ready before, at the rule's
                `observed_activation` and `prior_var`, so that only new parts cost time.
            rule: What turns sums over the kernels into answers.
            map_revision: Carried into the answers.
            threads: Threads a query may use; all processors by default.
            lean: What the kernels' sums are added to; nothing by default.
        """
        self.rule = rule
        self.lean = lean or None  # an empty one is none
        self.map_revision = map_revision
        self._threads = threads or default_threads()
        if isinstance(kernels, KernelSet):
            kernels = [MapPart.of(kernels, rule)]
        self._parts = tuple(kernels)
        self._index = kernel_index.IndexParts.of([part.lookup for part in self._parts])
        self._bricks = BrickMap(bricks for part in self._parts for bricks in part.bricks)
        self._n_kernels = sum(part.n_kernels for part in self._parts)

    @cached_property
    def kernels(self) -> KernelSet:
        """All kernels, map frame; put together when first asked for."""
        if len(self._parts) == 1:
            return self._parts[0].kernels
        return KernelSet.concatenate([part.kernels for part in self._parts])

    @property
    def parts(self) -> tuple[MapPart, ...]:
        """What the kernels are kept in."""
        return self._parts

    @property
    def box(self) -> Float64 | None:
        """(2, 3) m, map frame: lower and upper corner of the hinges' box; none without kernels."""
        if not len(self):
            return None
        boxes = np.stack([part.box for part in self._parts])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])

    @classmethod
    def from_arrays(
        cls,
        hinge_points: ArrayLike,
        gamma: ArrayLike,
        weight_mean: ArrayLike,
        weight_var: ArrayLike,
        *,
        rule: AnswerRule = AnswerRule(),
        threads: int | None = None,
    ) -> KernelMap:
        """A map from bare arrays, hinges and gammas without dispersion.

        Args:
            hinge_points: (K, 3) or (K, 2) m.
            gamma: (K,) 1/m^2, > 0.
            weight_mean: (K,) log-odds.
            weight_var: (K,) log-odds^2, >= 0; a variance, not a standard deviation.
            rule, threads: As in the constructor.
        Raises:
            ShapeError: the arrays disagree on K, or gamma or a variance has an illegal sign, or something is not finite.
        """
        hinge = as_points(hinge_points)
        g, w, v = (np.asarray(a, np.float64).reshape(-1) for a in (gamma, weight_mean, weight_var))
        if not len(hinge) == len(g) == len(w) == len(v):
            raise ShapeError(
                f"{len(hinge)} hinge points, {len(g)} gammas, {len(w)} means, {len(v)} variances: K differs"
            )
        # a Gamma distribution of shape 1 / rel_var; as sharp as float32 tells apart
        shape = np.full(len(g), 1e6)
        with np.errstate(over="ignore", divide="ignore"):
            rate = (shape / g).astype(np.float32)
        kernels = KernelSet(
            hinge_mean=hinge,
            hinge_var=np.zeros((len(hinge), 3), np.float32),
            gamma_shape=shape.astype(np.float32),
            gamma_rate=rate,
            weight_mean=_float32(w),
            weight_var=_float32(v),
        )
        return cls(kernels, rule=rule, threads=threads)

    def with_parts(self, parts: Sequence[MapPart]) -> KernelMap:
        """The same map from parts that hold the same kernels elsewhere."""
        return KernelMap(
            parts, rule=self.rule, map_revision=self.map_revision, threads=self._threads, lean=self.lean
        )

    def __len__(self) -> int:
        return self._n_kernels

    @property
    def n_off_lattice(self) -> int:
        """Kernels that stand on no lattice: they are looked for one by one, which takes longer."""
        return len(self) - len(self._bricks)

    def occupancy(self, points: ArrayLike, *, evidence_only: bool = False) -> Occupancy:
        """Mean and variance of the occupancy probability, and of the latent, anywhere.

        Args:
            points: (N, 3) or (N, 2) m, map frame; float64 keeps the precision of far coordinates.
            evidence_only: Nothing is borrowed: what is not observed is unknown.
        Raises:
            ShapeError: not (N, 3) or (N, 2).
            BadPointsError: NaN or infinite coordinates.
        Source: paper eq. 1; `potschemas.answers`.
        """
        array = as_points(points)
        return self._answer(self.latent(array), self._lean_at(array), evidence_only=evidence_only)

    def _lean_at(self, points: Float64) -> Float32 | None:
        return None if self.lean is None else self.lean.at(points, threads=self._threads, lane="query")

    def occupancy_with_gradient(self, points: ArrayLike, *, evidence_only: bool = False) -> Occupancy:
        """`occupancy` and the analytic gradients of its mean and of its latent mean; both are 0 where nothing is known.

        Args, Raises: As `occupancy`.
        """
        array = as_points(points)
        sums = self.latent(array)
        slopes = brick_gradients(self._bricks, array, threads=self._threads, lane="query")
        if self.n_off_lattice:
            more = gradients.latent_gradients(self._rest, array, threads=self._threads, lane="query")
            slopes = LatentGradients(*(a + b for a, b in zip(slopes, more, strict=True)))
        lean = None if self.lean is None else lean_at(array, self.lean.told)
        pieces = self._in_pieces(
            lambda cut: answers.gradients(
                LatentSums(*(s[cut] for s in sums)),
                LatentGradients(*(s[cut] for s in slopes)),
                self.rule,
                None if lean is None else LeanAt(*(s[cut] for s in lean)),
                evidence_only=evidence_only,
            ),
            len(array),
        )
        gradient, of_latent = (np.concatenate(columns) for columns in zip(*pieces, strict=True))
        answer = self._answer(sums, None if lean is None else lean.log_odds, evidence_only=evidence_only)
        return dataclasses.replace(answer, gradient=gradient, latent_gradient=of_latent)

    def occupancy_of_cells(
        self, cells: Cells, first: int, last: int, *, evidence_only: bool = False
    ) -> Occupancy:
        """`occupancy` at the centres of a run of a grid's cells, in C order of (x, y, z); `last` is behind it."""
        sums = grid_sums(self._bricks, cells, first, last, threads=self._threads, lane="query")
        lean = None
        if self.n_off_lattice or self.lean is not None:
            number = np.stack(np.unravel_index(np.arange(first, last), cells.shape), axis=1)
            centres = cells.lower + (number + 0.5) * cells.resolution
            lean = self._lean_at(centres)
            if self.n_off_lattice:
                sums = _added(sums, self._rest_sums(centres))
        return self._answer(sums, lean, evidence_only=evidence_only)

    def _answer(self, sums: LatentSums, lean: Float32 | None, *, evidence_only: bool) -> Occupancy:
        """What the rule makes of the sums, and of the lean if there is one."""
        pieces = self._in_pieces(
            lambda cut: answers.answer(
                LatentSums(*(s[cut] for s in sums)),
                self.rule,
                None if lean is None else lean[cut],
                evidence_only=evidence_only,
            ),
            len(sums.mean),
        )
        answer = answers.Answer(*(np.concatenate(columns) for columns in zip(*pieces, strict=True)))
        return Occupancy(**answer._asdict(), map_revision=self.map_revision)

    def _in_pieces(self, function: Callable[[slice], T], n: int) -> list[T]:
        """What a function makes of n points, some of them at a time; at least once."""
        cuts = [slice(*span) for span in spans(n, -(-n // _ANSWERED_AT_ONCE))] or [slice(0, 0)]
        return parallel_map(function, cuts, self._threads, "query")

    def first_returns(
        self,
        origins: Float64,
        directions: Float64,
        max_range_m: Float64,
        *,
        step_m: float,
        quantiles: Float64,
        unknown: Unknown,
        width_m: float | None,
        evidence_only: bool = False,
    ) -> rays.FirstReturns:
        """Where rays end, see `numerics.rays`; inputs are checked by `asking.rays`."""
        width_of_unknown = self.typical_width_m if width_m is None else width_m
        rate = {
            Unknown.FREE: 0.0,
            Unknown.PRIOR: math.log(2.0) / width_of_unknown,
            Unknown.OCCUPIED: math.inf,
        }
        leans = width_of_unknown if unknown is Unknown.PRIOR and not evidence_only else None
        options = rays.RayOptions(step_m, quantiles, rate[unknown], leans, width_m, evidence_only)
        looks = rays.Rays(origins, directions, max_range_m)
        return rays.first_returns(
            self._rest, self._bricks, looks, options, self.rule, lean=self.lean, threads=self._threads
        )

    @cached_property
    def _rest(self) -> kernel_index.KernelIndex:
        """One index of all kernels on no lattice, for questions that walk through the parts; built by the first of them."""
        indexed = [part for part in self._parts if len(part.rest)]
        if len(indexed) == 1:
            return indexed[0].lookup
        return MapPart.of(KernelSet.concatenate([part.rest for part in indexed]), self.rule).lookup

    @cached_property
    def _widths(self) -> rays.Widths:
        return rays.widths_of(self._rest, self._bricks)

    @cached_property
    def typical_width_m(self) -> float:
        """Median over the kernels of sqrt(pi / (2 gamma)): what counts as one trial where nothing was observed."""
        return rays.typical_width(self._widths)

    @cached_property
    def fine_step_m(self) -> float:
        """A step that resolves nearly all kernels along a ray."""
        return rays.fine_step(self._widths)

    def widths(self, points: Float64) -> Float64:
        """(N,) m: mean of sqrt(pi / (2 gamma)) of the kernels at (N, 3) points, by activation; `typical_width_m` if none."""
        shared = brick_widths(self._bricks, points, threads=self._threads, lane="query")
        activation, weighted = (column.astype(np.float64) for column in shared)
        if self.n_off_lattice:
            columns = self._rest.columns.copy()
            columns[1], columns[2] = rays.kernel_widths(self._rest) * columns[4], 0.0
            more = kernel_index.latent_sums(
                self._rest._replace(columns=columns), points, threads=self._threads, lane="query"
            )
            activation, weighted = activation + more.activation, weighted + more.mean
        reached = activation > 0
        return np.where(reached, weighted / np.where(reached, activation, 1.0), self.typical_width_m)

    def latent(self, points: Float64) -> LatentSums:
        """The bare sums of eq. 1 at (N, 3) points, with no rule for unobserved ones."""
        sums = brick_sums(self._bricks, points, threads=self._threads, lane="query")
        return _added(sums, self._rest_sums(points)) if self.n_off_lattice else sums

    def _rest_sums(self, points: Float64) -> LatentSums:
        return kernel_index.latent_sums_of_parts(self._index, points, threads=self._threads, lane="query")


def _added(one: LatentSums, other: LatentSums) -> LatentSums:
    return LatentSums(*(a + b for a, b in zip(one, other, strict=True)))


def as_points(points: ArrayLike) -> Float64:
    """(N, 3) float64 from (N, 3) or (N, 2); 2D points get z = 0.

    Raises:
        ShapeError: neither of the two shapes.
        BadPointsError: NaN or infinite coordinates.
    """
    array = np.asarray(points, np.float64)
    if array.ndim != 2 or array.shape[1] not in (2, 3):
        raise ShapeError(f"points: {array.shape}, need (N, 3) or (N, 2)")
    if not np.isfinite(array).all():
        raise BadPointsError("points have NaN or infinite coordinates")
    if array.shape[1] == 2:
        array = np.concatenate([array, np.zeros((len(array), 1))], axis=1)
    # a copy of arrays that were received: they are read-only, and loops are compiled for writable ones
    return np.ascontiguousarray(array) if array.flags.writeable else np.array(array, order="C")


def _float32(values: Float64) -> Float32:
    with np.errstate(over="ignore"):  # what overflows is refused as infinite
        return values.astype(np.float32)
