"""Occupancy at the cell centres of a box."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from potserver.asking.plan import Plan, check_positive, checked_corner
from potserver.domain.kernel_map import KernelMap
from potserver.domain.types import Float64, Occupancy
from potserver.errors import BadPointsError, TooLargeError
from potserver.limits import Limits
from potserver.numerics.brick_grid import Cells

PART_CELLS = 65_536  # of a part: about a megabyte on the wire, and some tens of milliseconds of work
_SLACK_CELLS = 5e-7  # so that a box of 10 m at 0.1 m has 100 cells and not 101


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """What is asked. Cells start at `lower`, and the last ones reach or pass `upper`."""

    lower: ArrayLike  # (3,) m, map frame
    upper: ArrayLike  # (3,) m, map frame; on no axis below `lower`
    resolution: float  # m, edge of a cell
    evidence_only: bool = False  # nothing is borrowed: what is not observed is unknown

    def plan(self, snapshot: KernelMap, limits: Limits, *, part_cells: int = PART_CELLS) -> GridPlan:
        """Check the question.

        Raises:
            ShapeError, BadPointsError: a corner or the resolution is illegal, or the box is inverted.
            OutOfRangeError: a corner is beyond the largest coordinate.
            TooLargeError: more cells than the limit.
        """
        low, high = checked_corner(self.lower, limits), checked_corner(self.upper, limits)
        check_positive("resolution", self.resolution)
        if (high < low).any():
            raise BadPointsError(f"the box is inverted: lower {low.tolist()}, upper {high.tolist()}")
        with np.errstate(over="ignore"):  # a tiny resolution gives infinitely many cells: over the limit
            counts = np.maximum(np.ceil((high - low) / self.resolution - _SLACK_CELLS), 1.0)
            n_cells = float(np.prod(counts))
        if n_cells > limits.max_grid_cells:
            raise TooLargeError(
                f"{n_cells:.3g} cells, the limit is {limits.max_grid_cells}; ask for a coarser or smaller grid"
            )
        nx, ny, nz = (int(c) for c in counts)
        return GridPlan(snapshot, low, float(self.resolution), (nx, ny, nz), self.evidence_only, part_cells)


class GridRun(NamedTuple):
    """Answers at a run of cells."""

    first_cell: int  # its flat index, in C order of (x, y, z)
    occupancy: Occupancy  # of that cell and those after it


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GridPlan(Plan[GridRun]):
    """A grid that passed its checks."""

    snapshot: KernelMap
    lower: Float64  # (3,) m, map frame
    resolution: float  # m
    shape: tuple[int, int, int]  # cells along x, y, z
    evidence_only: bool
    part_size: int

    @property
    def n_items(self) -> int:
        """Cells."""
        return math.prod(self.shape)

    def part(self, i: int) -> GridRun:
        """The answers at the centres of a run of cells."""
        run = self.items(i)
        cells = Cells(self.lower, self.resolution, self.shape)
        answer = self.snapshot.occupancy_of_cells(
            cells, run.start, run.stop, evidence_only=self.evidence_only
        )
        return GridRun(run.start, answer)
