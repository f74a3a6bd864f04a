"""QueryService: bounded questions to the newest snapshot of a map."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from potserver.domain.kernel_map import KernelMap, as_points
from potserver.domain.types import Float64, KernelSet, Occupancy
from potserver.errors import BadPointsError, OutOfRangeError, ShapeError, TooLargeError
from potserver.services.mapping import MappingService


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GridPlan:
    """A grid whose parts all come from one snapshot, computed when asked for."""

    kernel_map: KernelMap
    lower: Float64  # (3,) m, map frame
    resolution: float  # m
    shape: tuple[int, int, int]  # cells along x, y, z
    part_cells: int

    @property
    def n_cells(self) -> int:
        """Cells of the whole grid."""
        return math.prod(self.shape)

    @property
    def n_parts(self) -> int:
        """Parts of at most `part_cells` cells; the last one may be smaller."""
        return -(-self.n_cells // self.part_cells)

    def part(self, i: int) -> tuple[int, Occupancy]:
        """Flat index of a part's first cell, and the answers at its cell centres, in C order of (x, y, z)."""
        first = i * self.part_cells
        flat = np.arange(first, min(first + self.part_cells, self.n_cells))
        cells = np.stack(np.unravel_index(flat, self.shape), axis=1)
        return first, self.kernel_map.occupancy(self.lower + (cells + 0.5) * self.resolution)


class QueryService:
    """Answers from the newest snapshot; never waits for a scan that is being integrated."""

    def __init__(
        self,
        mapping: MappingService,
        *,
        max_points: int = 200_000,
        max_grid_cells: int = 4_000_000,
        max_coordinate_m: float = 1e7,
    ) -> None:
        """Bound what may be asked: points of a query, cells of a grid, and the largest absolute coordinate."""
        self._mapping = mapping
        self.max_points = max_points
        self.max_grid_cells = max_grid_cells
        self.max_coordinate_m = max_coordinate_m

    def occupancy(self, points: ArrayLike) -> Occupancy:
        """Occupancy at (N, 3) or (N, 2) points, m, map frame.

        Raises:
            ShapeError, BadPointsError, TooLargeError, OutOfRangeError.
        """
        array = as_points(points)
        if len(array) > self.max_points:
            raise TooLargeError(f"{len(array)} points in one query, the limit is {self.max_points}")
        self._check_coordinates(array)
        return self._mapping.snapshot.occupancy(array)

    def grid(
        self, lower: ArrayLike, upper: ArrayLike, resolution: float, *, part_cells: int = 50_000
    ) -> GridPlan:
        """Plan a grid over a box; cells start at `lower` and the last ones reach or pass `upper`.

        Raises:
            BadPointsError: not finite, an upper corner below the lower one, or a resolution that is not positive.
            TooLargeError: more cells than the limit.
            OutOfRangeError: beyond the largest coordinate.
        """
        low, high = self._corner(lower), self._corner(upper)
        if not (math.isfinite(resolution) and resolution > 0):
            raise BadPointsError(f"resolution is {resolution}, need a positive number of metres")
        if (high < low).any():
            raise BadPointsError(f"the box is inverted: lower {low.tolist()}, upper {high.tolist()}")
        # half a millionth of slack, so that a box of 10 m at 0.1 m has 100 cells and not 101
        with np.errstate(
            over="ignore"
        ):  # a tiny resolution gives infinitely many cells, which is over the limit
            counts = np.maximum(np.ceil((high - low) / resolution - 5e-7), 1.0)
            n_cells = float(np.prod(counts))
        if n_cells > self.max_grid_cells:
            raise TooLargeError(
                f"{n_cells:.3g} cells, the limit is {self.max_grid_cells}; ask for a coarser or smaller grid"
            )
        nx, ny, nz = (int(c) for c in counts)
        return GridPlan(self._mapping.snapshot, low, float(resolution), (nx, ny, nz), part_cells)

    def params(
        self, lower: ArrayLike | None = None, upper: ArrayLike | None = None, *, part_kernels: int = 20_000
    ) -> tuple[list[KernelSet], int]:
        """The overall map's kernels, all or those with their hinge mean inside a box, in parts, and the map revision.

        Raises:
            BadPointsError, OutOfRangeError: an illegal corner.
        """
        snapshot = self._mapping.snapshot
        kernels = snapshot.kernels
        inside: NDArray[np.bool_] = np.ones(len(kernels), bool)
        if lower is not None:
            inside &= (kernels.hinge_mean >= self._corner(lower)).all(axis=1)
        if upper is not None:
            inside &= (kernels.hinge_mean <= self._corner(upper)).all(axis=1)
        chosen = kernels.take(inside)
        starts = range(0, max(len(chosen), 1), part_kernels)
        return [chosen.take(slice(i, i + part_kernels)) for i in starts], snapshot.map_revision

    def _corner(self, corner: ArrayLike) -> Float64:
        array = np.asarray(corner, np.float64)
        if array.shape != (3,):
            raise ShapeError(f"a corner of a box has shape {array.shape}, need (3,)")
        if not np.isfinite(array).all():
            raise BadPointsError("a corner of the box is NaN or infinite")
        self._check_coordinates(array)
        return array

    def _check_coordinates(self, array: Float64) -> None:
        farthest = float(np.abs(array).max(initial=0.0))
        if farthest > self.max_coordinate_m:
            raise OutOfRangeError(
                f"a coordinate of {farthest:.3g} m, the limit is {self.max_coordinate_m:.3g} m"
            )
